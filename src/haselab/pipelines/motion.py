"""A recorded session as one motion: what acted on the actuator, and what was seen of it."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import Drive
from haselab.base import InputError
from haselab.identify.physical import MotionRecord
from haselab.pipelines.sensing.series import DEFAULT_REQUEST
from haselab.pipelines.sensing.source import session_config
from haselab.runtime.observer import FIDUCIALS
from haselab.sensing import Lockin
from haselab.store.session.layout import ExperimentRecord
from haselab.store.session.reader import SessionReader
from haselab.study.fits.observe import gauge_length

__all__ = ["motion_of_session", "motions_of_session"]

Floats = NDArray[np.float64]
_SAME_S = 1e-7  # times closer than that are one
_LARGE = 300.0  # step in codes, from which its own delay is known to less than a microsecond
_EMPTY = 0.05  # inertia of an empty clamp, of the largest hung mass


@dataclass(frozen=True)
class _Blocks:
    """Blocks of an experiment: drive, and what the lock-in found in the samples it uses.

    Args:
        spans_s: beginnings and ends of the samples that count, from a block's first one.
            Shape `(S, 2)`.
        carrier_v: peak of the carrier at the actuator, by the voltage monitor; NaN if it was not
            seen.
        rise: of the voltage monitor at each switch, see `_rise`. Shape `(4, N)`.
        weight: of each of those samples' parts in the capacitances, see `_weights`. Shape `(N, S)`.
        later_s: of each capacitance, see `_weights`.
    """

    start_s: Floats
    drive_v: Floats
    spans_s: Floats
    capacitance_f: Floats
    std_f: Floats
    used: NDArray[np.bool_]
    carrier_v: float
    rise: Floats
    weight: Floats
    later_s: Floats


def motion_of_session(
    reader: SessionReader, path: Path, lockin: Lockin | None = None
) -> MotionRecord:
    """Join all experiments of a session to one uninterrupted motion.

    Between the experiments the session's conditions state what acted: drive, carrier and load. In
    the blocks it is their own drive, from the switch on.

    Args:
        reader: of the session, open.
        path: of the session, for messages.
        lockin: whose capacitances are wanted; None: that which uses the most samples.
    Returns:
        The motion, which begins when the run began, after the mass has hung for long.
    Raises:
        InputError: The session has no conditions, no rig, or neither lengths nor capacitances.
    """
    return motions_of_session(reader, path, (lockin,))[0]


def motions_of_session(
    reader: SessionReader, path: Path, lockins: Sequence[Lockin | None]
) -> list[MotionRecord]:
    """The same motion with the capacitances of several lock-ins; the session is read once.

    Args:
        reader: of the session, open.
        path: of the session, for messages.
        lockins: see `motion_of_session`.
    Returns:
        One motion for each.
    Raises:
        InputError: See `motion_of_session`.
    """
    conditions = reader.conditions()
    if conditions.size == 0:
        raise InputError(
            "The session does not say what acted on the actuator between its experiments: it was "
            f"recorded by an older version, imported, or by a chip. Record it again. {path}"
        )
    records: list[ExperimentRecord] = []
    blocks: list[dict[str, _Blocks]] = [{} for _ in lockins]
    for name in reader.names:
        if name == "particles":
            continue
        record = reader.experiment(name)
        if len(record.codes):
            sensed = _sensed(reader, record, path, lockins)
            for found, part in zip(blocks, sensed, strict=True):
                found[name] = part
        records.append(replace(record, codes=record.codes[:0]))  # they are large
    lengths = _lengths(records, float(reader.header["rig"]["scale_m_per_px"]))
    names = tuple(record.name for record in records)
    return [_joined(reader, path, conditions, names, lengths, part) for part in blocks]


def _joined(
    reader: SessionReader,
    path: Path,
    conditions: NDArray[np.void],
    names: tuple[str, ...],
    lengths: tuple[Floats, Floats, Floats, NDArray[np.int64]],
    blocks: Mapping[str, _Blocks],
) -> MotionRecord:
    rig = reader.header["rig"]
    block_s = rig["block_samples"] / rig["rate_hz"]
    switch_s = rig["switch_sample"] / rig["rate_hz"]
    drive = _drive(
        conditions, blocks.values(), _late_s(blocks.values(), rig["rate_hz"]),
        (block_s, switch_s), float(rig["amplifier_gain"]),
    )  # fmt: skip
    time_s, length_m, std_m, of_length = lengths
    inside = (time_s >= drive.edge_s[0]) & (time_s <= drive.edge_s[-1])
    order = np.argsort(time_s[inside], kind="stable")
    chosen = np.flatnonzero(inside)[order]
    none, no = np.zeros(0, dtype=np.int64), np.zeros(0)
    window, window_of, of_block, block = [none], [none], [none], [none]
    weight, farad, std_f, later_s = [no], [no], [no], [no]
    count = 0
    for k, name in enumerate(names):
        if name not in blocks:
            continue
        part = blocks[name]
        intervals, values, weights = _windows(drive, part)
        window.append(intervals)
        window_of.append(values + count)
        weight.append(weights)
        farad.append(part.capacitance_f[part.used])
        std_f.append(part.std_f[part.used])
        later_s.append(part.later_s[part.used])
        of_block.append(np.full(farad[-1].size, k))
        block.append(np.flatnonzero(part.used))
        count += farad[-1].size
    return MotionRecord(
        path.name, drive, time_s[chosen], length_m[chosen], std_m[chosen],
        np.concatenate(window), np.concatenate(window_of), np.concatenate(farad),
        np.concatenate(std_f), names, of_length[chosen], np.concatenate(of_block),
        float(rig.get("exposure_s", 0.0)), float(rig["scale_m_per_px"]),
        np.concatenate(later_s),
        np.concatenate(block), np.concatenate(weight),
    )  # fmt: skip


def _windows(drive: Drive, blocks: _Blocks) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Intervals that count for the used blocks, the block of each, and weights of their seconds."""
    intervals, values, weights = [], [], []
    start_s = blocks.start_s[blocks.used]
    for (low_s, high_s), weight in zip(
        blocks.spans_s.tolist(), blocks.weight[blocks.used].T, strict=True
    ):
        at, end = np.searchsorted(
            drive.edge_s, [start_s + low_s - _SAME_S, start_s + high_s - _SAME_S]
        )
        while (left := at < end).any():
            intervals.append(at[left])
            values.append(np.flatnonzero(left))
            weights.append(weight[left] / (high_s - low_s))
            at = at + 1
    none = np.zeros(0, dtype=np.int64)
    return (
        np.concatenate([none, *intervals]),
        np.concatenate([none, *values]),
        np.concatenate([np.zeros(0), *weights]),
    )


def _sensed(
    reader: SessionReader, record: ExperimentRecord, path: Path, lockins: Sequence[Lockin | None]
) -> list[_Blocks]:
    config = session_config(reader, record.codes.shape[1], DEFAULT_REQUEST, path)
    whole = Lockin(config)  # knows when the output is updated
    rise = _rise(record.codes[:, :, 0], whole)
    return [_blocks(reader, record, lockin or whole, rise) for lockin in lockins]


def _blocks(
    reader: SessionReader, record: ExperimentRecord, lockin: Lockin, rise: Floats
) -> _Blocks:
    rig, config = reader.header["rig"], lockin.config
    block_s = config.block_samples / config.rate_hz
    sensed = lockin.sense(record.codes)
    middle_s = sensed.time_s - block_s * np.arange(len(record.codes))
    # other models than the plain one use other samples
    plain = np.abs(middle_s - lockin.middle_s) < 0.5 / config.rate_hz
    used = sensed.valid & plain & np.isfinite(sensed.capacitance_f) & (sensed.capacitance_std_f > 0)
    changes = np.flatnonzero(np.diff(np.pad(lockin.counted, 1).astype(np.int8)))
    volt_per_code = rig["volt_per_code"] / rig["v_monitor_v_per_v"]
    carrier_v = 0.5 * volt_per_code * float(np.median(sensed.v_pp[used])) if used.any() else np.nan
    return _Blocks(
        record.block_start_s, record.drive_v, changes.reshape(-1, 2) / config.rate_hz,
        sensed.capacitance_f, sensed.capacitance_std_f, used, carrier_v, rise,
        *_weights(record.codes[:, :, 0], lockin),
    )  # fmt: skip


def _lengths(
    records: list[ExperimentRecord], scale_m_per_px: float
) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    times, lengths, stds, member = [], [], [], []
    for k, record in enumerate(records):
        if record.tracks.ndim != 2 or record.tracks.shape[1] != FIDUCIALS:
            continue
        length_m = gauge_length(record.tracks, scale_m_per_px)
        good = np.isfinite(length_m)
        variance = (record.tracks["std_y_px"].astype(np.float64) ** 2).sum(axis=1)
        std_m = scale_m_per_px * np.sqrt(variance) / (FIDUCIALS // 2)
        good &= np.isfinite(std_m) & (std_m > 0.0)
        times.append(record.frame_time_s[good])
        lengths.append(length_m[good])
        stds.append(std_m[good])
        member.append(np.full(int(good.sum()), k))
    none = np.zeros(0)
    return (
        np.concatenate([none, *times]),
        np.concatenate([none, *lengths]),
        np.concatenate([none, *stds]),
        np.concatenate([none.astype(np.int64), *member]),
    )


def _drive(
    conditions: NDArray[np.void],
    blocks: Collection[_Blocks],
    late_s: Sequence[Floats],
    timing_s: tuple[float, float],
    gain: float,
) -> Drive:
    """What acted."""
    block_s, switch_s = timing_s
    changes: list[tuple[float, float]] = [
        (float(row["time_s"]), float(row["drive_v"])) for row in conditions
    ]
    # the run begins at rest under its first row, even if another one has the same time
    edges = [conditions["time_s"][:1] - block_s, conditions["time_s"]]
    for part, late in zip(blocks, late_s, strict=True):
        acts_s = part.start_s + switch_s + late
        changes += zip(acts_s.tolist(), part.drive_v.tolist(), strict=True)
        edges += [part.start_s, acts_s, part.start_s + block_s]
        edges += [part.start_s + at_s for at_s in part.spans_s.ravel().tolist()]
    ramps = _ramp_edges(conditions)
    edge_s = np.sort(np.concatenate([*edges, ramps]))
    edge_s = edge_s[np.append(True, np.diff(edge_s) > _SAME_S)]
    middle_s = 0.5 * (edge_s[1:] + edge_s[:-1])
    changes.sort(key=lambda change: change[0])  # stable: at one time, the later entry counts
    change_s, change_v = np.array(changes).T
    drive_v = change_v[np.maximum(np.searchsorted(change_s, middle_s, side="right") - 1, 0)]
    row = np.maximum(np.searchsorted(conditions["time_s"], middle_s, side="right") - 1, 0)
    pull_n = np.interp(middle_s, *_steps(conditions["time_s"], conditions["pull_n"]))
    carrier_v = _carrier_gain(conditions, blocks, gain) * conditions["carrier_v"][row]
    # nobody sees how fast an actuator without mass moves
    mass_kg = np.maximum(conditions["mass_kg"], _EMPTY * conditions["mass_kg"].max())[row]
    return Drive(edge_s, gain * drive_v, pull_n, mass_kg, 0.5 * carrier_v**2)


def _carrier_gain(conditions: NDArray[np.void], blocks: Collection[_Blocks], gain: float) -> float:
    """Of the amplifier at the carrier, in V/V: it resonates or falls there. By its monitor."""
    found = []
    for part in blocks:
        row = np.searchsorted(conditions["time_s"], part.start_s[0], side="right") - 1
        sent_v = float(conditions["carrier_v"][row])
        if sent_v > 0.0 and np.isfinite(part.carrier_v):
            found.append(part.carrier_v / sent_v)
    return float(np.median(found)) if found else gain


def _weights(codes: NDArray[np.int16], lockin: Lockin) -> tuple[Floats, Floats]:
    r"""How the capacitance of a block follows from that of each moment in it.

    In a number of carrier periods that is not whole, a capacitance that changes in the block
    changes the fitted carrier of the current by the carrier's phase.

    Args:
        codes: of the voltage monitor. Shape `(N, samples)`.
        lockin: that sensed them.
    Returns:
        Weights of the uninterrupted parts that count, shape `(N, S)`, whose sum is 1; by how much
        later than the mean of all parts with these weights a steady rise is sensed, shape `(N,)`.
    """
    at = np.flatnonzero(lockin.counted)
    config = lockin.config
    time_s = at / config.rate_hz
    turn = np.exp(1j * config.omega_rad_s * time_s)
    ramp_s = time_s - time_s.mean()
    # the update of the output moves the level
    side = at >= config.blank[1]
    basis = np.stack([turn.real, turn.imag, side, ~side, ramp_s / np.ptp(ramp_s)], axis=1)
    fit = np.linalg.pinv(basis)[:2]  # to the coefficients of cosine and sine
    voltage = codes[:, at].astype(np.float32) @ fit.T.astype(np.float32)
    current = 1j * (voltage[:, 0] - 1j * voltage[:, 1])  # ahead by a quarter of a period
    size = np.maximum(np.abs(current), np.finfo(np.float32).tiny)
    c, s = current.real / size, -current.imag / size  # c cos + s sin is the current

    def sensed(change: Floats) -> Floats:
        cosine, sine = fit @ np.stack([change * turn.real, change * turn.imag], axis=1)
        found = (cosine[0] * c + cosine[1] * s) * c + (sine[0] * c + sine[1] * s) * s
        return np.asarray(found, dtype=np.float64)

    part = np.cumsum(np.diff(at, prepend=at[:1]) > 1)
    inside = [part == k for k in range(part[-1] + 1)]
    weight = np.stack([sensed(chosen.astype(np.float64)) for chosen in inside], axis=1)
    middle_s = np.array([ramp_s[chosen].mean() for chosen in inside])
    return weight, sensed(ramp_s) - weight @ middle_s


def _rise(codes: NDArray[np.int16], lockin: Lockin) -> Floats:
    """Change and area of the voltage monitor at each switch, and the same of its square.

    The area is the sum of the samples after the switch, less what they reach. Of the first block,
    the voltage before the switch is that of its own samples, in whole periods of the carrier.
    """
    first, end = lockin.config.blank
    period = 2.0 * np.pi * lockin.config.rate_hz / lockin.config.omega_rad_s
    whole = round(int(first / period) * period)
    found = []
    for power in (1, 2):
        level = (codes[:, end:].astype(np.float64) ** power).mean(axis=1)
        before = codes[:1, first - whole : first].astype(np.float64) ** power
        start = before.mean(axis=1) if whole else level[:1]
        after = codes[:, first:end].astype(np.float64) ** power
        found += [np.diff(level, prepend=start), (after - level[:, None]).sum(axis=1)]
    change, area = found[:2]
    small = np.abs(change[1:]) < _LARGE
    if small.any():  # the carrier's part is the same in all
        found[1] = area - area[1:][small].mean()
    return np.stack(found)


def _late_s(blocks: Collection[_Blocks], rate_hz: float) -> list[Floats]:
    """By how much later than requested the voltage of each block acts, by the voltage monitor.

    A large step takes the amplifier longer, up to its limits of current and slew rate; all others
    are delayed equally.
    """
    rises = [part.rise for part in blocks]
    # the generator starts with the first block
    small = [rise[:2, 1:][:, np.abs(rise[0, 1:]) < _LARGE] for rise in rises]
    change, area = np.concatenate([np.zeros((2, 0)), *small], axis=1)
    size = float(change @ change)
    usual = -float(change @ area) / size if size > 0.0 else 0.5
    found = []
    for rise in rises:
        late = np.full(rise.shape[1], usual)
        # a step to the opposite voltage changes no square, hence no force
        large = (np.abs(rise[0]) >= _LARGE) & (np.abs(rise[2]) >= _LARGE**2)
        late[large] = -rise[3, large] / rise[2, large]
        # the first sample still shows the voltage before: half an interval of the sums
        found.append((late - 0.5) / rate_hz)
    return found


def _steps(time_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Times that rise, for interpolation; of two rows at one time, the first is earlier."""
    shifted = time_s - _SAME_S * np.append(np.diff(time_s) < _SAME_S, False)
    return shifted, values


def _ramp_edges(conditions: NDArray[np.void]) -> Floats:
    """Edges inside the times in which the pull changes."""
    found = [np.zeros(0)]
    for before, after in itertools.pairwise(conditions):
        if before["pull_n"] != after["pull_n"] and after["time_s"] - before["time_s"] > _SAME_S:
            found.append(np.linspace(before["time_s"], after["time_s"], 51)[1:-1])
    return np.concatenate(found)
