"""A recorded session as one motion: what acted on the actuator, and what was seen of it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import Drive
from haselab.base import InputError
from haselab.identify.physical import MotionRecord
from haselab.pipelines.sensing.series import DEFAULT_REQUEST
from haselab.pipelines.sensing.source import session_config
from haselab.runtime.observer import FIDUCIALS
from haselab.sensing import Lockin, Sensed
from haselab.store.session.layout import ExperimentRecord
from haselab.store.session.reader import SessionReader
from haselab.study.fits.observe import gauge_length

__all__ = ["motion_of_session", "motions_of_session"]

Floats = NDArray[np.float64]
_SAME_S = 1e-7  # times closer than that are one
_LARGE = 300.0  # step in codes, from which its own delay is known to less than a microsecond
_EMPTY = 0.05  # inertia of an empty clamp, of the largest hung mass
_LEAST_KNOWN = 20  # capacitances, from which their law is fitted
_LEAST_RANGE = 1e-3  # of the length, over which they change visibly
_RATIO_STD = 1e-3  # largest standard deviation of the ratio of measured and stated voltage


@dataclass(frozen=True)
class _Blocks:
    """Blocks of an experiment: drive, and what the lock-in found in the samples it uses.

    Args:
        spans_s: beginnings and ends of the samples that count, from a block's first one.
            Shape `(S, 2)`.
        carrier_v: peak of the carrier at the actuator, by the voltage monitor; NaN if it was not
            seen.
        rise: of the voltage monitor at each switch.
        lag_s: of the electrodes' voltage behind the amplifier's, by the series resistance.
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
    rise: _Rise
    lag_s: Floats
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
    return motions_of_session(reader, path, [(lockin, {})])[0]


def motions_of_session(
    reader: SessionReader,
    path: Path,
    lockins: Sequence[tuple[Lockin | None, Mapping[str, Sensed]]],
) -> list[MotionRecord]:
    """The same motion with the capacitances of several lock-ins; the session is read once.

    Args:
        reader: of the session, open.
        path: of the session, for messages.
        lockins: see `motion_of_session`; each with what it has already sensed, by the name of the
            recording. Recordings that are not in it are sensed.
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
    drive = _drive(conditions, blocks.values(), rig)
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
        np.concatenate(block), np.concatenate(weight), _voltage_ratio(blocks.values(), rig),
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
    reader: SessionReader,
    record: ExperimentRecord,
    path: Path,
    lockins: Sequence[tuple[Lockin | None, Mapping[str, Sensed]]],
) -> list[_Blocks]:
    config = session_config(reader, record.codes.shape[1], DEFAULT_REQUEST, path)
    whole = Lockin(config)  # knows when the output is updated
    rise = _rise(record.codes[:, :, 0], whole)
    return [
        _blocks(reader, record, lockin or whole, rise, before.get(record.name))
        for lockin, before in lockins
    ]


def _blocks(
    reader: SessionReader,
    record: ExperimentRecord,
    lockin: Lockin,
    rise: _Rise,
    sensed: Sensed | None,
) -> _Blocks:
    rig, config = reader.header["rig"], lockin.config
    block_s = config.block_samples / config.rate_hz
    if sensed is None:
        sensed = lockin.sense(record.codes)
    middle_s = sensed.time_s - block_s * np.arange(len(record.codes))
    # other models than the plain one use other samples
    plain = np.abs(middle_s - lockin.middle_s) < 0.5 / config.rate_hz
    used = sensed.valid & plain & np.isfinite(sensed.capacitance_f) & (sensed.capacitance_std_f > 0)
    volt_per_code = rig["volt_per_code"] / rig["v_monitor_v_per_v"]
    carrier_v = 0.5 * volt_per_code * float(np.median(sensed.v_pp[used])) if used.any() else np.nan
    farad = _charged_f(record, float(rig["scale_m_per_px"]), sensed, lockin.middle_s,
                       rig["switch_sample"] / config.rate_hz)  # fmt: skip
    ohm = max(float(np.median(sensed.resistance_ohm[used])), 0.0) if used.any() else 0.0
    return _Blocks(
        record.block_start_s, record.drive_v, _spans(lockin) / config.rate_hz,
        sensed.capacitance_f, sensed.capacitance_std_f, used, carrier_v, rise, ohm * farad,
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
    conditions: NDArray[np.void], blocks: Collection[_Blocks], rig: Mapping[str, Any]
) -> Drive:
    """What acted."""
    block_s, switch_s = (rig[name] / rig["rate_hz"] for name in ("block_samples", "switch_sample"))
    gain = float(rig["amplifier_gain"])
    drive_v_per_code = rig["volt_per_code"] / rig["v_monitor_v_per_v"] / gain
    late_s = _late_s(blocks, rig["rate_hz"])
    changes: list[tuple[float, float]] = [
        (float(row["time_s"]), float(row["drive_v"])) for row in conditions
    ]
    # the run begins at rest under its first row, even if another one has the same time
    edges = [conditions["time_s"][:1] - block_s, conditions["time_s"]]
    for part, late in zip(blocks, late_s, strict=True):
        middle_s, half_s = part.start_s + switch_s + late, 0.5 * part.rise.duration / rig["rate_hz"]
        at_once = half_s < _SAME_S
        first_v = np.where(at_once, part.drive_v, drive_v_per_code * part.rise.middle)
        for acts_s, volt in (
            (middle_s - half_s, first_v),
            ((middle_s + half_s)[~at_once], part.drive_v[~at_once]),
        ):
            changes += zip(acts_s.tolist(), volt.tolist(), strict=True)
            edges.append(acts_s)
        edges += [part.start_s, part.start_s + block_s]
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


def _voltage_ratio(blocks: Collection[_Blocks], rig: Mapping[str, Any]) -> float:
    """Voltage by the monitor over drive times gain; NaN if the drive hardly changes."""
    none = np.zeros(0)
    # if no block gives a capacitance, as with a small carrier, the levels are still valid
    any_used = any(part.used.any() for part in blocks)
    chosen = [(part, part.used if any_used else slice(None)) for part in blocks]
    drive_v = np.concatenate([none, *(part.drive_v[used] for part, used in chosen)])
    level = np.concatenate([none, *(part.rise.level[used] for part, used in chosen)])
    if drive_v.size < 2:
        return math.nan
    v_per_code = rig["volt_per_code"] / rig["v_monitor_v_per_v"]
    # the slope of a line does not depend on the monitor's offset
    away_v = float(rig["amplifier_gain"]) * (drive_v - drive_v.mean())
    size = float(away_v @ away_v)
    if size <= (v_per_code / _RATIO_STD) ** 2:  # each level is known to a code or better
        return math.nan
    return float(v_per_code * (away_v @ level) / size)


def _carrier_gain(conditions: NDArray[np.void], blocks: Collection[_Blocks], gain: float) -> float:
    """Of the amplifier at the carrier, in V/V: it resonates or falls there. By its monitor."""
    found = []
    for part in blocks:
        row = np.searchsorted(conditions["time_s"], part.start_s[0], side="right") - 1
        sent_v = float(conditions["carrier_v"][row])
        if sent_v > 0.0 and np.isfinite(part.carrier_v):
            found.append(part.carrier_v / sent_v)
    return float(np.median(found)) if found else gain


def _spans(lockin: Lockin) -> NDArray[np.int64]:
    """First of the samples that count, and the one after, of each uninterrupted part."""
    changes = np.flatnonzero(np.diff(np.pad(lockin.counted, 1).astype(np.int8)))
    return changes.reshape(-1, 2)


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
    # part by part: an index for each sample would take four times as long
    counted = [codes[:, first:end] for first, end in _spans(lockin).tolist()]
    samples = np.concatenate(counted, axis=1, dtype=np.float32)
    voltage = samples @ fit.T.astype(np.float32)
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


@dataclass(frozen=True)
class _Rise:
    """How the voltage monitor follows each switch, in codes and samples, without the carrier.

    Args:
        level: after each switch. Shape `(N,)`.
        change: of the level. Shape `(N,)`.
        area: sum of the blanked samples, less the level that they reach. Shape `(N,)`.
        square_change: of the level's square. Shape `(N,)`.
        square_area: the same sum of the square. Shape `(N,)`.
        large: whether both of these are known well for a single switch. Shape `(N,)`.
        duration: of a step in two equal parts, whose square is on average as far from its ends as
            that of a large switch; 0 of others. Shape `(N,)`.
        middle: level between these parts. Shape `(N,)`.
    """

    level: Floats
    change: Floats
    area: Floats
    square_change: Floats
    square_area: Floats
    large: NDArray[np.bool_]
    duration: Floats
    middle: Floats


def _rise(codes: NDArray[np.int16], lockin: Lockin) -> _Rise:
    """Compare the blanked samples with the levels before and after them.

    The carrier is fitted to the samples after them. Of the first block, the voltage before the
    switch is that of its own samples.
    """
    first, end = lockin.config.blank
    turn = lockin.config.omega_rad_s / lockin.config.rate_hz * np.arange(codes.shape[1])
    carrier = np.stack([np.cos(turn), np.sin(turn)])
    level, size = _without_carrier(codes[:, end:], carrier[:, end:])
    before = np.append(level[:1], level[:-1])
    if first * lockin.config.omega_rad_s >= 2.0 * np.pi * lockin.config.rate_hz:
        before[:1] = _without_carrier(codes[:1, :first], carrier[:, :first])[0]
    after = codes[:, first:end] - size @ carrier[:, first:end]
    change, square_change = level - before, level**2 - before**2
    # a step to the opposite voltage changes no square, hence no force
    large = (np.abs(change) >= _LARGE) & (np.abs(square_change) >= _LARGE**2)
    share = (after[large] ** 2 - before[large, None] ** 2) / square_change[large, None]
    duration = np.zeros(level.size)
    duration[large] = np.maximum(4.0 * (share * (1.0 - share)).sum(axis=1), 0.0)
    middle = np.sqrt(0.5 * (level**2 + before**2))
    return _Rise(
        level, change, (after - level[:, None]).sum(axis=1),
        square_change, (after**2 - level[:, None] ** 2).sum(axis=1),
        large, duration, np.copysign(middle, level + before),
    )  # fmt: skip


def _charged_f(
    record: ExperimentRecord,
    scale_m_per_px: float,
    sensed: Sensed,
    middle_s: float,
    switch_s: float,
) -> Floats:
    """Capacitance of each block at its switch, by its length there.

    In a fast motion, few blocks have a capacitance, and it changes much from one to the next.

    Args:
        record: with the blocks, and the frames if there are any.
        scale_m_per_px: of the frames.
        sensed: capacitances.
        middle_s: time for which these stand, from the beginning of a block.
        switch_s: time of the switch, likewise.
    """
    known = sensed.valid & np.isfinite(sensed.capacitance_f) & (sensed.capacitance_f > 0.0)
    if not known.any():
        return np.zeros(known.size)
    farad = np.where(known, sensed.capacitance_f, np.median(sensed.capacitance_f[known]))
    time_s, length_m, _, _ = _lengths([record], scale_m_per_px)
    if length_m.size < 2 or np.count_nonzero(known) < _LEAST_KNOWN:
        return farad
    at_switch, at_middle = (
        np.interp(record.block_start_s + at_s, time_s, length_m) for at_s in (switch_s, middle_s)
    )
    low_m, high_m = at_middle[known].min(), at_middle[known].max()
    size_m = max(high_m - low_m, _LEAST_RANGE * high_m)

    def powers(lengths_m: Floats) -> Floats:
        return np.vander((np.clip(lengths_m, low_m, high_m) - low_m) / size_m, 3)

    by_length = np.linalg.lstsq(powers(at_middle[known]), np.log(farad[known]), rcond=1e-6)[0]
    now, later = np.exp(powers(at_switch) @ by_length), np.exp(powers(at_middle) @ by_length)
    return np.where(known, farad * now / later, now)


def _without_carrier(codes: NDArray[np.int16], carrier: Floats) -> tuple[Floats, Floats]:
    """Level of each row, shape `(N,)`, and its parts of a carrier, shape `(N, 2)`."""
    basis = np.vstack([np.ones(carrier.shape[1]), carrier])
    fit = np.linalg.pinv(basis).astype(np.float32)
    found = (codes.astype(np.float32) @ fit).astype(np.float64)
    return found[:, 0], found[:, 1:]


def _late_s(blocks: Collection[_Blocks], rate_hz: float) -> list[Floats]:
    """By how much later than requested the voltage of each block acts on the electrodes.

    A large step takes the amplifier longer, up to its limits of current and slew rate; all others
    are delayed equally.
    """
    rises = [part.rise for part in blocks]
    # the generator starts with the first block
    small = [np.flatnonzero(np.abs(rise.change[1:]) < _LARGE) + 1 for rise in rises]
    change, area = (
        np.concatenate([np.zeros(0), *(part[at] for part, at in zip(parts, small, strict=True))])
        for parts in ([rise.change for rise in rises], [rise.area for rise in rises])
    )
    size = float(change @ change)
    usual = -float(change @ area) / size if size > 0.0 else 0.5
    found = []
    for part, rise in zip(blocks, rises, strict=True):
        late = np.full(rise.change.size, usual)
        large = rise.large
        late[large] = -rise.square_area[large] / rise.square_change[large]
        # the first sample still shows the voltage before: half an interval of the sums
        found.append((late - 0.5) / rate_hz + part.lag_s)
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
