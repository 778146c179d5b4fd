"""Figure 4: the static load test, its linear regions, the operating point."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from haselab.report.analysis import LeftOutError, Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREEN, RED, YELLOW

__all__ = ["PLAN"]


def _regions(axes: Axes, section: Section) -> None:
    regions = section.sections("regions")
    chosen = int(section.number("chosen")) + 1 if "chosen" in section else 0
    if chosen and str(chosen) not in regions:
        raise LeftOutError(
            f"'static.chosen' in analysis.json is not one of {len(regions)} regions."
        )
    for at, region in regions.items():
        stretch, load_n = region.array("stretch"), region.array("load_n")
        if at == str(chosen):
            axes.axvspan(*stretch, color=YELLOW, alpha=0.4, linewidth=0, label="chosen region")
        first = at == "1"
        axes.plot(
            stretch, load_n, color=GREEN, linewidth=2.6, label="linear regions" if first else None
        )
        axes.plot(
            np.mean(stretch),
            np.mean(load_n),
            "*",
            color="black",
            markersize=8,
            zorder=5,
            label="centre of a region" if first else None,
        )


def _static(host: FigureBase, run: RunFolder) -> None:
    section = run.section("static")
    stretch = section.array("stretch")
    load_n = section.array("load_n", like=stretch)
    axes = host.subplots()
    axes.errorbar(
        stretch,
        load_n,
        xerr=section.optional("stretch_std", like=stretch),
        fmt="o",
        color=BLUE,
        markersize=4,
        capsize=2,
        label="measured ± 1 standard deviation of its frames",
    )
    if "fit_stretch" in section:  # only a planar HASEL has the shell of the fit
        fit_stretch = section.array("fit_stretch")
        fit_n = section.array("fit_load_n", like=fit_stretch)
        axes.plot(fit_stretch, fit_n, color=RED, linewidth=1.0, zorder=4, label="Arruda-Boyce fit")
    _regions(axes, section)
    if "operating_point" in section:
        point = section.section("operating_point")
        axes.plot(
            point.number("stretch"),
            point.number("load_n"),
            "D",
            markerfacecolor="none",
            markeredgecolor="black",
            markersize=8,
            zorder=6,
            label="operating point",
        )
    axes.set_xlabel("Stretch λ (1)")
    axes.set_ylabel("Load (N)")
    axes.legend(loc="best")


PLAN = FigurePlan(
    "fig4",
    "Figure 4",
    "static load",
    "Static load test. Measured load against stretch (blue), linear regions of a "
    "piecewise-linear fit with the number of segments of lowest BIC (green) and their centres "
    "(asterisks); for a planar HASEL, Arruda-Boyce fit of the shell with the electrodes' spring "
    "in parallel (orange-red). The yellow band is the region chosen for the experiments; the "
    "diamond is the operating point: the hung weight, and the stretch at the baseline voltage, "
    "which differs from that of the curve at 0 V.",
    (Panel("", "Load against stretch", _static, wide=True, height_in=3.6),),
)
