"""Which points a clip is tracked by: from a table, or found, with the reasons told."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.store.text_file import read_text
from haselab.tracking import (
    PointTracker,
    TrackOptions,
    TrackState,
    detect_fiducials,
    detect_particles,
    find_profile,
    locate_particles,
)
from haselab.tracking.guided import GuidedState, GuidedTracker, find_guides
from haselab.tracking.options import Floats, Frame, Model
from haselab.tracking.particles.follow import ParticleState, ParticleTracker, lone_subset_px

__all__ = [
    "PILOT_FRAMES",
    "Choice",
    "Points",
    "State",
    "Tracker",
    "choose_tracker",
    "find_points",
    "name_gauge",
    "read_points",
    "without_gauge",
]

Tracker = PointTracker | ParticleTracker | GuidedTracker
State = TrackState | ParticleState | GuidedState

PILOT_FRAMES = 24  # by which a tracker is chosen

_FEWEST_FOR_NEIGHBOURS = 12
_MOST_HOLD = 0.9
_HARDLY_HOLD = 0.5
_ON_DOT_PX = 2.0
_DIFFUSED_PX, _DIFFUSED_LOSSY_PX = 0.3, 2.0  # a codec too shakes the points of one body
_MORE_HELD = 0.05  # of the positions, by points that are tracked independently
_WIDENED = 1.1  # of the deviations, by points that do not fit their neighbours
_STRAIGHT_ROW = 0.05  # scatter of a fiducial row across itself, over the rows' distance
_FEWEST_FOR_GAUGE = 30
_GAUGE_BAND = 0.12  # of the height of all particles, from either end
_SUBSET_PX = (15, 41)  # least, most
_CLAMP_SUBSET_PX = 21
_SUBSET_SIGMAS = 7.0


@dataclass(frozen=True)
class Choice:
    """How a clip is tracked.

    Args:
        tracker: of the points.
        state: at rest.
        options: of the tracker.
        why: of its model.
        together: the points moved as one body over the first frames.
    """

    tracker: Tracker
    state: State
    options: TrackOptions
    why: str
    together: bool = False

    @classmethod
    def of(cls, rest: list[Frame], points: Points, options: TrackOptions, why: str) -> Choice:
        """A tracker with these options, at rest."""
        tracker = PointTracker(points.place_px, options)
        return cls(tracker, tracker.init(rest), options, why)


@dataclass(frozen=True)
class Points:
    """Points with their names, and how they were chosen.

    Args:
        names: of the points.
        place_px: positions `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        subset_px: side of a subset that suits them, in px.
        chosen: what was chosen and why, sentence by sentence.
        gauge: which points are `upper1-3` and `lower1-3`, and why; empty without them.
    """

    names: list[str]
    place_px: Floats
    subset_px: int
    chosen: tuple[str, ...] = ()
    gauge: str = ""

    @property
    def why(self) -> tuple[str, ...]:
        """All sentences."""
        return (*self.chosen, *filter(None, [self.gauge]))

    def group(self, prefix: str) -> NDArray[np.intp]:
        """Indices of the points whose name begins so."""
        return np.flatnonzero([name.startswith(prefix) for name in self.names])

    def named(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Indices of points by name.

        Raises:
            InputError: no point has one of the names.
        """
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            raise InputError(f"No point has the name {', '.join(unknown)}. Correct the names.")
        return np.array([self.names.index(name) for name in names], np.intp)


def read_points(path: Path, frame: Frame) -> Points:
    """Points of a table with the columns `point`, `x_px`, `y_px`.

    Args:
        path: of the table.
        frame: the first frame, on which all points must lie.

    Raises:
        InputError: the table cannot be read, or a point lies outside the picture.
    """
    text = read_text(path, "table of points")
    try:
        rows = list(csv.DictReader(text.splitlines()))
    except csv.Error as error:
        raise InputError(f"The table of points is damaged ({error}). {path}") from None
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
    _check_on_picture(names, place, frame, path)
    return Points(names, place, _SUBSET_PX[0])


def _check_on_picture(names: list[str], place: Floats, frame: Frame, path: Path) -> None:
    height, width = frame.shape
    last = np.array([width, height]) - 0.5
    outside = ~((place >= -0.5) & (place <= last)).all(axis=1)
    if outside.any():
        index = int(np.argmax(outside))
        x, y = place[index]
        raise InputError(
            f"{int(outside.sum())} of {len(place)} points lie outside the picture, the first is "
            f"{names[index]!r} at ({x:g}, {y:g}) px; allowed is x from 0 to {width - 1}, y from 0 "
            f"to {height - 1}. Correct them (x right, y down, in px). {path}"
        )


def _clamp_dots(image: Frame) -> tuple[list[str], Floats]:
    """Both rows of three clamp dots; no point where they are not plain."""
    try:
        place = detect_fiducials(image, 6, rows=2)
    except ResultError:
        return [], np.zeros((0, 2))
    rows = place.reshape(2, 3, 2)
    distance = float(rows[1, :, 1].mean() - rows[0, :, 1].mean())
    if np.ptp(rows[:, :, 1], axis=1).max() > _STRAIGHT_ROW * distance:
        return [], np.zeros((0, 2))
    return [f"{row}{k}" for row in ("upper", "lower") for k in (1, 2, 3)], place


def find_points(image: Frame, count: int, subset_px: int | None) -> Points:
    """Particles well spread over the image, and the clamp dots where there are any.

    Args:
        image: the first frame.
        count: of particles, at most.
        subset_px: side of a subset, in px; `None` to choose it by the dots' size.

    Raises:
        ResultError: nothing stands out of the noise.
    """
    profile = find_profile(image)
    names, clamps = _clamp_dots(image)
    gauge = ""
    why = [
        f"{profile.polarity} dots of {profile.sigma_px:g} px standard deviation are the strongest"
    ]
    if subset_px is None:
        least = _CLAMP_SUBSET_PX if names else _SUBSET_PX[0]
        wide = int(_SUBSET_SIGMAS * profile.sigma_px) | 1
        subset_px = min(max(wide, least), _SUBSET_PX[1])
        why.append(
            f"subsets of {subset_px} px: {_SUBSET_SIGMAS:g} deviations of a dot, at least {least}"
        )
    half = subset_px // 2 + 2
    found = detect_particles(
        image, polarity=profile.polarity, sigma_px=profile.sigma_px, count=count, margin_px=half
    )
    if names:
        away = np.linalg.norm(found[:, None] - clamps[None], axis=2).min(axis=1)
        found = found[away > half]
        gauge = "upper1-3, lower1-3: two straight rows of three large dots, taken for clamps"
    why.append(f"{len(found)} particles, strong and far from each other (--count {count})")
    names = names + [f"p{index}" for index in range(len(found))]
    return Points(names, np.concatenate([clamps, found]), subset_px, tuple(why), gauge)


def name_gauge(points: Points) -> Points:
    """Three particles near either end named `upper1-3`, `lower1-3`, as the reference study does.

    Where the clamps carry no dots: of the particles within 12 % of the height from either end,
    those nearest to a quarter, the middle and three quarters of the width.

    Args:
        points: of a sheet that holds together.

    Returns:
        The same points; unchanged when a gauge is named already, or too few are there.

    Source: reference study, row S12 (three points near the lower clamp, averaged).
    """
    if points.group("upper").size or len(points.names) < _FEWEST_FOR_GAUGE:
        return points
    x, y = points.place_px.T
    top, bottom = float(y.min()), float(y.max())
    band = _GAUGE_BAND * (bottom - top)
    names = list(points.names)
    for name, near, level in (
        ("upper", y < top + band, top),
        ("lower", y > bottom - band, bottom),
    ):
        chosen: list[int] = []
        for share in (0.25, 0.5, 0.75):
            place = np.array([x.min() + share * np.ptp(x), level])
            away = np.where(near, np.hypot(x - place[0], y - place[1]), np.inf)
            away[chosen] = np.inf
            chosen.append(int(np.argmin(away)))
        if not near[chosen].all() or len(set(chosen)) < 3:
            return points
        for k, index in enumerate(sorted(chosen, key=lambda index: x[index]), 1):
            names[index] = f"{name}{k}"
    reason = (
        "no clamp dots: upper1-3, lower1-3 are the particles nearest to a quarter, the middle and "
        f"three quarters of the width, within {100 * _GAUGE_BAND:g} % of the height of either end"
    )
    return replace(points, names=names, gauge=reason)


def without_gauge(points: Points) -> Points:
    """The same points, none of them named as a gauge: particles in a liquid have no strain."""
    named = ("upper", "lower")
    names = [
        f"q{index}" if name.startswith(named) else name for index, name in enumerate(points.names)
    ]
    return replace(points, names=names, gauge="")


@dataclass(frozen=True)
class _Pilot:
    """How a tracker does over the first frames.

    Args:
        held: share of the positions that are valid.
        std_px: their standard deviation, mean of each frame. Shape `(F,)`.
        scatter_px: largest rms of a frame's displacements about an affine motion of all; points
            that jump together, or that a codec shakes, do not drift apart, independent ones do.
    """

    held: float
    std_px: Floats
    scatter_px: float

    @property
    def widened(self) -> float:
        """Mean deviation over that of the frame in which it is least."""
        return float(self.std_px.mean() / self.std_px.min()) if self.std_px.size else 1.0


def _pilot(frames: list[Frame], tracker: Tracker, state: State, points: Points) -> _Pilot:
    held, std_px, scatter_px = [], [], [0.0]
    design = np.hstack([points.place_px, np.ones((len(points.names), 1))])
    for frame in frames[:PILOT_FRAMES]:
        state, found = tracker.step(state, frame)  # type: ignore[arg-type]
        valid = found.valid
        held.append(valid.mean())
        if 2 * np.count_nonzero(valid) < len(valid):
            continue
        std_px.append(float(found.std_x_px[valid].mean()))
        moved = (np.stack([found.x_px, found.y_px], axis=1) - points.place_px)[valid]
        left = moved - design[valid] @ np.linalg.lstsq(design[valid], moved, rcond=None)[0]
        scatter_px.append(float(np.sqrt(np.mean(left**2))))
    return _Pilot(float(np.mean(held)), np.array(std_px), max(scatter_px))


def choose_tracker(
    frames: list[Frame],
    rest: list[Frame],
    points: Points,
    options: TrackOptions,
    model: str,
    *,
    lossy: bool = False,
) -> Choice:
    """A tracker of the model asked for; `auto` takes the neighbours where there are enough points.

    Particles that move independently do not hold together: the pilot loses many of them. Each is
    then followed by itself, as long as its identity is certain.
    """
    if model != "auto":
        asked: Model = model  # type: ignore[assignment]
        options = replace(options, model=asked)
        return Choice.of(rest, points, options, f"model {model}: asked for")
    single = "model translation: "
    if len(points.names) < _FEWEST_FOR_NEIGHBOURS:
        guides = find_guides(rest[0], points.place_px, options)
        if len(guides):
            try:
                guided = GuidedTracker(points.place_px, guides, options)
            except InputError:  # all on one line
                return Choice.of(
                    rest, points, options, f"{single}each point is tracked independently"
                )
            why = f"{single}few points; {len(guides)} dots around them identify them"
            return Choice(guided, guided.init(rest), options, why)
        single += f"fewer than {_FEWEST_FOR_NEIGHBOURS} points, each is tracked independently"
        return Choice.of(rest, points, options, single)
    together = replace(options, model="neighbours")
    try:
        tracker = PointTracker(points.place_px, together)
    except InputError:
        single += "the points lie on one line, each is tracked independently"
        return Choice.of(rest, points, options, single)
    state = tracker.init(rest)
    pilot = _pilot(frames, tracker, state, points)
    held, seen = pilot.held, min(len(frames), PILOT_FRAMES)
    told = f"{100 * held:.0f} % of the points hold together over the first {seen} frames"
    bends = not lossy and pilot.widened > _WIDENED
    if (held < _MOST_HOLD or bends) and _on_particles(points, rest[0]):
        lone = replace(options, subset_px=lone_subset_px(rest[0], options.subset_px))
        particles = ParticleTracker(points.place_px, lone)
        at_rest = particles.init(rest)
        alone = _pilot(frames, particles, at_rest, points)
        least_px = _DIFFUSED_LOSSY_PX if lossy else _DIFFUSED_PX
        surer = (
            bends and alone.held >= held and _WIDENED * alone.std_px.mean() < pilot.std_px.mean()
        )
        if alone.scatter_px > least_px and (alone.held > held + _MORE_HELD or surer):
            why = f"particles that move independently: only {told}"
            if surer:
                why = "particles whose motion bends within the distance of their neighbours"
            why += f"; subsets of {lone.subset_px} px"
            return Choice(particles, at_rest, replace(lone, model="translation"), why)
    return Choice(tracker, state, together, f"model neighbours: {told}", held > _MOST_HOLD)


def _on_particles(points: Points, frame: Frame) -> bool:
    """Do most points lie on dots of one kind?"""
    seen = locate_particles(frame, find_profile(frame), margin_px=4).points_px
    if not len(seen):
        return False
    away = np.linalg.norm(points.place_px[:, None] - seen[None], axis=2).min(axis=1)
    return bool(np.mean(away < _ON_DOT_PX) > _HARDLY_HOLD)
