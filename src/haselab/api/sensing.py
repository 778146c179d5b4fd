"""Capacitance from the monitors of an amplifier, and displacements from a video."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from haselab.api.data import Data, checked_rate, table
from haselab.base import InputError
from haselab.pipelines.sensing.series import DEFAULT_REQUEST
from haselab.pipelines.sensing.source import at_the_actuator, lockin_config
from haselab.pipelines.sensing.table import columns_of
from haselab.pipelines.tracking.points import find_points
from haselab.sensing import Lockin
from haselab.store.columns.table import Table, read_table
from haselab.store.video.opening import open_video
from haselab.tracking import TrackOptions, Tracks, track_frames

__all__ = ["sense", "track"]

Floats = NDArray[np.float64]
Frames: TypeAlias = "str | Path | Iterable[NDArray[np.uint8]]"
_AUTOMATIC = 200  # points at most


def sense(
    data: Data,
    *,
    carrier_hz: float,
    rate_hz: float | None = None,
    v: str = "v_monitor_v",
    i: str = "i_monitor_v",
    block_s: float = 0.01,
    volt_per_monitor_volt: float | None = None,
    ampere_per_monitor_volt: float | None = None,
) -> Table:
    """Capacitance and series resistance, block by block.

    Args:
        data: both monitors: a file, a DataFrame, a Dataset, a table or a dictionary.
        carrier_hz: frequency of the sensing signal, in Hz.
        rate_hz: samples a second, in Hz. None: as the data state it.
        v: column of the voltage monitor, in V; or of the voltage itself, if its unit is kV.
        i: column of the current monitor, in V; or of the current itself, if its unit is A.
        block_s: length of a block, in s.
        volt_per_monitor_volt: scale of the voltage monitor. None: 5000.
        ampere_per_monitor_volt: scale of the current monitor. None: 0.002.
    Returns:
        The columns of `haselab sense`: `time_s`, `capacitance_f`, `capacitance_std_f`,
        `resistance_ohm` and so on; `valid` is 1 where a block can be used.
    Raises:
        InputError: a column that is missing, no rate, or fewer samples than one block.
    """
    found = read_table(data, [v, i]) if isinstance(data, (str, Path)) else table(data)
    missing = [name for name in (v, i) if name not in found.columns]
    if missing:
        raise InputError(
            f"There is no column {missing[0]!r}; the data have {', '.join(found)}. Name v and i."
        )
    rate = checked_rate(found.rate_hz, rate_hz, found[v].size)
    if rate is None:
        raise InputError("The data state no sampling rate. Give rate_hz, or a column time_s.")
    request = replace(
        DEFAULT_REQUEST,
        carrier_hz=carrier_hz,
        volt_per_monitor_volt=volt_per_monitor_volt,
        ampere_per_monitor_volt=ampere_per_monitor_volt,
    )
    units = found.units.get(v), found.units.get(i)
    request = at_the_actuator(units, request, data if isinstance(data, (str, Path)) else "")
    samples = round(block_s * rate)
    blocks = found[v].size // samples if samples else 0
    if blocks == 0:
        raise InputError(
            f"The data have {found[v].size} samples, but one block has {samples}. Record longer, "
            "or use a shorter block_s."
        )
    config = lockin_config(request, rate, samples)
    used = blocks * samples
    sensed = Lockin(config).sense_channels(found[v][:used], found[i][:used])
    columns = columns_of(
        sensed,
        time_s=sensed.time_s,
        volt_per_reading=1.0,
        frequency_hz=carrier_hz,
        reactance_scale=request.reactance_scale,
        capacitance_scale=request.capacitance_scale,
    )
    columns["valid"] = sensed.valid.astype(np.float64)
    return Table(columns, None, time_name="time_s", time_s=columns["time_s"])


def track(
    video: Frames,
    points: Any = None,
    *,
    rate_hz: float | None = None,
    scale_mm_per_px: float | None = None,
    rest_frames: int = 1,
    options: TrackOptions | None = None,
) -> Table:
    """Displacements of points through a video.

    Args:
        video: a file or folder that `haselab track` reads, or frames, shape `(H, W)` each.
        points: positions in the first frame, in px: a DataFrame or dictionary with `x_px` and
            `y_px`, or an array of shape `(P, 2)`. None: found in the first frame.
        rate_hz: frames a second, in Hz. None: as the file states it; frames count from 0.
        scale_mm_per_px: adds `x_mm` and `y_mm`.
        rest_frames: first frames, at rest, that are averaged as the reference.
        options: how to track.
    Returns:
        A row for each point in each frame: `frame`, `time_s`, `point`, `x_px`, `y_px`,
        `std_x_px`, `std_y_px`, `quality`, `valid`.
    Raises:
        InputError: a video that cannot be read, a point outside the frame, too few frames.
    """
    if isinstance(video, (str, Path)):
        with open_video(video) as reader:
            times: list[float] = []

            def frames() -> Iterable[NDArray[np.uint8]]:
                for time_s, frame in reader:
                    times.append(time_s)
                    yield frame

            tracks = _tracked(frames(), points, rest_frames, options)
    else:
        times, tracks = [], _tracked(video, points, rest_frames, options)
    count, each = tracks.x_px.shape
    number = np.repeat(np.arange(count, dtype=np.float64), each)
    time_s = np.repeat(times, each) if times else number
    if rate_hz is not None:
        time_s = number / rate_hz
    columns = {
        "frame": number,
        "time_s": time_s,
        "point": np.tile(np.arange(each, dtype=np.float64), count),
        "x_px": tracks.x_px.ravel(),
        "y_px": tracks.y_px.ravel(),
        "std_x_px": tracks.std_x_px.ravel(),
        "std_y_px": tracks.std_y_px.ravel(),
        "quality": tracks.quality.ravel(),
        "valid": tracks.valid.ravel().astype(np.float64),
    }
    if scale_mm_per_px is not None:
        columns["x_mm"] = scale_mm_per_px * columns["x_px"]
        columns["y_mm"] = scale_mm_per_px * columns["y_px"]
    return Table(columns, rate_hz)


def _tracked(
    frames: Iterable[NDArray[np.uint8]],
    points: Any,
    rest_frames: int,
    options: TrackOptions | None,
) -> Tracks:
    stream = iter(frames)
    head = list(islice(stream, 1))
    if not head:
        raise InputError("The video holds no frame. Give a video with frames.")
    if points is None:
        found = find_points(head[0], _AUTOMATIC, None)
        place, options = found.place_px, options or TrackOptions(subset_px=found.subset_px)
    elif hasattr(points, "keys"):
        place = np.stack([np.asarray(points[key], np.float64) for key in ("x_px", "y_px")], axis=1)
    else:
        place = np.asarray(points, dtype=np.float64)
    return track_frames(chain(head, stream), place, options, rest_frames)
