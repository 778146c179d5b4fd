"""Figure 9: self-sensed strain compared with the camera."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase

from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREY, RED, legend_below, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 4000


def _sensing(host: FigureBase, run: RunFolder) -> None:
    section = run.section("sensing")
    time_s = section.array("time_s")
    camera = 100.0 * section.array("camera_strain", like=time_s)
    sensed = 100.0 * section.array("sensed_strain", like=time_s)
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    strain, residual = host.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2, 1)})
    strain.plot(time_s[step], camera[step], color=BLUE, linewidth=1.6, label="camera")
    strain.plot(
        time_s[step], sensed[step], color=RED, linewidth=0.9, linestyle="--", label="self-sensed"
    )
    strain.set_ylabel("Strain (%)")
    difference = sensed - camera
    rms = float(np.sqrt(np.nanmean(difference**2)))
    residual.plot(time_s[step], difference[step], color=GREY, linewidth=0.8)
    residual.axhline(0.0, color="black", linewidth=0.6)
    residual.set_ylabel("Residual (%)")
    residual.set_title(f"residual: rms {rms:.2g} %", loc="right")
    residual.set_xlabel("Time (s)")
    legend_below(host, strain, 2)
    host.align_ylabels()


PLAN = FigurePlan(
    "sensing",
    "Figure 9",
    "self-sensing",
    "Strain sensed by capacitance and strain measured by the camera, and their difference in "
    "percentage points of strain.",
    (Panel("", "Self-sensed and tracked strain", _sensing, wide=True, height_in=3.6),),
)
