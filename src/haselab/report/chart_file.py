"""Charts as SVG, PNG or one HTML page, in the style of all figures."""

from __future__ import annotations

import html
import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.base.chart import Chart, Curve, Panel
from haselab.report.style import (
    BLUE,
    GREY,
    PALETTE,
    band,
    figure_style,
    label_text,
    thinned,
    to_svg,
)
from haselab.store.folder import drafted, write_text

__all__ = ["CHART_ENDINGS", "ChartFigure", "draw_chart", "write_chart", "write_figure"]

CHART_ENDINGS = (".svg", ".png", ".html")
_MOST_SAMPLES = 5000
_Z95 = 1.96
_WIDTH_IN, _PANEL_IN, _REST_IN = 6.3, 2.1, 0.9


class ChartFigure(Figure):
    """A matplotlib figure of a chart, which a notebook shows as it is."""

    @classmethod
    def of(cls, chart: Chart) -> ChartFigure:
        """Draw a chart in the style of all figures.

        Args:
            chart: what to show.
        Returns:
            The figure.
        """
        with figure_style():
            return draw_chart(chart)

    def _repr_svg_(self) -> str:
        with figure_style():
            return to_svg(self, "chart", self.get_suptitle())


def draw_chart(chart: Chart) -> ChartFigure:
    """Draw a chart.

    Args:
        chart: what to show.
    Returns:
        The figure; draw and save it inside `figure_style`.
    """
    count = len(chart.panels)
    height_in = _PANEL_IN * max(count, 1.5) + _REST_IN
    figure = ChartFigure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(count, 1, sharex=chart.shared_x, squeeze=False)[:, 0]
    for place, (ax, panel) in enumerate(zip(axes, chart.panels, strict=True)):
        _draw_panel(ax, panel)
        if not chart.shared_x or place == count - 1:
            ax.set_xlabel(panel.x_label)
    figure.suptitle(label_text(chart.title), fontsize=10)
    return figure


def _draw_panel(axes: Axes, panel: Panel) -> None:
    lines = 0
    for curve in panel.curves:
        colour = GREY if curve.style == "points" else (BLUE, *PALETTE)[lines % 6]
        lines += curve.style != "points"
        _draw_curve(axes, curve, colour)
    axes.set_ylabel(panel.y_label)
    if panel.log_x:
        axes.set_xscale("log")
    if panel.log_y:
        axes.set_yscale("log")
    if panel.y_limits is not None:
        axes.set_ylim(*panel.y_limits)
    if panel.ticks:
        axes.set_xticks(range(len(panel.ticks)), [label_text(text) for text in panel.ticks])
    if any(curve.label for curve in panel.curves):
        axes.legend(loc="best")


def _draw_curve(axes: Axes, curve: Curve, colour: str) -> None:
    every = _drawn(curve.y)
    x, y = curve.x[every], curve.y[every]
    label = label_text(curve.label) if curve.label else None
    if curve.style == "bars":
        axes.bar(x, y, color=colour, width=0.6, label=label)
        return
    if curve.style == "points":
        axes.plot(x, y, ".", color=colour, markersize=2.5, label=label)
    else:
        drawn = "steps-post" if curve.style == "steps" else "default"
        axes.plot(x, y, color=colour, drawstyle=drawn, label=label)
        alone = _alone(y)
        axes.plot(x[alone], y[alone], ".", color=colour, markersize=4.0)
    if curve.std is not None:
        band(axes, x, y, _Z95 * np.asarray(curve.std)[every], colour)


def _drawn(y: NDArray[np.float64]) -> NDArray[np.intp]:
    """Indices of the samples to draw: at most so many, all gaps, and each sample between gaps."""
    some = np.arange(y.size)[thinned(y.size, _MOST_SAMPLES)]
    return np.union1d(some, np.flatnonzero(np.isnan(y) | _alone(y)))


def _alone(y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which samples have gaps or ends on both sides, so that a line does not show them."""
    empty = np.r_[True, np.isnan(y), True]
    return np.asarray(~empty[1:-1] & empty[:-2] & empty[2:])


def write_chart(chart: Chart, path: Path) -> None:
    """Write a chart to a file.

    Args:
        chart: what to show.
        path: ends with .svg, .png or .html.
    Raises:
        InputError: another ending.
    """
    with figure_style():
        write_figure(draw_chart(chart), chart.title, path)


def write_figure(figure: Figure, title: str, path: Path) -> None:
    """Write a figure as a file, inside `figure_style`.

    Args:
        figure: as it was drawn.
        title: what it shows.
        path: ends with .svg, .png or .html.
    Raises:
        InputError: another ending.
    """
    kind = path.suffix.lower()
    if kind not in CHART_ENDINGS:
        raise InputError(
            f"A figure cannot be written as '{kind}'. Use {', '.join(CHART_ENDINGS)}: {path}"
        )
    if kind == ".png":
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        with drafted(path) as draft:
            draft.write_bytes(buffer.getvalue())
        return
    document = to_svg(figure, "chart", title)
    if kind == ".html":
        escaped = html.escape(title)
        document = (
            f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{escaped}</title>\n'
            f"<body>\n{document}\n</body>\n</html>\n"
        )
    write_text(path, document)
