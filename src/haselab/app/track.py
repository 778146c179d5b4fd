"""`haselab track`: video to displacements and strain."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, TextIO

import click
import numpy as np
from numpy.typing import NDArray

from haselab.app.common import answer_options, emit, progress_bar
from haselab.base import InputError, ResultError
from haselab.store.video import VideoReader, open_video
from haselab.tracking import (
    FrameTracks,
    PointTracker,
    TrackOptions,
    Tracks,
    detect_fiducials,
    detect_particles,
    find_profile,
    gauge_strain,
    link_particles,
    locate_particles,
)
from haselab.tracking.options import Floats, Frame

__all__ = ["command"]

_COLUMNS = ("frame", "time_s", "point", "x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid")
_METRES = ("displacement_x_m", "displacement_y_m")
_FEWEST_FOR_NEIGHBOURS = 12
_PILOT_FRAMES = 24
_MOST_HOLD = 0.9
_STRAIGHT_ROW = 0.05  # scatter of a fiducial row across itself, over the rows' distance


@dataclass(frozen=True)
class _Request:
    """What the user asked for, beyond the video and the answer's place."""

    points: Path | None
    count: int
    rest_frames: int
    scale_mm_per_px: float | None
    rate_hz: float | None
    subset_px: int
    model: str
    reach_px: float
    overlay: Path | None


@dataclass(frozen=True)
class _Points:
    """Points with their names."""

    names: list[str]
    place_px: Floats

    def group(self, prefix: str) -> NDArray[np.intp]:
        """Indices of the points whose name begins so."""
        return np.flatnonzero([name.startswith(prefix) for name in self.names])


def _read_points(path: Path) -> _Points:
    """Points of a table with the columns `point`, `x_px`, `y_px`."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise InputError(f"The points cannot be read ({error.strerror}). {path}") from None
    columns = set(rows[0]) if rows else set()
    if not {"point", "x_px", "y_px"} <= columns:
        raise InputError(
            f"The table of points has the columns {sorted(map(str, columns))}; needed are "
            f"point, x_px, y_px and at least one row. {path}"
        )
    try:
        place = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    except (TypeError, ValueError) as error:
        raise InputError(f"A position is not a number ({error}). Correct it. {path}") from None
    names = [row["point"] for row in rows]
    if len(set(names)) < len(names):
        raise InputError(f"Two points have the same name. Give each its own. {path}")
    return _Points(names, place)


def _clamp_dots(image: Frame) -> _Points:
    """Both rows of three clamp dots; no point where they are not plain."""
    try:
        place = detect_fiducials(image, 6, rows=2)
    except ResultError:
        return _Points([], np.zeros((0, 2)))
    rows = place.reshape(2, 3, 2)
    distance = float(rows[1, :, 1].mean() - rows[0, :, 1].mean())
    if np.ptp(rows[:, :, 1], axis=1).max() > _STRAIGHT_ROW * distance:
        return _Points([], np.zeros((0, 2)))
    return _Points([f"{row}{k}" for row in ("upper", "lower") for k in (1, 2, 3)], place)


def _find_points(image: Frame, request: _Request) -> _Points:
    """Particles well spread over the image, and the clamp dots where there are any."""
    half = request.subset_px // 2 + 2
    clamps = _clamp_dots(image)
    found = detect_particles(image, count=request.count, margin_px=half)
    if len(clamps.place_px):
        away = np.linalg.norm(found[:, None] - clamps.place_px[None], axis=2).min(axis=1)
        found = found[away > half]
    names = clamps.names + [f"p{index}" for index in range(len(found))]
    return _Points(names, np.concatenate([clamps.place_px, found]))


def _moves_as_one(video: VideoReader, tracker: PointTracker, rest: list[Frame]) -> bool:
    """Do the first frames hold together as one sheet? Diffusing particles never do."""
    state, valid = tracker.init(rest), []
    for frame in islice(iter(video), _PILOT_FRAMES):
        state, found = tracker.step(state, frame)
        valid.append(found.valid.mean())
    return float(np.mean(valid)) > _MOST_HOLD


def _tracker(
    video: VideoReader, rest: list[Frame], points: _Points, request: _Request
) -> tuple[PointTracker, TrackOptions]:
    """A tracker of the model asked for; `auto` takes the neighbours where they hold together."""
    options = TrackOptions(subset_px=request.subset_px)
    if request.model != "auto":
        options = replace(options, model=request.model)  # type: ignore[arg-type]
    elif len(points.names) >= _FEWEST_FOR_NEIGHBOURS:
        together = replace(options, model="neighbours")
        try:
            tracker = PointTracker(points.place_px, together)
        except InputError:  # all on one line: each point for itself
            return PointTracker(points.place_px, options), options
        if _moves_as_one(video, tracker, rest):
            return tracker, together
    return PointTracker(points.place_px, options), options


class _Table:
    """The CSV answer, written frame by frame."""

    def __init__(self, file: TextIO, scale_mm_per_px: float | None) -> None:
        self._writer = csv.writer(file, lineterminator="\n")
        self._metres = None if scale_mm_per_px is None else scale_mm_per_px / 1000.0
        metres = () if self._metres is None else _METRES
        self._writer.writerow([*_COLUMNS, *metres])

    def write(
        self, frame: int, time_s: float, names: list[str], found: FrameTracks, rest_px: Floats
    ) -> None:
        """All points of one frame."""
        columns = [found.x_px, found.y_px, found.std_x_px, found.std_y_px, found.quality]
        numbers = np.stack(columns, axis=1)
        moved = numbers[:, :2] - rest_px
        for index, name in enumerate(names):
            row = [frame, f"{time_s:.9g}", name, *(f"{value:.5f}" for value in numbers[index])]
            row.append(int(found.valid[index]))
            if self._metres is not None:
                row += [f"{value * self._metres:.6e}" for value in moved[index]]
            self._writer.writerow(row)


def _timed(video: VideoReader, rate_hz: float | None) -> Iterator[tuple[float, Frame]]:
    """Frames with times; a given rate overrules the file's."""
    for index, (time_s, frame) in enumerate(video.timed()):
        yield (time_s if rate_hz is None else index / rate_hz), frame


def _strain(
    points: _Points, tracks: Tracks, times_s: list[float], out: Path
) -> dict[str, Any] | None:
    """Gauge strain between the points named upper* and lower*, also as a table beside `out`."""
    upper, lower = points.group("upper"), points.group("lower")
    if not upper.size or not lower.size:
        return None
    gauge = gauge_strain(tracks, points.place_px, upper, lower)
    path = out.with_name(out.stem + "-strain.csv")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "time_s", "strain", "strain_std"])
        for index, row in enumerate(zip(times_s, gauge.strain, gauge.std, strict=True)):
            writer.writerow([index, *(f"{value:.9g}" for value in row)])
    return {
        "smallest": float(gauge.strain.min()),
        "largest": float(gauge.strain.max()),
        "std": float(np.median(gauge.std)),
        "rest_length_px": gauge.rest_length_px,
        "table": str(path),
    }


def _track(video: VideoReader, request: _Request, out: Path) -> dict[str, Any]:
    """Points followed by subsets; the answer for the user."""
    rest = list(islice(iter(video), request.rest_frames))
    if len(rest) < request.rest_frames:
        raise InputError(
            f"--rest-frames {request.rest_frames}, but the video has {len(rest)} frames. Lower "
            f"it. {video.path}"
        )
    points = (
        _find_points(rest[0], request) if request.points is None else _read_points(request.points)
    )
    tracker, options = _tracker(video, rest, points, request)
    state = tracker.init(rest)
    rows, times_s, bar = [], [], progress_bar()
    bar.start(video.frame_count)
    with out.open("w", newline="", encoding="utf-8") as file:
        table = _Table(file, request.scale_mm_per_px)
        for index, (time_s, frame) in enumerate(_timed(video, request.rate_hz)):
            state, found = tracker.step(state, frame)
            table.write(index, time_s, points.names, found, points.place_px)
            rows.append(found)
            times_s.append(time_s)
            bar.advance(1, "tracking")
    tracks = Tracks.stack(rows)
    if request.overlay is not None:
        _draw(request.overlay, rest[0], tracks.x_px, tracks.y_px)
    seen = tracks.valid
    if seen.mean() < 0.9:
        click.echo(
            f"haselab: {100 * (1 - seen.mean()):.0f} % of the positions were lost. Particles that "
            "move each for itself need --link.",
            err=True,
        )
    noise = state.noise
    return {
        "points": len(points.names),
        "model": options.model,
        "valid_fraction": float(seen.mean()),
        "median_std_px": float(np.median(tracks.std_x_px[seen])) if seen.any() else None,
        "noise": None if noise is None else {"floor": noise.floor, "slope": noise.slope},
        "strain": _strain(points, tracks, times_s, out),
    }


def _link(video: VideoReader, request: _Request, out: Path) -> dict[str, Any]:
    """Particles found in each frame and linked; the answer for the user."""
    first = next(iter(video))
    profile = find_profile(first)
    particles, times_s, bar = [], [], progress_bar()
    bar.start(video.frame_count)
    for time_s, frame in _timed(video, request.rate_hz):
        particles.append(locate_particles(frame, profile))
        times_s.append(time_s)
        bar.advance(1, "finding particles")
    linked = link_particles([found.points_px for found in particles], reach_px=request.reach_px)
    std = np.concatenate([found.std_px for found in particles])
    strength = np.concatenate([found.strength for found in particles])
    quality = np.minimum(strength / max(float(np.median(strength)), 1e-9), 1.0)
    bounds = np.searchsorted(linked.frame, np.arange(len(particles) + 1))
    start = np.unique(linked.particle, return_index=True)[1]
    with out.open("w", newline="", encoding="utf-8") as file:
        table = _Table(file, request.scale_mm_per_px)
        for index, time_s in enumerate(times_s):
            part = slice(bounds[index], bounds[index + 1])
            x, y, number = linked.x_px[part], linked.y_px[part], linked.particle[part]
            found = FrameTracks(
                x, y, std[part, 0], std[part, 1], quality[part], np.ones(len(x), bool)
            )
            rest = np.stack([linked.x_px, linked.y_px], axis=1)[start[number]]
            table.write(index, time_s, [str(name) for name in number], found, rest)
    if request.overlay is not None:
        x_px, y_px = (np.full((len(times_s), len(start)), np.nan) for _ in range(2))
        x_px[linked.frame, linked.particle] = linked.x_px
        y_px[linked.frame, linked.particle] = linked.y_px
        _draw(request.overlay, first, x_px, y_px)
    return {
        "particles": len(start),
        "sigma_px": profile.sigma_px,
        "polarity": profile.polarity,
        "particles_a_frame": len(linked.frame) / max(len(times_s), 1),
        "median_length_frames": float(np.median(np.bincount(linked.particle))) if len(start) else 0,
    }


def _draw(path: Path, image: Frame, x_px: Floats, y_px: Floats) -> None:
    """The first frame with all paths on it."""
    from matplotlib.figure import Figure

    height, width = image.shape
    figure = Figure(figsize=(8.0, 8.0 * height / width))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(image, cmap="gray", interpolation="nearest")
    axes.plot(x_px, y_px, linewidth=0.8)
    axes.plot(x_px[0], y_px[0], "o", markersize=3, markerfacecolor="none", color="tab:red")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


@click.command()
@click.argument("video", type=click.Path(path_type=Path))
@click.option("--points", type=click.Path(path_type=Path), help="CSV: point, x_px, y_px.")
@click.option("--auto", is_flag=True, help="Find the points (the default without --points).")
@click.option("--count", type=click.IntRange(1), default=300, show_default=True)
@click.option("--rest-frames", type=click.IntRange(1), default=1, show_default=True)
@click.option("--scale-mm-per-px", type=click.FloatRange(0, min_open=True))
@click.option("--rate-hz", type=click.FloatRange(0, min_open=True), help="Overrules the file's.")
@click.option("--subset-px", type=int, default=21, show_default=True, help="Odd.")
@click.option(
    "--model",
    type=click.Choice(["auto", "translation", "neighbours", "affine"]),
    default="auto",
    show_default=True,
)
@click.option("--link", is_flag=True, help="Find particles in each frame and link them.")
@click.option("--reach-px", type=click.FloatRange(0, min_open=True), default=5.0, show_default=True)
@click.option("--overlay", type=click.Path(path_type=Path), help="PNG: the paths on frame 0.")
@answer_options
def command(
    video: Path, auto: bool, link: bool, as_json: bool, out: Path | None, **wishes: Any
) -> None:
    """Video to displacements and strain.

    VIDEO is anything FFmpeg reads, a folder of images, a TIFF stack, .cine or .mraw. Points
    named upper* and lower* (with --auto: the clamps' two rows of three dots) give the strain.
    """
    if out is None:
        raise click.UsageError("--out OUT.csv is needed: the table of tracks goes there.")
    request = _Request(**wishes)
    if request.points is not None and (auto or link):
        raise click.UsageError("--points excludes --auto and --link; give one of them.")
    out.parent.mkdir(parents=True, exist_ok=True)
    with open_video(video) as reader:
        if reader.lossy:
            click.echo(
                "haselab: the video is compressed with loss; positions are two to three times "
                f"less certain than their std says. Record raw, FFV1 or TIFF. {video}",
                err=True,
            )
        answer = (_link if link else _track)(reader, request, out)
        head = {"frames": reader.frame_count, "rate_hz": request.rate_hz or reader.rate_hz}
        answer = {**head, "lossy": reader.lossy, **answer, "table": str(out)}
    emit(answer, as_json=as_json, out=None)
