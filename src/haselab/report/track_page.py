"""The page about one tracked video: paths, strain field, strain and quality over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources

import jinja2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.report.analysis import Array
from haselab.report.numbers import number_text
from haselab.report.style import (
    BLUE,
    GREEN,
    GREY,
    RED,
    SKY,
    band,
    figure_style,
    inline_svg,
    thinned,
    to_svg,
)
from haselab.tracking import LossReason, Tracks, strain_field
from haselab.tracking.audit import LEAST_WRONG, expected_wrong, wrong_share

__all__ = ["TrackReport", "TrackStrain", "track_page"]

_FRAMES_DRAWN = 300
_MOST_DRAWN = 1500
_SHOWN_PX = 1024
_FEWEST_FOR_FIELD = 12
_WRONG_PX = 0.5
_WORDS = {
    LossReason.UNLIKE: "too unlike the reference",
    LossReason.UNCERTAIN: "position too uncertain",
    LossReason.LEFT: "outside the frame",
    LossReason.BENT: "deformed too far",
    LossReason.UNSETTLED: "no convergence",
    LossReason.STRAYED: "moved away from its neighbours",
    LossReason.COVERED: "covered",
    LossReason.UNTIED: "no fixed point found",
    LossReason.AMBIGUOUS: "another position fits the frame as well",
}


@dataclass(frozen=True)
class TrackStrain:
    """Strain of the gauge between upper* and lower*.

    Args:
        time_s, strain, std: of all frames; NaN where unknown. Shape `(F,)`.
        marks: how many marks of the gauge were valid. Shape `(F,)`.
    """

    time_s: Array
    strain: Array
    std: Array
    marks: NDArray[np.intp]


@dataclass(frozen=True)
class TrackReport:
    """What the page shows.

    Args:
        title: of the page.
        frame: the first frame. Shape `(H, W)`.
        rest_px: points at rest. Shape `(P, 2)`.
        gauge: indices of the points of the gauge.
        time_s: times of the frames in `tracks`, or frame numbers if the times are unknown. `(K,)`.
        has_time: whether `time_s` holds times.
        tracks: all points in these frames. Shape `(K, P)`.
        strain: of the gauge; None: there is none.
        facts: name and text, for the table.
        warnings: shown at the top of the page.
    """

    title: str
    frame: NDArray[np.generic]
    rest_px: Array
    gauge: NDArray[np.intp]
    time_s: Array
    has_time: bool
    tracks: Tracks
    strain: TrackStrain | None
    facts: Mapping[str, str]
    warnings: Sequence[str]


@dataclass(frozen=True)
class _Figure:
    name: str
    svg: str
    caption: str
    wide: bool


def track_page(report: TrackReport) -> str:
    """Compose one self-contained HTML document.

    Args:
        report: its contents.

    Returns:
        The page; the same input gives the same bytes.
    """
    parts = (_paths, _motion, _field, _strain, _quality, _std)
    drawn = [part(report) for part in parts]
    style = (
        resources.files("haselab.report")
        .joinpath("templates", "style.css")
        .read_text(encoding="utf-8")
    )
    text = (
        resources.files("haselab.report")
        .joinpath("templates", "track.html.j2")
        .read_text(encoding="utf-8")
    )
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(text).render(
        title=report.title,
        style=style,
        summary=_summary(report),
        warnings=report.warnings,
        figures=[figure for figure in drawn if figure is not None],
        facts=report.facts,
        losses=_losses(report.tracks),
    )


def _summary(report: TrackReport) -> str:
    tracks = report.tracks
    held = 100.0 * float(tracks.valid.mean())
    text = f"{tracks.valid.shape[1]} points, {held:.1f} % of the positions found"
    if tracks.valid.any():
        std = float(np.median(tracks.std_x_px[tracks.valid]))
        text += f", standard deviation {number_text(round(std, 4))} px"
        beyond = float(expected_wrong(_stds(tracks)[:, tracks.valid], _WRONG_PX).sum())
        wrong = wrong_share(beyond, int(tracks.valid.sum()), tracks.valid.size)
        share = f"{100 * wrong:.2g} %" if wrong > LEAST_WRONG else "about 0.01 % or less"
        text += f", expected share wrong by more than {_WRONG_PX:g} px: {share}"
        moved = _moved_px(report)
        if np.isfinite(moved).any():
            text += f", largest median displacement {np.nanmax(moved[1]):.3g} px"
    if report.strain is not None and np.isfinite(report.strain.strain).any():
        low, high = np.nanmin(report.strain.strain), np.nanmax(report.strain.strain)
        text += f", strain of the gauge {_percent(low)} to {_percent(high)} %"
    return text + "."


def _stds(tracks: Tracks) -> Array:
    return np.stack([tracks.std_x_px, tracks.std_y_px])


def _moved_px(report: TrackReport) -> Array:
    """Displacements in each frame: 10 %, median and 90 % of the points. Shape `(3, K)`."""
    tracks = report.tracks
    away = np.hypot(tracks.x_px - report.rest_px[:, 0], tracks.y_px - report.rest_px[:, 1])
    away[~tracks.valid] = np.nan
    found = np.full((3, len(away)), np.nan)
    seen = np.isfinite(away).any(axis=1)
    if seen.any():
        found[:, seen] = np.nanpercentile(away[seen], (10, 50, 90), axis=1)
    return found


def _motion(report: TrackReport) -> _Figure | None:
    low, middle, high = _moved_px(report)
    seen = np.isfinite(middle)
    if not seen.any():
        return None

    def draw(axes: Axes) -> None:
        time_s = report.time_s[seen]
        axes.fill_between(time_s, low[seen], high[seen], color=SKY, alpha=0.4, linewidth=0.0)
        axes.plot(time_s, middle[seen], color=BLUE)
        axes.set_ylim(bottom=0.0)
        _over_time(axes, report, "displacement (px)")

    caption = "Displacement of the points from rest: median, and the range of the middle 80 %."
    return _drawn("motion", "Displacement over time", caption, (4.6, 2.8), draw)


def _percent(part: float) -> str:
    return f"{100 * part:.3f}".replace("-", "−")


def _losses(tracks: Tracks) -> list[tuple[str, str]]:
    """Reasons of invalid positions, with their share of all."""
    if tracks.reason is None:
        return []
    shares = [(word, float(np.mean((tracks.reason & flag) > 0))) for flag, word in _WORDS.items()]
    return [(word, f"{100 * share:.2g} %") for word, share in shares if share > 0.0]


def _drawn(
    name: str, title: str, caption: str, size: tuple[float, float], draw: Callable[[Axes], None]
) -> _Figure:
    with figure_style():
        figure = Figure(figsize=size, layout="constrained")
        draw(figure.subplots())
        return _Figure(name, inline_svg(to_svg(figure, name, title)), caption, size[0] > 5.0)


def _backdrop(axes: Axes, frame: NDArray[np.generic]) -> None:
    """The first frame, at most about 1,000 px wide, in its own coordinates."""
    step = -(-max(frame.shape) // _SHOWN_PX)
    height, width = frame.shape
    low, high = np.percentile(frame[::4, ::4].astype(float), (0.5, 99.5))
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    axes.imshow(
        frame[::step, ::step], cmap="gray", vmin=low, vmax=max(high, low + 1), extent=extent
    )
    axes.grid(False)
    axes.set_xlabel("x (px)")
    axes.set_ylabel("y (px)")


def _paths(report: TrackReport) -> _Figure:
    def draw(axes: Axes) -> None:
        _backdrop(axes, report.frame)
        step = thinned(len(report.time_s), _FRAMES_DRAWN)
        x, y = report.tracks.x_px[step], report.tracks.y_px[step]
        axes.plot(x, y, color=SKY, linewidth=0.8, rasterized=True)
        axes.plot(*report.rest_px.T, ".", color=RED, markersize=2, rasterized=True)
        axes.plot(
            *report.rest_px[report.gauge].T,
            "o",
            markerfacecolor="none",
            markeredgecolor=GREEN,
            markersize=7,
        )

    caption = "Paths of all points on the first frame; dots: positions at rest"
    caption += "; circles: the points of the gauge." if report.gauge.size else "."
    return _drawn("paths", "Paths", caption, _portrait(report), draw)


def _portrait(report: TrackReport) -> tuple[float, float]:
    height, width = report.frame.shape
    return 4.6, float(np.clip(4.2 * height / width, 2.0, 7.0))


def _field(report: TrackReport) -> _Figure | None:
    """Strain along y in the frame with the largest stretch, of those with most valid points."""
    tracks = report.tracks
    if len(report.rest_px) < _FEWEST_FOR_FIELD:
        return None
    moved = np.stack([tracks.x_px, tracks.y_px], axis=-1) - report.rest_px
    held = tracks.valid.sum(axis=1)
    good = held >= max(0.9 * held.max(), 3)
    spread = np.where(good, np.nanstd(np.where(good[:, None], moved[..., 1], 0.0), axis=1), -1.0)
    frame = int(np.argmax(spread))
    std = np.stack([tracks.std_x_px[frame], tracks.std_y_px[frame]], axis=-1)
    try:
        field = strain_field(report.rest_px, moved[frame], std)
    except InputError:
        return None
    strain = 100.0 * field.engineering[:, 1, 1]
    known = np.isfinite(strain) & tracks.valid[frame]
    if not known.any():
        return None
    deviation = 100.0 * float(np.median(field.std[known, 1, 1]))
    low, high = np.percentile(strain[known], (2, 98))

    def draw(axes: Axes) -> None:
        _backdrop(axes, report.frame)
        x, y = tracks.x_px[frame][known], tracks.y_px[frame][known]
        dots = axes.scatter(
            x, y, c=strain[known], s=14, cmap="viridis", vmin=low, vmax=max(high, low + 1e-9)
        )
        figure = axes.figure
        figure.colorbar(dots, ax=axes, label="strain along y (%)", shrink=0.8)

    unit = "s" if report.has_time else ""
    when = f"{'at' if report.has_time else 'in frame'} {report.time_s[frame]:g} {unit}".strip()
    caption = (
        f"Strain along y {when}, where the displacements differ most: at each point from an affine "
        f"fit to its 12 neighbours; median {np.median(strain[known]):.3f} %, standard deviation "
        f"{deviation:.3f} %. The background is the first frame."
    )
    return _drawn("field", "Strain field", caption, _portrait(report), draw)


def _over_time(axes: Axes, report: TrackReport, label: str) -> None:
    axes.set_xlabel("time (s)" if report.has_time else "frame")
    axes.set_ylabel(label)


def _strain(report: TrackReport) -> _Figure | None:
    strain = report.strain
    if strain is None or not np.isfinite(strain.strain).any():
        return None
    step = thinned(len(strain.time_s), _MOST_DRAWN)

    def draw(axes: Axes) -> None:
        x, y, std = strain.time_s[step], 100 * strain.strain[step], 100 * strain.std[step]
        band(axes, x, y, 2.0 * std, BLUE)
        axes.plot(x, y, color=BLUE, linewidth=1.0)
        _over_time(axes, report, "strain (%)")

    caption = (
        "Engineering strain between the means of the points upper* and lower*, with two standard "
        f"deviations ({2e2 * np.nanmedian(strain.std):.2g} %). {_marks(report, strain)}"
    )
    return _drawn("strain", "Strain over time", caption, (9.2, 2.8), draw)


def _marks(report: TrackReport, strain: TrackStrain) -> str:
    """How many marks the strain is computed from."""
    count, known = report.gauge.size, np.isfinite(strain.strain)
    fewer = known & (strain.marks < count)
    text = f"Computed from {count} marks"
    if fewer.any():
        text += f", but from only {strain.marks[fewer].min()} or more in {fewer.sum()} frames"
    if not known.all():
        text += f"; unknown in {np.count_nonzero(~known)} frames"
    return text + "."


def _quality(report: TrackReport) -> _Figure:
    quality, valid = report.tracks.quality, report.tracks.valid

    def draw(axes: Axes) -> None:
        low, middle = np.nanpercentile(quality, (5, 50), axis=1)
        axes.plot(report.time_s, middle, color=BLUE, label="median")
        axes.plot(report.time_s, low, color=SKY, label="lowest 5 %")
        axes.plot(report.time_s, valid.mean(axis=1), color=RED, label="share of points found")
        axes.set_ylim(min(0.5, float(np.nanmin(low))) - 0.02, 1.02)
        _over_time(axes, report, "correlation, share")
        axes.legend(loc="lower right")

    caption = "Correlation with the reference, and share of the points that were found."
    return _drawn("quality", "Quality over time", caption, (4.6, 2.8), draw)


def _std(report: TrackReport) -> _Figure:
    tracks = report.tracks
    seen = np.where(tracks.valid, 1.0, np.nan)

    def draw(axes: Axes) -> None:
        found = tracks.valid.any(axis=1)
        for std, colour, name in ((tracks.std_x_px, BLUE, "x"), (tracks.std_y_px, GREEN, "y")):
            middle = np.nanmedian((std * seen)[found], axis=1)
            axes.plot(report.time_s[found], middle, color=colour, label=f"along {name}")
        axes.set_ylim(bottom=0.0)
        axes.axhline(0.0, color=GREY, linewidth=0.5)
        _over_time(axes, report, "standard deviation (px)")
        axes.legend(loc="lower left")

    caption = "Median standard deviation of a displacement, from the noise and the subset."
    return _drawn("std", "Standard deviation over time", caption, (4.6, 2.8), draw)
