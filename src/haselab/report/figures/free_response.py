"""Figure 5: the free response after the mass is dropped."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from haselab.report.analysis import LeftOutError, Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREEN, PURPLE, RED, SKY, band, label_text, legend_below

__all__ = ["PLAN"]

_COLOURS = (BLUE, RED, "#e69f00", "#000000")
_FITS = (
    ("printed_m", "eq. 6 as printed", ":"),
    ("creeping_m", "eq. 6 with a creep term", (0, (6, 2))),
)
_ENVELOPES = (("positive", GREEN, "^"), ("negative", PURPLE, "v"))


def _envelopes(axes: Axes, trial: Section, *, named: bool) -> None:
    time_s = trial.array("time_s")
    for side, colour, marker in _ENVELOPES:
        envelope_m = trial.optional(f"envelope_{side}_m", like=time_s)
        if envelope_m is not None:
            label = f"envelope of the {side} peaks" if named else None
            axes.plot(time_s, 1e3 * envelope_m, color=colour, linestyle="--", label=label)
        if f"peaks_{side}" in trial:
            peaks = trial.section(f"peaks_{side}")
            at_s = peaks.array("time_s")
            peak_mm = 1e3 * peaks.array("m", like=at_s)
            axes.plot(at_s, peak_mm, marker, color=colour, markersize=5)


def _free_response(host: FigureBase, run: RunFolder) -> None:
    section = run.section("free_response")
    trials = section.sections("trials")
    if not trials:
        raise LeftOutError("'free_response' in analysis.json has no 'trials'.")
    axes = host.subplots()
    for at, (name, trial) in enumerate(trials.items()):
        time_s = trial.array("time_s")
        moved_mm = 1e3 * trial.array("displacement_m", like=time_s)
        std_m = trial.optional("displacement_std_m", like=time_s)
        colour = _COLOURS[at % len(_COLOURS)]
        axes.plot(time_s, moved_mm, color=colour, linewidth=1.1, label=label_text(f"trial {name}"))
        band(axes, time_s, moved_mm, None if std_m is None else 1e3 * std_m, colour)
        for key, label, line in _FITS:
            fit_m = trial.optional(key, like=time_s)
            if fit_m is not None:
                axes.plot(
                    time_s, 1e3 * fit_m, color="black", linestyle=line, linewidth=0.9,
                    label=label if at == 0 else None,
                )  # fmt: skip
        _envelopes(axes, trial, named=at == 0)
    if "mean_m" in section:
        time_s = section.array("time_s")
        mean_mm = 1e3 * section.array("mean_m", like=time_s)
        axes.plot(time_s, mean_mm, color=SKY, linewidth=2.0, zorder=1, label="mean of the trials")
    axes.set_xlabel("Time after the drop (s)")
    axes.set_ylabel("Displacement Δx (mm)")
    legend_below(host, axes, 3)


PLAN = FigurePlan(
    "fig5",
    "Figure 5",
    "free response",
    "Free response at the operating voltage: the mass is lifted and dropped. Displacement "
    "relative to the final value of eq. 6: trials (blue, orange-red) with the standard "
    "deviation of the three tracked points as bands, their mean (light blue), eq. 6 as printed "
    "(dotted) and with an exponential creep term (dashed), and the exponential envelopes (hull "
    "curves in the paper) of the positive (green) and the negative (purple) peaks (triangles). "
    "The envelopes are least-squares fits to the logarithms of the peaks, if at least two peaks "
    "exceed the creep.",
    (Panel("", "Displacement after the drop", _free_response, wide=True, height_in=4.0),),
    plain_caption="Free response at the operating voltage: the mass is lifted and dropped. "
    "Measured displacement: trials (blue, orange-red) with the standard deviation of the three "
    "tracked points as bands, their mean (light blue), the decaying oscillation alone (dotted) "
    "and with an exponential creep term (dashed), and the exponential envelopes of the positive "
    "(green) and the negative (purple) peaks (triangles). The envelopes are least-squares fits to "
    "the logarithms of the peaks, if at least two peaks exceed the creep.",
)
