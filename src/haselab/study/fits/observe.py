"""Convert a recording to physical units: lengths and capacitances over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import JsonObject
from haselab.rig import RigDescription
from haselab.runtime.lockin import printed_chain_of
from haselab.runtime.observer import FIDUCIALS
from haselab.sensing import Lockin, Sensed, step_latencies
from haselab.store.session.writer import ExperimentRecord
from haselab.study.fits.paper_chain import Chain, read_chain
from haselab.study.tables import Sensing

__all__ = ["TRIANGLE", "Observation", "Source", "gauge_length", "observe", "point_spread"]


TRIANGLE = "triangle"  # the paper's sensing chain is computed for this experiment too


@dataclass(frozen=True)
class Observation:
    """One experiment in physical units, B blocks and F frames.

    Args:
        name: of the experiment.
        settings: of the experiment.
        block_start_s: clock at each block's first sample, shape `(B,)`.
        drive_v: requested in each block, shape `(B,)`.
        reference: desired strain, NaN in open loop, shape `(B,)`.
        sensed_s: time of each capacitance, shape `(B,)`.
        capacitance_f: shape `(B,)`, NaN where the carrier was lost.
        relative_capacitance: eqs. 2 and 3, shape `(B,)`.
        frame_time_s: shape `(F,)`.
        length_m: between the clamps, shape `(F,)`.
        spread_m: standard deviation of the lower points' displacements from the first frame about
            their mean, shape `(F,)`; 0 with perfect lengths.
        mass_kg: hung at each frame, shape `(F,)`.
        drop_s: time at which a lifted mass was dropped; NaN if none was.
        latency_s: from the last sample before a block to its output, for each clear step of the
            drive, shape `(n,)`.
        lockin: values of the lock-in for each block.
        printed: values of the paper's sensing chain; None if they are not needed.
        sensed: all results of the lock-in; None if no blocks were recorded.
    """

    name: str
    settings: JsonObject
    block_start_s: NDArray[np.float64]
    drive_v: NDArray[np.float64]
    reference: NDArray[np.float64]
    sensed_s: NDArray[np.float64]
    capacitance_f: NDArray[np.float64]
    relative_capacitance: NDArray[np.float64]
    frame_time_s: NDArray[np.float64]
    length_m: NDArray[np.float64]
    spread_m: NDArray[np.float64]
    mass_kg: NDArray[np.float64]
    drop_s: float
    latency_s: NDArray[np.float64]
    lockin: Chain | None = None
    printed: Chain | None = None
    sensed: Sensed | None = None


# Returns the observation with a name; an analysis has no other access to the session.
Source = Callable[[str], Observation]


def gauge_length(tracks: NDArray[np.void], scale_m_per_px: float) -> NDArray[np.float64]:
    """Distance between the two rows of fiducials, in m.

    Args:
        tracks: fields of `SessionWriter.track_dtype()`, shape `(F, 6)`: upper row, lower row.
        scale_m_per_px: of the camera.
    Returns:
        Shape `(F,)`; frames with a lost fiducial are NaN.
    Source: reference study, row S12: the mean of three points near the lower clamp.
    """
    half = FIDUCIALS // 2
    y_px = np.where(tracks["valid"], tracks["y_px"], np.nan)
    return np.asarray((y_px[:, half:].mean(axis=1) - y_px[:, :half].mean(axis=1)) * scale_m_per_px)


def point_spread(tracks: NDArray[np.void], scale_m_per_px: float) -> NDArray[np.float64]:
    """Spread of the displacements of the three points at the lower clamp, in m.

    Args:
        tracks: as for `gauge_length`.
        scale_m_per_px: of the camera.
    Returns:
        Standard deviation of their displacements from the first frame, shape `(F,)`.
    Source: reference study, row S12 and the band of fig. 5.
    """
    low = tracks[:, FIDUCIALS // 2 :]
    y_px = np.where(low["valid"], low["y_px"], np.nan)
    moved_px = y_px - y_px[np.argmax(np.isfinite(y_px).all(axis=1))]
    return np.asarray(moved_px.std(axis=1, ddof=1) * scale_m_per_px)


def observe(
    record: ExperimentRecord,
    events: list[tuple[float, str]],
    lockin: Lockin,
    sensing: Sensing,
    rig: RigDescription,
) -> Observation:
    """Demodulate the blocks and measure the frames of one experiment."""
    length_m = gauge_length(record.tracks, rig.scale_m_per_px)
    good = np.isfinite(length_m)
    drops = [time for time, what in events if what == f"drop {record.name}"]
    capacitance_f = relative = times_s = np.empty(0)
    sensed = by_lockin = by_chain = None
    if len(record.codes):
        sensed = lockin.sense(record.codes)
        # A block with its own model uses other samples, so its middle differs.
        since_first_s = rig.block_s * np.arange(len(record.codes))
        times_s = record.block_start_s + sensed.time_s - since_first_s
        by_lockin = read_chain(sensed, sensing, rig.volt_per_code)
        capacitance_f, relative = by_lockin.capacitance_f, by_lockin.relative_capacitance
        if record.name == TRIANGLE:
            chain = printed_chain_of(rig, sensing.carrier_hz)
            by_chain = read_chain(chain.sense(record.codes), sensing, rig.volt_per_code)
    return Observation(
        name=record.name,
        settings=record.settings,
        block_start_s=record.block_start_s,
        drive_v=record.drive_v,
        reference=record.reference,
        sensed_s=times_s,
        capacitance_f=capacitance_f,
        relative_capacitance=relative,
        frame_time_s=record.frame_time_s[good],
        length_m=length_m[good],
        spread_m=point_spread(record.tracks, rig.scale_m_per_px)[good],
        mass_kg=record.mass_kg[good],
        drop_s=drops[-1] if drops else float("nan"),
        latency_s=_latencies(record, rig),
        lockin=by_lockin,
        printed=by_chain,
        sensed=sensed,
    )


def _latencies(record: ExperimentRecord, rig: RigDescription) -> NDArray[np.float64]:
    if not len(record.codes) or np.any(np.diff(record.block_start_s) > 1.5 * rig.block_s):
        return np.empty(0)
    return step_latencies(record.codes[:, :, 0], record.drive_v, rig.rate_hz)
