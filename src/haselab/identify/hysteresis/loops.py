"""Loops in a record: which samples identify a model, and the loop width of each cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, JsonObject, check_fields
from haselab.identify.noise import coloured_covariance
from haselab.identify.record import finite_vector
from haselab.identify.statics.cycles import loop_cells, loop_width, rising_edges

__all__ = ["LoopRecord", "LoopWidth", "band_widths", "common_curve", "direction", "mean_width"]

Floats = NDArray[np.float64]
_LEAST_SAMPLES = 24
_COVERED = 0.98  # of the span
_DEGREE = 5


@dataclass(frozen=True)
class LoopRecord:
    """Input and output, sampled together.

    Args:
        u: input in order of time. Shape `(N,)`.
        y: output. Shape `(N,)`.
        rate_hz: sampling rate, in Hz.
        counted_from_s: samples before this time set the memory state and are not fitted, in s: for
            initial cycles that differ from the later ones.
    Raises:
        InputError: fewer than 24 fitted samples, unequal lengths, NaN, a constant column.
    """

    u: Floats
    y: Floats
    rate_hz: float
    counted_from_s: float = 0.0
    made_by: ClassVar[str] = "Make one of two columns: haselab.identify.LoopRecord(u, y, rate_hz)."

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("u", "y"):
            column = finite_vector(name, getattr(self, name), _LEAST_SAMPLES)
            if np.ptp(column) == 0.0:
                raise InputError(
                    f"{name} is {column[0]:g} throughout; it must change. "
                    "Name the right column, or record loops."
                )
            object.__setattr__(self, name, np.ascontiguousarray(column))
        if self.u.size != self.y.size:
            raise InputError(
                f"u has {self.u.size} values and y {self.y.size}, but they must be equally long. "
                "Give one output for each input."
            )
        if not 0.0 < self.rate_hz < math.inf:
            raise InputError(
                f"rate_hz = {self.rate_hz:g} Hz; it must be above 0 Hz. Give the sampling rate."
            )
        longest_s = (self.u.size - _LEAST_SAMPLES) / self.rate_hz
        if not 0.0 <= self.counted_from_s <= longest_s:
            raise InputError(
                f"counted_from_s = {self.counted_from_s:g} s; it must be 0 to {longest_s:g} s, "
                f"which leaves {_LEAST_SAMPLES} samples."
            )

    @property
    def first(self) -> int:
        """Index of the first sample that counts."""
        return math.ceil(self.counted_from_s * self.rate_hz - 1e-9)

    def settled(self) -> NDArray[np.bool_]:
        """Samples that count, after the input has covered its range once.

        Earlier memory is erased there. If these are less than half of the counted samples, all of
        them are used and a zero memory state is assumed before the record.
        """
        low, high = float(self.u.min()), float(self.u.max())
        edge = 0.5 * (1.0 - _COVERED) * (high - low)
        start = max(int(np.argmax(self.u <= low + edge)), int(np.argmax(self.u >= high - edge)))
        numbers = np.arange(self.u.size)
        counted = numbers >= self.first
        kept = counted & (numbers >= start)
        return kept if kept.sum() >= 0.5 * counted.sum() else counted


@dataclass(frozen=True)
class LoopWidth:
    """Width of one cycle's loop.

    Args:
        record: index of the record, from 0.
        cycle: index of the cycle in the record, from 0.
        rate_per_s: mean rate of the input, in its unit per s.
        width: mean distance of the falling from the rising branch at equal input, in the unit of
            the output; positive where the output lags behind the input, even if it falls as
            the input rises.
        relative_width: the same over the span of the output.
    """

    record: int
    cycle: int
    rate_per_s: float
    width: Estimate
    relative_width: Estimate

    def to_dict(self) -> JsonObject:
        """The result as a dictionary."""
        return {
            "record": self.record,
            "cycle": self.cycle,
            "rate_per_s": self.rate_per_s,
            "width": self.width,
            "relative_width": self.relative_width,
        }


def common_curve(records: Sequence[LoopRecord]) -> list[Floats]:
    """Distance of each record from one smooth curve through all of them. Shape `(N_r,)` each."""
    u = np.concatenate([record.u[record.first :] for record in records])
    y = np.concatenate([record.y[record.first :] for record in records])
    middle, half = 0.5 * float(u.max() + u.min()), 0.5 * float(np.ptp(u)) or 1.0

    def shapes(values: Floats) -> Floats:
        table = np.polynomial.chebyshev.chebvander((values - middle) / half, _DEGREE)
        return np.asarray(table, dtype=np.float64)

    factors = np.asarray(np.linalg.lstsq(shapes(u), y, rcond=None)[0], dtype=np.float64)
    return [np.asarray(record.y - shapes(record.u) @ factors) for record in records]


def direction(records: Sequence[LoopRecord]) -> float:
    """1 if the output rises with the input overall, -1 if it falls."""
    total = sum(
        float((r.u[r.first :] - r.u[r.first :].mean()) @ (r.y[r.first :] - r.y[r.first :].mean()))
        for r in records
    )
    return -1.0 if total < 0.0 else 1.0


def band_widths(records: Sequence[LoopRecord], span: float | None = None) -> list[LoopWidth]:
    """Loop width of every complete counted cycle, with the noise model of its samples.

    Args:
        records: loops.
        span: of the output without noise and spikes, in its unit; None: that of the samples.
    Returns:
        One entry per cycle; empty if the samples are not in order of time.
    Source: difference of the branches' means in cells of equal input.
    """
    sign = direction(records)
    if span is None:
        span = float(np.ptp(np.concatenate([r.y[r.first :] for r in records]))) or 1.0
    found = []
    for number, (record, distance) in enumerate(zip(records, common_curve(records), strict=True)):
        edges = rising_edges(record.u)
        starts = np.flatnonzero(np.diff(edges, prepend=edges[0] - 1))
        ends = [*starts[2::2], record.u.size] if starts.size % 2 == 0 else starts[2::2]
        for cycle, (begin, end) in enumerate(zip(starts[::2], ends, strict=False)):
            part = slice(int(begin), int(end))
            width = _cycle_width(record.u[part], distance[part], edges[part])
            if width is not None and begin >= record.first:
                rate = float(np.abs(np.diff(record.u[part])).mean()) * record.rate_hz
                width = width.scaled(sign, "")
                relative = width.scaled(1.0 / span, "")
                found.append(LoopWidth(number, cycle, rate, width, relative))
    return found


def _cycle_width(u: Floats, distance: Floats, edges: NDArray[np.int_]) -> Estimate | None:
    if not (edges == 1).sum() >= 8 <= (edges == -1).sum():
        return None
    cells = loop_cells(u, edges)
    names, group, counts = np.unique(
        2 * cells + (edges < 0), return_inverse=True, return_counts=True
    )
    means = np.bincount(group, distance) / counts
    first = [k for k in range(names.size - 1) if names[k] % 2 == 0 and names[k + 1] == names[k] + 1]
    if not first:
        return None
    weights = np.zeros(names.size)
    weights[first], weights[np.array(first) + 1] = -1.0 / len(first), 1.0 / len(first)
    # The width is a weighted sum of the samples: least squares with that one column.
    column = (weights / counts)[group]
    power = float(column @ column)
    covariance = coloured_covariance([column[:, None]], [distance - means[group]], names.size)
    std = power * math.sqrt(max(float(covariance[0, 0]), 0.0))
    return Estimate.normal(float(weights @ means), std, "")


def mean_width(records: Sequence[LoopRecord], residuals: Sequence[Floats]) -> float:
    """Mean absolute distance of the branches of the residuals: the remaining loop width.

    Args:
        records: give the direction. Shape `(N_r,)` each.
        residuals: distances from a model. Shape `(N_r,)` each.
    Returns:
        Width, in the unit of the residuals; noise can only increase it.
    """
    widths = [
        loop_width(r.u[r.first :], r.u[r.first :], e[r.first :])
        for r, e in zip(records, residuals, strict=True)
    ]
    return float(np.mean(widths))
