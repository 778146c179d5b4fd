"""Figures that experiments, also those of other packages, describe as data."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from typing import Any

from matplotlib.figure import FigureBase

from haselab.report.analysis import LeftOutError, Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import PALETTE, legend_below

__all__ = ["chart_plans"]

_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,60}", re.IGNORECASE)


def chart_plans(
    analysis: Mapping[str, Any], taken: frozenset[str], after: int
) -> tuple[FigurePlan, ...]:
    """Plan the figures that section `charts` of analysis.json describes.

    Args:
        analysis: parsed analysis.json.
        taken: names of the report's own figures.
        after: number of the last of them.
    Returns:
        One plan per chart, in the file's order. A chart whose name is taken or cannot be a file
        name gets a number instead.
    """
    charts = analysis.get("charts")
    plans, names = [], set(taken)
    for at, chart in enumerate(charts if isinstance(charts, list) else [], start=1):
        if not isinstance(chart, Mapping):
            continue
        name = str(chart.get("name") or "")
        if not _NAME.fullmatch(name) or name in names:
            name = f"chart-{at}"
        names.add(name)
        title = str(chart.get("title") or name)
        panel = Panel("", title, functools.partial(_draw, at, chart), wide=True, height_in=3.2)
        caption = str(chart.get("caption") or "")
        plans.append(FigurePlan(name, f"Figure {after + at}", title, caption, (panel,)))
    return tuple(plans)


def _draw(at: int, chart: Mapping[str, Any], host: FigureBase, run: RunFolder) -> None:
    del run
    section = Section(f"charts.{at}", chart)
    curves = section.sections("curves")
    if not curves:
        raise LeftOutError(f"'charts.{at}.curves' in analysis.json is empty.")
    axes = host.subplots()
    for colour, curve in zip(_colours(len(curves)), curves.values(), strict=True):
        x = curve.array("x")
        axes.plot(
            x, curve.array("y", like=x), color=colour,
            label=curve.text("name"), **_style(curve.flag("points")),
        )  # fmt: skip
    axes.set_xlabel(section.text("x_label"))
    axes.set_ylabel(section.text("y_label"))
    if len(curves) > 1:
        legend_below(host, axes, min(len(curves), 3))


def _colours(count: int) -> list[str]:
    return [PALETTE[k % len(PALETTE)] for k in range(count)]


def _style(points: bool) -> dict[str, Any]:
    return {"linestyle": "", "marker": "o", "markersize": 3.0} if points else {"linewidth": 1.4}
