"""Capacitance from the monitors of an amplifier, and displacements from a video."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from haselab.api.data import Data, numeric_table
from haselab.base import InputError, checked, real_array, shown
from haselab.pipelines.sensing.series import DEFAULT_REQUEST
from haselab.pipelines.sensing.source import at_the_actuator, lockin_config
from haselab.pipelines.sensing.table import columns_of
from haselab.pipelines.tracking.points import (
    PILOT_FRAMES,
    Points,
    choose_tracker,
    find_points,
)
from haselab.pipelines.tracking.stretch import stretch_note
from haselab.sensing import Lockin
from haselab.store.columns.table import Table
from haselab.store.video.opening import open_video
from haselab.tracking import TrackOptions, Tracks, frames_at_rest, track_frames
from haselab.tracking.options import Frame

__all__ = ["sense", "track"]

Floats = NDArray[np.float64]
Frames: TypeAlias = str | Path | Iterable[NDArray[np.uint8]]
_AUTOMATIC = 300  # points at most, as of `haselab track`
_SUBSET_PX = 15  # as of `haselab track --points`


@checked
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
    found = numeric_table(data, [v, i], rate_hz)
    for name in (v, i):
        if not np.isfinite(found[name]).any():
            raise InputError(f"Column {name} has no finite value. Name another column.")
    rate = found.rate_hz
    if rate is None and found.time_s is not None:
        raise InputError(
            f"The times in column {found.time_name} are uneven. Resample the data, or give rate_hz."
        )
    if rate is None:
        raise InputError("The data state no sampling rate. Give rate_hz, or a column time_s.")
    for name, given in (
        ("carrier_hz", carrier_hz),
        ("block_s", block_s),
        ("volt_per_monitor_volt", volt_per_monitor_volt),
        ("ampere_per_monitor_volt", ampere_per_monitor_volt),
    ):
        _positive(name, given)
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
        time_s=sensed.time_s + (0.0 if found.time_s is None else float(found.time_s[0])),
        volt_per_reading=1.0,
        frequency_hz=carrier_hz,
        reactance_scale=request.reactance_scale,
        capacitance_scale=request.capacitance_scale,
    )
    columns["valid"] = sensed.valid.astype(np.float64)
    return Table(columns, None, time_name="time_s", time_s=columns["time_s"])


@checked
def track(
    video: Frames,
    points: Any = None,
    *,
    rate_hz: float | None = None,
    scale_mm_per_px: float | None = None,
    rest_frames: int = 1,
    options: TrackOptions | None = None,
) -> Table:
    """Positions of points through a video.

    Args:
        video: a file or folder that `haselab track` reads, or frames, shape `(H, W)` each.
        points: positions in the first frame, in px: a DataFrame or dictionary with `x_px` and
            `y_px`, or an array of shape `(P, 2)`. None: found in the first frame.
        rate_hz: frames a second, in Hz. None: as the file states it; frames count from 0.
        scale_mm_per_px: adds `x_mm` and `y_mm`, and the displacement from the position at rest,
            `displacement_x_m` and `displacement_y_m`.
        rest_frames: first frames, at rest, that are averaged as the reference; those after the
            first motion are left out.
        options: how to track. None: as `haselab track` with its model `auto`, which lets subsets
            deform as their neighbours move.
    Returns:
        A row for each point in each frame: `frame`, `time_s`, `point`, `x_px`, `y_px`,
        `std_x_px`, `std_y_px`, `quality`, `valid`.
    Raises:
        InputError: a video that cannot be read, a point outside the frame, too few frames.
    """
    for name, given in (("rate_hz", rate_hz), ("scale_mm_per_px", scale_mm_per_px)):
        _positive(name, given)
    times: list[float] = []
    if isinstance(video, (str, Path)):
        with open_video(video) as reader:

            def frames() -> Iterable[NDArray[Any]]:
                for time_s, frame in reader.timed():
                    times.append(time_s)
                    yield frame

            lossy = bool(reader.lossy)
            tracks, rest_px = _tracked(frames(), points, rest_frames, options, lossy)
    else:
        tracks, rest_px = _tracked(video, points, rest_frames, options)
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
        moved_px = np.stack([tracks.x_px, tracks.y_px]) - rest_px.T[:, None]
        columns["displacement_x_m"], columns["displacement_y_m"] = (
            1e-3 * scale_mm_per_px * each_px.ravel() for each_px in moved_px
        )
    return Table(columns, rate_hz)


def _positive(name: str, number: float | None) -> None:
    if number is not None and not 0.0 < number < math.inf:
        raise InputError(f"{name} is {number:g}; it must be above 0 and finite.")


def _tracked(
    frames: Iterable[NDArray[Any]],
    points: Any,
    rest_frames: int,
    options: TrackOptions | None,
    lossy: bool = False,
) -> tuple[Tracks, Floats]:
    """Track the points; also return their positions at rest, in px, shape `(P, 2)`."""
    stream = map(_frame, frames)
    head: list[Frame] = list(islice(stream, max(rest_frames, PILOT_FRAMES)))
    if not head:
        raise InputError("The video holds no frame. Give a video with frames.")
    if points is None:
        found = find_points(head[0], _AUTOMATIC, None)
    else:
        place = _place(points)
        found = Points([str(number) for number in range(len(place))], place, _SUBSET_PX)
    if options is not None or not 1 <= rest_frames <= len(head):
        chosen = options or TrackOptions(subset_px=found.subset_px)
        tracks = track_frames(chain(head, stream), found.place_px, chosen, rest_frames)
        if note := stretch_note(found.place_px, tracks, chosen):
            warnings.warn(f"{note} Use TrackOptions(model='neighbours').", stacklevel=4)
        return tracks, found.place_px
    usual = TrackOptions(subset_px=found.subset_px)
    rest = head[: frames_at_rest(head[:rest_frames], found.place_px, usual)]
    choice = choose_tracker(head, rest, found, usual, "auto", lossy=lossy)
    state, rows = choice.state, []
    for frame in chain(head, stream):
        state, seen = choice.tracker.step(state, frame)  # type: ignore[arg-type]
        rows.append(seen)
    return Tracks.stack(rows), found.place_px


def _frame(frame: NDArray[Any]) -> Frame:
    """A frame of the kind that the tracker takes."""
    if not isinstance(frame, np.ndarray) or frame.ndim != 2 or frame.dtype.kind != "u":
        raise InputError(
            f"A frame is {shown(frame)}; it must be an array of shape (H, W) and type uint8 or "
            "uint16."
        )
    return frame


def _place(points: Any) -> Floats:
    """Positions of points, shape `(P, 2)`."""
    if not hasattr(points, "keys"):
        place = real_array("points", points)
        if place.ndim != 2 or place.shape[1] != 2 or place.size == 0:
            raise InputError(f"points have shape {place.shape}; it must be (P, 2): x_px and y_px.")
        return place
    for name in ("x_px", "y_px"):
        if name not in points:
            raise InputError(f"points have no column {name!r}. Give x_px and y_px.")
    x_px, y_px = (np.atleast_1d(real_array(name, points[name])) for name in ("x_px", "y_px"))
    if x_px.shape != y_px.shape:
        raise InputError(f"points have {x_px.size} x_px and {y_px.size} y_px. Give one for each.")
    return np.stack([x_px, y_px], axis=1)
