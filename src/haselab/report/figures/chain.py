"""Figure 13: the paper's sensing chain compared with the lock-in."""

from __future__ import annotations

from matplotlib.figure import FigureBase

from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, GREY, RED, legend_below, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 3000


def _chain(host: FigureBase, run: RunFolder) -> None:
    section = run.section("chain")
    time_s = section.array("time_s")
    lockin_f = section.array("lockin_f", like=time_s)
    printed_f = section.array("printed_f", like=time_s)
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    both, off = host.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2, 1)})
    both.plot(time_s[step], 1e9 * lockin_f[step], color=BLUE, linewidth=1.6, label="lock-in")
    both.plot(
        time_s[step], 1e9 * printed_f[step], color=RED, linewidth=0.9, linestyle="--",
        label="paper's chain",
    )  # fmt: skip
    both.set_ylabel("Capacitance (nF)")
    off.plot(time_s[step], 100.0 * (printed_f / lockin_f - 1.0)[step], color=GREY, linewidth=0.8)
    off.axhline(0.0, color="black", linewidth=0.6)
    off.set_ylabel("Difference (%)")
    off.set_xlabel("Time (s)")
    legend_below(host, both, 2)
    host.align_ylabels()


PLAN = FigurePlan(
    "chain",
    "Figure 13",
    "sensing chain",
    "Capacitance in cycles 2 to 5 of the triangle test, from the lock-in and from the paper's "
    "sensing chain (low-pass, mean of the periods, peak to peak, phase; eqs. 2 and 3), and their "
    "difference. Averaging over periods does not remove the ramp and the steps of the drive.",
    (Panel("", "Paper's sensing chain and lock-in", _chain, wide=True, height_in=3.8),),
    needs="chain",
)
