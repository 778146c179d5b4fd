"""Misfit of a physical model to records, and its derivatives."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from haselab import _motion
from haselab.actuators import ADDED_INERTIA, Response, SampledLaw
from haselab.actuators.threads import in_threads
from haselab.base import HaselabError, LimitError
from haselab.identify.physical.record import MotionRecord, repeats
from haselab.identify.physical.unknowns import (
    CAMERA_LATENCY,
    CAMERA_OFFSET,
    CAMERA_SCALE,
    SENSING_LATENCY,
    SENSING_SCALE,
    START_HYSTERESIS,
    Unknowns,
    usual,
)

__all__ = [
    "CAPACITANCE",
    "LENGTH",
    "SHARED_PX",
    "TRACKED_ZERO_M",
    "Misfit",
    "ModelledRecord",
    "Segment",
    "SharedErrors",
    "highest_of",
    "least_explained",
    "model_record",
]

Floats = NDArray[np.float64]
LENGTH, CAPACITANCE = "length", "capacitance"
TRACKED_ZERO_M = 2e-6  # standard deviation of the zero of lengths from tracks of 0.02 px
SHARED_PX = 3e-4  # error of tracking that all frames with the same pixels share
_LITTLE_N = 1e-4  # change of the load for the derivative of the state at the first edge
_ENDLESS = 1e100  # from this derivative on, its square over that of the noise may overflow
_LIGHTEST = 2e-3  # of the hung mass: an inertia below moves too fast for the steps


@dataclass(frozen=True)
class ModelledRecord:
    """What a model says of one record.

    Args:
        length_m: as the camera shows it. Shape `(F,)`.
        capacitance_f: as it is sensed. Shape `(C,)`.
        length_by: derivatives by what varies. Shape `(F, P)`; P is 0 where they were not wanted.
        capacitance_by: likewise. Shape `(C, P)`.
    """

    length_m: Floats
    capacitance_f: Floats
    length_by: Floats
    capacitance_by: Floats


def model_record(
    unknowns: Unknowns,
    record: MotionRecord,
    *,
    derivatives: bool = True,
    strict: bool = False,
    longest_m: float = 0.0,
) -> ModelledRecord:
    """Simulate a record.

    Args:
        unknowns: of the model.
        record: with what acted, and when it was seen.
        derivatives: whether they are wanted.
        strict: whether all lengths must be within the limits of the law. Outside, such as after a
            collapse, the simulated motion is rough and its derivatives are wrong.
        longest_m: length that the actuator had reached before the record, if it was longer.
    Returns:
        Lengths and capacitances at the times of the record.
    Raises:
        HaselabError: The law has no equilibrium, is outside its limits, or not smooth.
    """
    law = unknowns.present_law()
    added_kg = unknowns.value(ADDED_INERTIA)
    lightest_kg = float(record.drive.mass_kg.min()) + law.moving_mass_kg + added_kg
    if lightest_kg < _LIGHTEST * unknowns.mass_kg:
        raise LimitError(
            f"{record.name}: the moving mass of {lightest_kg:g} kg is too small to simulate."
        )
    names = unknowns.law_names if derivatives else ()
    sampled = SampledLaw(
        law,
        highest_of(record),
        names,
        added_inertia_kg=added_kg,
        drifts=unknowns.drifts,
    )
    held_n = unknowns.value(START_HYSTERESIS) if START_HYSTERESIS in unknowns.names else None
    response = _respond(sampled, record, unknowns.value(CAMERA_LATENCY), held_n, longest_m)
    if strict and record.length_m.size:
        low_m, high_m = float(response.length_m.min()), float(response.length_m.max())
        if low_m < sampled.table.low_m or high_m > sampled.table.high_m:
            raise LimitError(f"{record.name}: the motion leaves the limits of the law.")
    scale = unknowns.value(SENSING_SCALE)
    latency_s = unknowns.value(SENSING_LATENCY)
    drift = record.over_windows(response.drift_f_s[record.sensed])
    later_s = record.capacitance_later_s - latency_s
    inside = record.over_windows(response.capacitance_f[record.sensed]) + later_s * drift
    shown = unknowns.value(CAMERA_SCALE)
    length_m = shown * response.length_m + unknowns.value(CAMERA_OFFSET)
    if not derivatives:
        none = np.zeros((0, 0))
        return ModelledRecord(length_m, scale * inside, none, none)
    columns: dict[str, tuple[ArrayLike, ArrayLike]] = {
        CAMERA_LATENCY: (-shown * response.speed_m_s, 0.0),
        CAMERA_OFFSET: (1.0, 0.0),
        CAMERA_SCALE: (response.length_m, 0.0),
        SENSING_LATENCY: (0.0, -scale * drift),
        SENSING_SCALE: (0.0, inside),
    }
    inside_by = record.over_windows(response.capacitance_by)
    if held_n is not None:
        columns[START_HYSTERESIS] = shown * response.length_by[:, -1], scale * inside_by[:, -1]
    length_by = np.empty((length_m.size, len(unknowns.names)))
    capacitance_by = np.empty((inside.size, len(unknowns.names)))
    count = len(unknowns.law_names)
    length_by[:, :count] = shown * response.length_by[:, :count]
    capacitance_by[:, :count] = scale * inside_by[:, :count]
    for k, name in enumerate(unknowns.names[count:], start=count):
        length_by[:, k] = np.asarray(columns[name][0])
        capacitance_by[:, k] = np.asarray(columns[name][1])
    length_by *= unknowns.slopes
    capacitance_by *= unknowns.slopes
    return ModelledRecord(length_m, scale * inside, length_by, capacitance_by)


def highest_of(record: MotionRecord) -> float:
    """Voltage up to which a law is tabulated for a record: whole kV, above its highest one."""
    drive = record.drive
    peak_v = np.abs(drive.voltage_v) + np.sqrt(2.0 * drive.ripple_v2)
    return float(np.ceil(peak_v.max() / 1e3 + 1.0) * 1e3)


def _respond(
    sampled: SampledLaw,
    record: MotionRecord,
    latency_s: float,
    held_n: float | None,
    longest_m: float,
) -> Response:
    drive = record.drive
    low, high = drive.edge_s[0], drive.edge_s[-1]
    middle_s = record.length_time_s - latency_s
    # Gauss's two points of the exposure, over which a frame shows the mean
    half_s = record.exposure_s / np.sqrt(12.0)
    both_s = np.clip(np.concatenate([middle_s - half_s, middle_s + half_s]), low, high)
    order = np.argsort(both_s, kind="stable")
    start, start_by = _at_rest(sampled, record, held_n, longest_m)
    found = sampled.respond(drive, both_s[order], start, sensed=record.sensed, start_by=start_by)
    first, second = np.split(np.argsort(order), 2)
    return replace(
        found,
        **{
            name: 0.5 * (getattr(found, name)[first] + getattr(found, name)[second])
            for name in ("length_m", "speed_m_s", "length_by")
        },
    )


def _at_rest(
    sampled: SampledLaw, record: MotionRecord, held_n: float | None, longest_m: float
) -> tuple[NDArray[np.void], Floats]:
    """State at the first edge with its derivatives, the last by the force of the hysteresis."""
    acts = float(record.drive.voltage_v[0]), float(record.drive.ripple_v2[0])
    load_n = float(record.drive.load_n[0])
    if held_n is None:
        return sampled.at_rest(*acts, load_n, longest_m=longest_m)
    state, by = sampled.at_rest(*acts, load_n - held_n, longest_m=longest_m)
    low, high = (
        sampled.at_rest(*acts, load_n - held_n + s * _LITTLE_N, longest_m=longest_m)[0]
        for s in (1.0, -1.0)
    )
    column = np.zeros((_motion.ROWS, 1))
    column[0] = (high["length_m"] - low["length_m"]) / (2.0 * _LITTLE_N)
    column[3] = (high["longest_m"] - low["longest_m"]) / (2.0 * _LITTLE_N)
    branches = len(sampled.law.losses.branch_share)
    column[4 : 4 + branches, 0] = (
        (high["relaxed_n"] - low["relaxed_n"])[0, :branches] / (2.0 * _LITTLE_N)
    )  # fmt: skip
    column[-1] = 1.0
    state["hysteresis_n"] = held_n
    return state, np.hstack([by, column])


@dataclass(frozen=True)
class SharedErrors:
    """Errors of tracking that all lengths within the same pixel share.

    Args:
        weights: their standard deviation over that of each length's own error; one row per pixel.
        gain: what of a pixel's weighed sum is taken away, so that the rest is white.
    """

    weights: csr_array
    gain: Floats

    @classmethod
    def of(cls, record: MotionRecord, length_std_m: Floats) -> SharedErrors:
        """Those of a record.

        Args:
            record: with its lengths and the size of a pixel.
            length_std_m: standard deviation of each length's own error. Shape `(F,)`.
        """
        count = record.length_m.size
        if record.pixel_m > 0.0:
            pixel = np.unique(np.floor(record.length_m / record.pixel_m), return_inverse=True)[1]
        else:
            pixel = np.arange(count)
        share = SHARED_PX * record.pixel_m / length_std_m
        total = np.bincount(pixel, share**2)
        gain = np.divide(1.0 - (1.0 + total) ** -0.5, total, where=total > 0.0, out=0.0 * total)
        return cls(csr_array((share, (pixel, np.arange(count))), shape=(total.size, count)), gain)

    @classmethod
    def of_zero(cls, own: SharedErrors, length_std_m: Floats, zero_std_m: float) -> SharedErrors:
        """The error of the zero that all lengths of a record share, after other errors.

        Args:
            own: of the same record, which are taken away first.
            length_std_m: standard deviation of each length's own error. Shape `(F,)`.
            zero_std_m: standard deviation of the zero.
        """
        share = own.whitened(zero_std_m / length_std_m)
        total = np.array([float(share @ share)])
        gain = np.divide(1.0 - (1.0 + total) ** -0.5, total, where=total > 0.0, out=0.0 * total)
        return cls(csr_array(share[None]), gain)

    def whitened(self, values: Floats) -> Floats:
        r"""Multiply by $(1 + u u^\top)^{-1/2}$, with the weights $u$ of each pixel.

        Args:
            values: over the own standard deviations. Shape `(F,)` or `(F, P)`.
        """
        sums = self.weights @ values
        gain = self.gain if values.ndim == 1 else self.gain[:, None]
        return np.asarray(values - self.weights.T @ (gain * sums))


def _whitened(shared: Sequence[SharedErrors], values: Floats) -> Floats:
    for part in shared:
        values = part.whitened(values)
    return values


@dataclass(frozen=True)
class Segment:
    """Residuals of one channel in one experiment.

    Args:
        experiment: its name; empty for what is known beforehand.
        channel: `LENGTH`, `CAPACITANCE` or "known".
        rows: of the residuals.
        std_estimated: see `MotionRecord`.
    """

    experiment: str
    channel: str
    rows: NDArray[np.int64]
    std_estimated: bool = False


@dataclass(frozen=True)
class Misfit:
    """Weighted differences between records and a model.

    Args:
        records: what was seen.
        length_factor: true over stated standard deviation of the lengths.
        capacitance_factor: the same of the capacitances.
        known: standard deviations of what is known of an instrument beforehand, by its name; each
            is one more residual, after those of the records.
        strict: whether a motion outside the law's limits counts as none.
        zero_std_m: standard deviation of the zero of the lengths of each of several records; None:
            that of the camera's offset in `known`.
    """

    records: Sequence[MotionRecord]
    length_factor: float = 1.0
    capacitance_factor: float = 1.0
    known: Mapping[str, float] = field(default_factory=dict)
    strict: bool = False
    zero_std_m: float | None = None

    @property
    def own_zero_std_m(self) -> float:
        """Standard deviation of the zero of the lengths of each of several records."""
        if self.zero_std_m is not None:
            return self.zero_std_m
        return self.known.get(CAMERA_OFFSET, TRACKED_ZERO_M)

    @cached_property
    def _shared(self) -> list[list[SharedErrors]]:
        """Of each record, one after the other. Between records, the zero of the camera moves."""
        found = []
        for record in self.records:
            std_m = self.length_factor * record.length_std_m
            parts = [SharedErrors.of(record, std_m)]
            if len(self.records) > 1:
                parts.append(SharedErrors.of_zero(parts[0], std_m, self.own_zero_std_m))
            found.append(parts)
        return found

    @cached_property
    def segments(self) -> list[Segment]:
        """All residuals, channel by channel and experiment by experiment."""
        found, at = [], 0
        for record in self.records:
            for channel, member in (
                (LENGTH, record.length_experiment),
                (CAPACITANCE, record.capacitance_experiment),
            ):
                for k, name in enumerate(record.experiments):
                    rows = at + np.flatnonzero(member == k)
                    if rows.size:
                        found.append(Segment(name, channel, rows, record.std_estimated))
                at += member.size
        known = np.arange(at, at + len(self.known))
        return [*found, Segment("", "known", known)] if known.size else found

    @cached_property
    def runs(self) -> NDArray[np.int64]:
        """Number of the run of equal successive values that each residual belongs to. Shape `(N,)`.

        The values of a run share the error of one step of a converter, or are one value that was
        held. Where few values repeat, each is a run of its own.
        """
        found = [
            _runs(values, member)
            for record in self.records
            for values, member in (
                (record.length_m, record.length_experiment),
                (record.capacitance_f, record.capacitance_experiment),
            )
        ]
        begins = np.concatenate([*found, np.ones(len(self.known), dtype=bool)])
        return np.cumsum(begins) - 1

    def residuals(self, unknowns: Unknowns) -> Floats | None:
        """Measured minus modelled over the standard deviation; None where no motion exists.

        Args:
            unknowns: of the model.
        Returns:
            All lengths, then all capacitances, of one record after the other; then what is known.
        """
        found = self._each(unknowns, derivatives=False)
        return None if found is None else self._weighed(found, unknowns)

    def linearised(self, unknowns: Unknowns) -> tuple[Floats, Floats] | None:
        """Residuals and their derivatives by what varies; None where no motion exists.

        Args:
            unknowns: of the model.
        Returns:
            Residuals, shape `(N,)`, and derivatives of the modelled over the standard deviation,
            shape `(N, P)`.
        """
        found = self._each(unknowns, derivatives=True)
        if found is None:
            return None
        # once the simulated actuator has collapsed, derivatives grow without limit
        largest = [
            np.abs(by).max(initial=0.0)
            for part in found
            for by in (part.length_by, part.capacitance_by)
        ]
        if not all(value < _ENDLESS for value in largest):
            return None
        by = []
        for part, record, shared in zip(found, self.records, self._shared, strict=True):
            std_m = self.length_factor * record.length_std_m
            by.append(_whitened(shared, part.length_by / std_m[:, None]))
            std_f = self.capacitance_factor * record.capacitance_std_f
            by.append(part.capacitance_by / std_f[:, None])
        for name, std in self.known.items():
            by.append(np.where(np.array(unknowns.names) == name, 1.0 / std, 0.0)[None])
        return self._weighed(found, unknowns), np.vstack(by)

    def zeros(self, unknowns: Unknowns) -> list[float]:
        """Estimate the error of the zero of each record's lengths, in standard deviations.

        Args:
            unknowns: of the model.
        Returns:
            One for each record; 0 if it has no lengths, if it is the only one, or without a motion.
        """
        found = self._each(unknowns, derivatives=False)
        zeros = [0.0] * len(self.records)
        for k, (record, shared) in enumerate(zip(self.records, self._shared, strict=True)):
            if found is None or not record.length_m.size or len(shared) < 2:
                continue
            std_m = self.length_factor * record.length_std_m
            off = shared[0].whitened((record.length_m - found[k].length_m) / std_m)
            weights = shared[1].weights
            zeros[k] = float((weights @ off)[0] / (1.0 + weights.multiply(weights).sum()))
        return zeros

    def _each(self, unknowns: Unknowns, *, derivatives: bool) -> list[ModelledRecord] | None:
        def one(record: MotionRecord) -> ModelledRecord:
            return model_record(unknowns, record, derivatives=derivatives, strict=self.strict)

        try:
            if len(self.records) == 1:
                return [one(self.records[0])]
            return in_threads(one, self.records, os.cpu_count() or 1)
        except HaselabError:
            return None

    def _weighed(self, found: Sequence[ModelledRecord], unknowns: Unknowns) -> Floats:
        parts = []
        for part, record, shared in zip(found, self.records, self._shared, strict=True):
            std_m = self.length_factor * record.length_std_m
            parts.append(_whitened(shared, (record.length_m - part.length_m) / std_m))
            std_f = self.capacitance_factor * record.capacitance_std_f
            parts.append((record.capacitance_f - part.capacitance_f) / std_f)
        known = [(usual(name) - unknowns.value(name)) / std for name, std in self.known.items()]
        return np.concatenate([*parts, known])


def _runs(values: Floats, member: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which values begin a run of equal ones within an experiment. Shape `(N,)`."""
    if not repeats(values):
        return np.ones(values.size, dtype=bool)
    return np.append(True, (np.diff(values) != 0.0) | (np.diff(member) != 0))


def least_explained(misfit: Misfit, residuals: Floats) -> float:
    """Share of the variance of a channel that a model explains, of the less explained one.

    Args:
        misfit: with the records.
        residuals: of it. Shape `(N,)`.
    Returns:
        1 for a perfect model, 0 or less for one that is no better than a constant.
    """
    records, shares = misfit.records, []
    for channel, factor, values, stds in (
        (LENGTH, misfit.length_factor, [r.length_m for r in records],
         [r.length_std_m for r in records]),
        (CAPACITANCE, misfit.capacitance_factor, [r.capacitance_f for r in records],
         [r.capacitance_std_f for r in records]),
    ):  # fmt: skip
        rows = [residuals[part.rows] for part in misfit.segments if part.channel == channel]
        variance = float(np.var(np.concatenate(values))) if rows else 0.0
        if variance > 0.0:
            left = float(np.mean(np.concatenate(rows) ** 2))
            typical = factor * float(np.median(np.concatenate(stds)))
            shares.append(1.0 - left * typical**2 / variance)
    return min(shares, default=1.0)
