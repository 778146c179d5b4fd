"""Figure 14: closed-loop trials in addition to the paper's."""

from __future__ import annotations

from matplotlib.figure import FigureBase

from haselab.report.analysis import LeftOutError
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREEN, GREY, RED, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 2500
_TITLES = {
    "printed": "PI with the paper's sensing chain",
    "late": "PI with extra delay",
    "saturating": "PI that saturates",
}


def _further(host: FigureBase, run: RunFolder) -> None:
    section = run.section("further")
    shown = {name: section.section(name) for name in _TITLES if name in section}
    if not shown:
        raise LeftOutError("'further' in analysis.json has no trials.")
    rows = host.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, trial) in zip(rows, shown.items(), strict=True):
        time_s = trial.array("time_s")
        step = thinned(time_s.size, _SAMPLES_DRAWN)
        desired = trial.array("desired", like=time_s)
        strain = trial.array("strain", like=time_s)
        axes.plot(time_s[step], 100.0 * desired[step], color=GREEN, linewidth=1.6, label="desired")
        axes.plot(time_s[step], 100.0 * strain[step], color=BLUE, linewidth=1.2, label="camera")
        axes.set_ylabel("Strain (%)")
        axes.set_title(_TITLES[name], loc="left")
        lines = list(axes.lines)
        drive_v = trial.optional("drive_v", like=time_s)
        if drive_v is not None:
            drive = axes.twinx()
            drive.grid(False)
            limit_v = trial.number("limit_v")
            drive.plot(
                time_s[step], drive_v[step], color=GREY, linewidth=0.8, label="output (right axis)"
            )
            drive.axhline(
                limit_v, color=RED, linewidth=0.8, linestyle=":",
                label=f"its limit, {limit_v:.2f} V (right axis)",
            )  # fmt: skip
            drive.set_ylabel("DAQ output (V)")
            lines += drive.lines
        axes.legend(handles=lines, loc="lower right", ncols=2)
    rows[-1].set_xlabel("Time (s)")


PLAN = FigurePlan(
    "further",
    "Figure 14",
    "further trials",
    "Additional closed-loop trials: strain measured by the camera (blue) and desired strain "
    "(green). From the top: with the paper's sensing chain instead of the lock-in and a larger "
    "carrier; with extra delay, for which the PI gains are reduced if necessary; and with a "
    "reference that drives the output (grey, right axis) to its limit (dotted, right axis).",
    (Panel("", "Further trials", _further, wide=True, height_in=6.0),),
    needs="further",
)
