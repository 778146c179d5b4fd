"""Choose the points to track, from a table or found in a frame, and the tracker."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.store.text_file import read_text
from haselab.tracking import (
    DotProfile,
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
    "points_table",
    "read_points",
    "without_gauge",
]

Tracker = PointTracker | ParticleTracker | GuidedTracker
State = TrackState | ParticleState | GuidedState

PILOT_FRAMES = 24  # used to choose a tracker

_FEWEST_FOR_NEIGHBOURS = 12
_MOST_HOLD = 0.9
_HARDLY_HOLD = 0.5
_ON_DOT_PX = 2.0
_DIFFUSED_PX, _DIFFUSED_LOSSY_PX = 0.3, 2.0  # a codec also moves the points of one body
_MORE_VALID = 0.05  # further share of positions found when points are tracked independently
_WIDENED = 1.1  # ratio of the deviations when points do not fit their neighbours
_STRAIGHT_ROW = 0.05  # scatter of a row of fiducials across it, relative to the rows' distance
_FEWEST_FOR_GAUGE = 30
_GAUGE_BAND = 0.12  # of the height of all particles, from either end
_TILTED_DEG = 1.0  # of the gauge, above which it is stated
_NO_GAUGE = (
    f"no strain: fewer than three particles are within {100 * _GAUGE_BAND:g} % of the height of "
    "one end; name the points with --points"
)
_SUBSET_PX = (15, 41)  # least, most
_CLAMP_SUBSET_PX = 21
_SUBSET_SIGMAS = 7.0


@dataclass(frozen=True)
class Choice:
    """The chosen tracker, and why.

    Args:
        tracker: of the points.
        state: at rest.
        options: of the tracker.
        why: reason for the model.
        together: the points moved as one body in the first frames.
    """

    tracker: Tracker
    state: State
    options: TrackOptions
    why: str
    together: bool = False

    @classmethod
    def of(cls, rest: list[Frame], points: Points, options: TrackOptions, why: str) -> Choice:
        """Make a tracker with these options, at rest."""
        tracker = PointTracker(points.place_px, options)
        return cls(tracker, tracker.init(rest), options, why)


@dataclass(frozen=True)
class Points:
    """Points with their names, and how they were chosen.

    Args:
        names: of the points.
        place_px: positions `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        subset_px: suitable side of a subset, in px.
        chosen: what was chosen and why, one sentence each.
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
        """Indices of the points whose name has this prefix."""
        return np.flatnonzero([name.startswith(prefix) for name in self.names])

    def named(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Indices of points by name.

        Raises:
            InputError: no point has one of the names.
        """
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            raise InputError(f"No point has the name {', '.join(unknown)}. Use names of points.")
        return np.array([self.names.index(name) for name in names], np.intp)


def read_points(path: Path, frame: Frame) -> Points:
    """Read points from a table with the columns `point`, `x_px`, `y_px`.

    Args:
        path: of the table.
        frame: the first frame, which must contain all points.

    Raises:
        InputError: the table cannot be read, or a point is outside the frame.
    """
    text = read_text(path, "table of points")
    try:
        rows = list(csv.DictReader(text.splitlines()))
    except csv.Error as error:
        raise InputError(f"The table of points is damaged ({error}). {path}") from None
    columns = set(rows[0]) if rows else set()
    if not {"point", "x_px", "y_px"} <= columns:
        raise InputError(
            f"The table of points has the columns {', '.join(sorted(map(str, columns)))}, but must "
            f"have point, x_px, y_px and at least one row. {path}"
        )
    try:
        place = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    except (TypeError, ValueError) as error:
        raise InputError(
            f"A position in the table of points is not a number ({error}). Change it. {path}"
        ) from None
    names = [row["point"] for row in rows]
    _check_points(names, place, frame, path)
    return Points(names, place, _SUBSET_PX[0])


def points_table(points: Points, frame: Frame, path: Path) -> str:
    """Make the table that `read_points` reads, to 0.001 px.

    Args:
        points: to be tracked.
        frame: the first frame, which must contain all points.
        path: where the table will be, for messages.

    Returns:
        CSV with the columns `point`, `x_px`, `y_px`.

    Raises:
        InputError: there is no point, a name is empty, used twice or not printable, or a point is
            outside the frame or cannot be tracked.
    """
    if not points.names:
        raise InputError("There is no point to save. Pick at least one point.")
    for name in points.names:
        if not name.strip() or not name.isprintable():
            raise InputError(
                f"A point has the name {name!r}. Give it a name of printable characters."
            )
    _check_points(points.names, points.place_px, frame, path)
    PointTracker(points.place_px, TrackOptions(subset_px=points.subset_px)).init([frame])
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["point", "x_px", "y_px"])
    for name, (x, y) in zip(points.names, points.place_px.tolist(), strict=True):
        table.writerow([name, f"{x:.3f}", f"{y:.3f}"])
    return text.getvalue()


def _check_points(names: list[str], place: Floats, frame: Frame, path: Path) -> None:
    """Refuse names that are used twice, and points outside the frame."""
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"Two points have the same name, {twice!r}. Rename one of them. {path}")
    height, width = frame.shape
    last = np.array([width, height]) - 0.5
    outside = ~((place >= -0.5) & (place <= last)).all(axis=1)
    if outside.any():
        index = int(np.argmax(outside))
        x, y = place[index]
        raise InputError(
            f"{int(outside.sum())} of {len(place)} points are outside the frame, the first is "
            f"{names[index]!r} at ({x:g}, {y:g}) px. Use x from 0 to {width - 1} and y from 0 to "
            f"{height - 1} (x right, y down, in px). {path}"
        )


def _clamp_dots(image: Frame) -> tuple[list[str], Floats]:
    """Find both rows of three clamp dots; no points if they are not clear."""
    try:
        place = detect_fiducials(image, 6, rows=2)
    except ResultError:
        return [], np.zeros((0, 2))
    rows = place.reshape(2, 3, 2)
    distance = float(rows[1, :, 1].mean() - rows[0, :, 1].mean())
    if np.ptp(rows[:, :, 1], axis=1).max() > _STRAIGHT_ROW * distance:
        return [], np.zeros((0, 2))
    return [f"{row}{k}" for row in ("upper", "lower") for k in (1, 2, 3)], place


def find_points(
    image: Frame, count: int, subset_px: int | None, profile: DotProfile | None = None
) -> Points:
    """Find particles, well spread over the image, and the clamp dots if there are any.

    Args:
        image: the first frame.
        count: maximum number of particles.
        subset_px: side of a subset, in px; `None`: chosen from the size of the dots.
        profile: of the particles, as `find_profile` finds it; `None`: it is searched.

    Raises:
        ResultError: nothing exceeds the noise.
    """
    profile = find_profile(image) if profile is None else profile
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
        image, polarity=profile.polarity, sigma_px=profile.sigma_px, count=count, margin_px=half,
        subset_px=subset_px,
    )  # fmt: skip
    if names:
        away = np.linalg.norm(found[:, None] - clamps[None], axis=2).min(axis=1)
        found = found[away > half]
        gauge = (
            "upper1-3, lower1-3: two straight rows of three large dots, assumed to be the clamps"
        )
    why.append(f"{len(found)} particles, strong and far apart (--count {count})")
    names = names + [f"p{index}" for index in range(len(found))]
    return Points(names, np.concatenate([clamps, found]), subset_px, tuple(why), gauge)


def name_gauge(points: Points) -> Points:
    """Name three particles near each end `upper1-3` and `lower1-3`, as the reference study does.

    If the clamps have no dots, these are particles within 12 % of the height from an end. The upper
    ones are nearest to a quarter, half and three quarters of the width, the lower ones below them.

    Args:
        points: of a sheet that holds together.

    Returns:
        The points; unchanged if a gauge is already named, or there are too few points.

    Source: reference study, row S12 (three points near the lower clamp, averaged).
    """
    if points.group("upper").size or len(points.names) < _FEWEST_FOR_GAUGE:
        return points
    x, y = points.place_px.T
    top, bottom = float(y.min()), float(y.max())
    band = _GAUGE_BAND * (bottom - top)
    names, middles = list(points.names), []
    across = x.min() + np.array([0.25, 0.5, 0.75]) * np.ptp(x)
    for name, near, level in (
        ("upper", y < top + band, top),
        ("lower", y > bottom - band, bottom),
    ):
        chosen: list[int] = []
        for place in across:
            along = (y - level) if name == "upper" else 0.0
            away = np.where(near, np.hypot(x - place, along), np.inf)
            away[chosen] = np.inf
            chosen.append(int(np.argmin(away)))
        if not near[chosen].all() or len(set(chosen)) < 3:
            return replace(points, chosen=(*points.chosen, _NO_GAUGE))
        across = x[chosen]  # the lower ones are those below them, so that the line is hardly tilted
        middles.append(points.place_px[chosen].mean(axis=0))
        for k, index in enumerate(sorted(chosen, key=lambda index: x[index]), 1):
            names[index] = f"{name}{k}"
    reason = (
        "no clamp dots: upper1-3 are the particles nearest to a quarter, half and three quarters "
        f"of the width, lower1-3 those below them, within {100 * _GAUGE_BAND:g} % of the height of "
        "an end"
    )
    tilt_deg = math.degrees(math.atan2(*np.abs(middles[1] - middles[0])))
    if tilt_deg > _TILTED_DEG:
        reason += (
            f"; the line between them is tilted by {tilt_deg:.1f} deg, and the strain is along it"
        )
    return replace(points, names=names, gauge=reason)


def without_gauge(points: Points) -> Points:
    """Remove the names of the gauge: particles in a liquid have no strain."""
    named = ("upper", "lower")
    names = [
        f"q{index}" if name.startswith(named) else name for index, name in enumerate(points.names)
    ]
    return replace(points, names=names, gauge="")


@dataclass(frozen=True)
class _Pilot:
    """Performance of a tracker in the first frames.

    Args:
        held: share of the positions that are valid.
        std_px: their standard deviation, mean of each frame. Shape `(F,)`.
        scatter_px: largest rms deviation of a frame's displacements from a common affine motion. It
            is large for points that move independently, not for those that jump together.
    """

    held: float
    std_px: Floats
    scatter_px: float

    @property
    def widened(self) -> float:
        """Ratio of the mean deviation to that of the best frame."""
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
    """Choose a tracker with the requested model; `auto` uses neighbours if there are enough points.

    If particles move independently, a tracker with neighbours loses many of them in the first
    frames. Each is then followed separately, as long as its identity is certain.
    """
    if model != "auto":
        asked: Model = model  # type: ignore[assignment]
        options = replace(options, model=asked)
        return Choice.of(rest, points, options, f"model {model}: requested")
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
            why = f"{single}few points, identified by {len(guides)} dots around them"
            return Choice(guided, guided.init(rest), options, why)
        single += f"fewer than {_FEWEST_FOR_NEIGHBOURS} points, each is tracked independently"
        return Choice.of(rest, points, options, single)
    together = replace(options, model="neighbours")
    try:
        tracker = PointTracker(points.place_px, together)
    except InputError:
        single += "the points are on one line, each is tracked independently"
        return Choice.of(rest, points, options, single)
    state = tracker.init(rest)
    pilot = _pilot(frames, tracker, state, points)
    held, seen = pilot.held, min(len(frames), PILOT_FRAMES)
    share = f"{100 * held:.0f} % of the points hold together over the first {seen} frames"
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
        if alone.scatter_px > least_px and (alone.held > held + _MORE_VALID or surer):
            why = f"particles that move independently: only {share}"
            if surer:
                why = "particles whose motion varies strongly between neighbours"
            why += f"; subsets of {lone.subset_px} px"
            return Choice(particles, at_rest, replace(lone, model="translation"), why)
    return Choice(tracker, state, together, f"model neighbours: {share}", held > _MOST_HOLD)


def _on_particles(points: Points, frame: Frame) -> bool:
    """Whether most points are on dots of one kind."""
    seen = locate_particles(frame, find_profile(frame), margin_px=4).points_px
    if not len(seen):
        return False
    away = np.linalg.norm(points.place_px[:, None] - seen[None], axis=2).min(axis=1)
    return bool(np.mean(away < _ON_DOT_PX) > _HARDLY_HOLD)
