"""Figure 7: Bode plot of the plant and of the loops."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import FigureBase

from haselab.report.analysis import LeftOutError, Section
from haselab.report.figures.bode import bode_axes, decibel, phase_degrees
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREY, PURPLE, RED, SKY, label_text, legend_below

__all__ = ["PLAN"]

_LOOP_COLOURS = (BLUE, PURPLE, "#e69f00", SKY)


def _legend(name: str, controller: Section) -> str:
    margins = []
    if "phase_margin_deg" in controller:
        margins.append(f"phase margin {controller.number('phase_margin_deg'):.1f}°")
    if "gain_margin_db" in controller:
        margins.append(f"gain margin {controller.number('gain_margin_db'):.1f} dB")
    return f"{name}: {', '.join(margins)}" if margins else name


def _loop(host: FigureBase, run: RunFolder) -> None:
    section = run.section("loop")
    omega = section.array("omega_rad_s")
    controllers = section.sections("controllers")
    if not controllers:
        raise LeftOutError("'loop' in analysis.json has no 'controllers'.")
    magnitude, phase = bode_axes(host)
    plant = section.section("plant")
    curves = [("open loop (plant)", plant, RED)]
    curves += [
        (label_text(_legend(name, controller)), controller, _LOOP_COLOURS[at % len(_LOOP_COLOURS)])
        for at, (name, controller) in enumerate(controllers.items())
    ]
    for label, curve, colour in curves:
        gain = curve.array("magnitude", like=omega)
        degrees = phase_degrees(curve.array("phase_rad", like=omega))
        magnitude.plot(omega, decibel(gain), color=colour, label=label)
        phase.plot(omega, degrees, color=colour)
        if "crossover_rad_s" in curve:
            at_rad_s = curve.number("crossover_rad_s")
            magnitude.plot(at_rad_s, 0.0, "o", color=colour, markersize=5)
            at_degrees = float(np.interp(at_rad_s, omega, degrees))
            phase.plot(at_rad_s, at_degrees, "o", color=colour, markersize=5)
    magnitude.axhline(0.0, color=GREY, linewidth=0.8)
    phase.axhline(-180.0, color=GREY, linewidth=0.8)
    legend_below(host, magnitude, 1)


PLAN = FigurePlan(
    "fig7",
    "Figure 7",
    "loops",
    "Bode plot of the plant alone (orange-red, without the delay of the loop) and of the loop with "
    "each controller, including that delay: the scaled PI (blue), the PID (purple). Dots mark the "
    "crossover of the margin; grey lines mark 0 dB and −180°.",
    (Panel("", "Plant and loop", _loop, wide=True, height_in=5.2),),
)
