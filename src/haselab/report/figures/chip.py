"""Figures 11 and 12: the loop on the microcontroller compared with those of the desktop."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import FigureBase

from haselab.report.analysis import Array, LeftOutError, Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import GREEN, PALETTE, label_text, legend_below, thinned

__all__ = ["MINIATURE", "PLAN", "draw_loops"]

_SAMPLES_DRAWN = 5000
_BAND = 0.05


def draw_loops(host: FigureBase, section: Section) -> None:
    """Draw the responses of several loops to one step.

    Args:
        host: figure for the axes.
        section: `desired` and `loops`, each with `time_s` and `strain`.
    Raises:
        LeftOutError: the section lacks them.
    """
    loops = section.sections("loops")
    if not loops:
        raise LeftOutError(f"'{section.name}' in analysis.json has no 'loops'.")
    axes = host.subplots()
    settled_s, first_s, last_s = 0.0, math.inf, -math.inf
    for name, data, colour, width in [
        ("desired", section.section("desired"), GREEN, 1.8),
        *((name, loop, PALETTE[k % len(PALETTE)], 1.2) for k, (name, loop) in
          enumerate(loops.items())),
    ]:  # fmt: skip
        time_s = data.array("time_s")
        strain = 100.0 * data.array("strain", like=time_s)
        step = thinned(time_s.size, _SAMPLES_DRAWN)
        axes.plot(time_s[step], strain[step], color=colour, linewidth=width, label=label_text(name))
        settled_s = max(settled_s, _settled_s(time_s, strain))
        first_s, last_s = min(first_s, time_s[0]), max(last_s, time_s[-1])
    if settled_s > 0.0:  # a loop that does not settle must not leave half of the figure empty
        axes.set_xlim(max(-0.25 * settled_s, first_s), min(2.5 * settled_s, last_s))
    axes.set_xlabel("Time (s)")
    axes.set_ylabel("Strain (%)")
    legend_below(host, axes, 4)


def _settled_s(time_s: Array, strain: Array) -> float:
    """When a response has come within a twentieth of its way from where it ends."""
    end = float(np.nanmean(strain[-max(1, strain.size // 10) :]))
    off = np.abs(strain - end) > _BAND * abs(end - strain[0])
    return float(time_s[off][-1]) if off.any() else 0.0


def _loops(host: FigureBase, run: RunFolder) -> None:
    draw_loops(host, _played(run, "chip"))


def _miniature(host: FigureBase, run: RunFolder) -> None:
    draw_loops(host, _played(run, "miniature"))


def _played(run: RunFolder, name: str) -> Section:
    """A section of analysis.json with responses; it may hold the reason why there are none."""
    section = run.section(name)
    reason = run.analysis[name].get("left_out") if isinstance(run.analysis[name], Mapping) else ""
    if reason:
        raise LeftOutError(str(reason))
    return section


PLAN = FigurePlan(
    "chip",
    "Figure 11",
    "microcontroller",
    "One step with three loops with the same gains: the desktop at 100 Hz, the desktop at the "
    "microcontroller's rate and delay, and the microcontroller (chip) in co-simulation. As in "
    "figure 6, a triangle was played before the step, unless the figure comes from 'haselab "
    "firmware simulate --precondition 0': an actuator that was never stretched softens during the "
    "step and overshoots more (docs/control/firmware.md). Desktop: true strain of one trial. "
    "Chip: mean of its trials, measured by the camera, or the true strain of one trial after "
    "'haselab firmware simulate'. The ringing is included.",
    (Panel("", "From the bench to the chip", _loops, wide=True, height_in=3.2),),
    needs="chip",
)
MINIATURE = FigurePlan(
    "miniature",
    "Figure 12",
    "miniature bench",
    "The miniature bench: the microcontroller computes phase, strain and controller, and a "
    "commercial supply on a serial line provides the high voltage. The supply reaches half of the "
    "study's voltage, so zero strain and step differ from those of figure 6 (row S28). Mean of the "
    "trials, measured by the camera, in co-simulation with the same actuator.",
    (Panel("", "Miniature bench", _miniature, wide=True, height_in=3.2),),
    needs="miniature",
)
