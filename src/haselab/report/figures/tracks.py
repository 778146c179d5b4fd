"""Figure 2: tracked particles, strain along the length, lateral motion."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase

from haselab.report.analysis import Array, LeftOutError
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREEN, GREY, RED, SKY, scale_by, thinned

__all__ = ["PLAN"]

_FRAMES_DRAWN = 300
_MARGIN = 0.15  # shown beside the paths, as a part of their extent


def _tracks(host: FigureBase, run: RunFolder) -> None:
    section = run.section("tracks")
    x_px = section.rows("x_px")
    y_px = section.rows("y_px", length=x_px.shape[1])
    if x_px.shape != y_px.shape:
        raise LeftOutError("'tracks.x_px' and 'tracks.y_px' in analysis.json differ in length.")
    picked_x = section.array("picked_x_px")
    picked_y = section.array("picked_y_px", like=picked_x)
    axes = host.subplots()
    axes.grid(False)
    frame_name = run.analysis["tracks"].get("frame_png")
    frame = run.picture(str(frame_name)) if frame_name else None
    if frame is not None:
        columns = _shown(np.append(x_px.ravel(), picked_x), frame.shape[1])
        rows = _shown(np.append(y_px.ravel(), picked_y), frame.shape[0])
        edges = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
        axes.imshow(
            frame[rows, columns], cmap="gray", vmin=0.0, vmax=1.0, interpolation="none",
            extent=edges,
        )  # fmt: skip
    else:
        axes.invert_yaxis()
        axes.set_facecolor("#777777")
        axes.set_aspect("equal")
    step = thinned(x_px.shape[0], _FRAMES_DRAWN)
    axes.plot(x_px[step], y_px[step], color=SKY, linewidth=0.7, rasterized=True)
    axes.axvline(section.number("midline_px"), color="white", linewidth=1.2)
    axes.plot(
        picked_x,
        picked_y,
        "o",
        markerfacecolor="none",
        markeredgecolor=GREEN,
        markeredgewidth=1.8,
        markersize=7,
    )
    axes.set_xlabel("x (px)")
    axes.set_ylabel("y (px)")
    if "scale_mm_per_px" in section:
        scale = section.number("scale_mm_per_px")
        right = axes.secondary_yaxis("right", functions=scale_by(scale))
        right.set_ylabel("y (mm)")


def _shown(places_px: Array, size_px: int) -> slice:
    """The part of a picture that shows these places, with a margin."""
    low, high = float(np.nanmin(places_px)), float(np.nanmax(places_px))
    margin = _MARGIN * (high - low) + 1.0
    return slice(max(int(low - margin), 0), min(int(high + margin) + 2, size_px))


def _along(host: FigureBase, run: RunFolder) -> None:
    section = run.section("tracks").section("along")
    position = section.array("position")
    strain = 100.0 * section.array("strain", like=position)
    std = section.optional("strain_std", like=position)
    axes = host.subplots()
    axes.errorbar(
        position,
        strain,
        yerr=None if std is None else 100.0 * std,
        fmt="o",
        color=BLUE,
        markersize=4,
        capsize=2,
        label="local strain ± 1 standard deviation",
    )
    axes.axhline(float(np.nanmean(strain)), color=GREY, linestyle="--", label="mean")
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(*_ylim_from_zero(strain))
    axes.set_xlabel("Position along the length (1)")
    axes.set_ylabel("Strain (%)")
    axes.legend(loc="best")


def _ylim_from_zero(values: Array) -> tuple[float, float]:
    """Limits that include zero, so that homogeneity is judged relative to the strain."""
    low, high = min(0.0, float(np.nanmin(values))), max(0.0, float(np.nanmax(values)))
    margin = 0.2 * (high - low or 1.0)
    return low - (margin if low < 0.0 else 0.0), high + (margin if high > 0.0 else 0.0)


def _lateral(host: FigureBase, run: RunFolder) -> None:
    section = run.section("tracks").section("lateral")
    distance = section.array("distance_mm")
    motion = section.array("motion_mm", like=distance)
    axes = host.subplots()
    many = distance.size > 400
    axes.plot(distance, motion, "o", color=RED, markersize=3, alpha=0.7, rasterized=many)
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.set_xlabel("Distance from the mid-line (mm)")
    axes.set_ylabel("Lateral motion (mm)")


PLAN = FigurePlan(
    "fig2",
    "Figure 2",
    "tracking",
    "Automatic tracking. A: paths of all tracked particles over the first frame, with the "
    "mid-line (white) and the three points picked for the strain (green circles). B: strain of "
    "slices along the length (0 at the fixed clamp, 1 at the load); a horizontal line means a "
    "homogeneous stretch. C: lateral motion of each particle (positive: to the right) against "
    "its distance from the mid-line; the free sides move most.",
    (
        Panel("A", "Particle paths", _tracks, wide=True, height_in=2.6),
        Panel("B", "Strain along the length", _along, height_in=3.3),
        Panel("C", "Lateral motion", _lateral, height_in=3.3),
    ),
)
