"""A recorded session as one motion: what acted on the actuator, and what was seen of it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
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

__all__ = ["motion_of_session"]

Floats = NDArray[np.float64]
_SAME_S = 1e-7  # times closer than that are one


@dataclass(frozen=True)
class _Blocks:
    """Blocks of an experiment: drive, and what the lock-in found in the window it uses."""

    start_s: Floats
    drive_v: Floats
    from_s: Floats
    capacitance_f: Floats
    std_f: Floats
    used: NDArray[np.bool_]


def motion_of_session(reader: SessionReader, path: Path) -> MotionRecord:
    """Join all experiments of a session to one uninterrupted motion.

    Between the experiments the session's conditions state what acted: drive, carrier and load. In
    the blocks it is their own drive, from the switch on.

    Args:
        reader: of the session, open.
        path: of the session, for messages.
    Returns:
        The motion, which begins when the run began, after the mass has hung for long.
    Raises:
        InputError: The session has no conditions, no rig, or neither lengths nor capacitances.
    """
    conditions = reader.conditions()
    if conditions.size == 0:
        raise InputError(
            "The session does not say what acted on the actuator between its experiments: it was "
            f"recorded by an older version, imported, or by a chip. Record it again. {path}"
        )
    rig = reader.header["rig"]
    block_s = rig["block_samples"] / rig["rate_hz"]
    switch_s = rig["switch_sample"] / rig["rate_hz"]
    records = [reader.experiment(name) for name in reader.names]
    records = [record for record in records if record.name != "particles"]
    blocks = {r.name: _sensed(reader, r, path, block_s) for r in records if len(r.codes)}
    drive, windows = _drive(conditions, blocks, (block_s, switch_s), float(rig["amplifier_gain"]))
    names = tuple(record.name for record in records)
    time_s, length_m, std_m, of_length = _lengths(records, float(rig["scale_m_per_px"]))
    inside = (time_s >= drive.edge_s[0]) & (time_s <= drive.edge_s[-1])
    order = np.argsort(time_s[inside], kind="stable")
    chosen = np.flatnonzero(inside)[order]
    intervals, farad, std_f, of_block = [], [], [], []
    for k, name in enumerate(names):
        if name not in blocks:
            continue
        part = blocks[name]
        intervals.append(windows[name][part.used])
        farad.append(part.capacitance_f[part.used])
        std_f.append(part.std_f[part.used])
        of_block.append(np.full(int(part.used.sum()), k))
    none = np.zeros(0, dtype=np.int64)
    sensed = np.concatenate([none, *intervals])
    by_time = np.argsort(sensed, kind="stable")
    return MotionRecord(
        path.name, drive, time_s[chosen], length_m[chosen], std_m[chosen], sensed[by_time],
        np.concatenate([np.zeros(0), *farad])[by_time],
        np.concatenate([np.zeros(0), *std_f])[by_time],
        names, of_length[chosen], np.concatenate([none, *of_block])[by_time],
    )  # fmt: skip


def _sensed(reader: SessionReader, record: ExperimentRecord, path: Path, block_s: float) -> _Blocks:
    config = session_config(reader, record.codes.shape[1], DEFAULT_REQUEST, path)
    lockin = Lockin(config)
    sensed = lockin.sense(record.codes)
    middle_s = sensed.time_s - block_s * np.arange(len(record.codes))
    usual_s = float(np.median(middle_s))
    plain = np.abs(middle_s - usual_s) < 0.5 / config.rate_hz  # its own model uses other samples
    used = sensed.valid & plain & np.isfinite(sensed.capacitance_f) & (sensed.capacitance_std_f > 0)
    start_s = record.block_start_s
    return _Blocks(
        start_s, record.drive_v, start_s + (2.0 * usual_s - block_s + 1.0 / config.rate_hz),
        sensed.capacitance_f, sensed.capacitance_std_f, used,
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
    blocks: dict[str, _Blocks],
    timing_s: tuple[float, float],
    gain: float,
) -> tuple[Drive, dict[str, NDArray[np.int64]]]:
    """What acted, and the interval in which each block was sensed."""
    block_s, switch_s = timing_s
    changes: list[tuple[float, float]] = [
        (float(row["time_s"]), float(row["drive_v"])) for row in conditions
    ]
    edges = [conditions["time_s"]]
    for part in blocks.values():
        changes += [(float(t) + switch_s, float(v))
                    for t, v in zip(part.start_s, part.drive_v, strict=True)]  # fmt: skip
        edges += [part.start_s, part.start_s + switch_s, part.from_s, part.start_s + block_s]
    ramps = _ramp_edges(conditions)
    edge_s = np.sort(np.concatenate([*edges, ramps]))
    edge_s = edge_s[np.append(True, np.diff(edge_s) > _SAME_S)]
    middle_s = 0.5 * (edge_s[1:] + edge_s[:-1])
    changes.sort(key=lambda change: change[0])  # stable: at one time, the later entry counts
    change_s, change_v = np.array(changes).T
    drive_v = change_v[np.searchsorted(change_s, middle_s, side="right") - 1]
    row = np.searchsorted(conditions["time_s"], middle_s, side="right") - 1
    pull_n = np.interp(middle_s, *_steps(conditions["time_s"], conditions["pull_n"]))
    carrier_v = gain * conditions["carrier_v"][row]
    drive = Drive(edge_s, gain * drive_v, pull_n, conditions["mass_kg"][row], 0.5 * carrier_v**2)
    windows = {
        name: np.searchsorted(edge_s, part.from_s - _SAME_S) for name, part in blocks.items()
    }
    return drive, windows


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
