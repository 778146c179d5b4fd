"""Figure 6: steps in open and closed loop."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from haselab.report.analysis import Array, LeftOutError, Section
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import GREEN, GREY, PALETTE, band, label_text, legend_below, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 2500
_COLOURS = tuple(colour for colour in PALETTE if colour != GREEN)  # that of the desired strain


def _groups(section: Section) -> dict[str, Section]:
    groups = section.sections("groups")
    if not groups:
        raise LeftOutError("'steps' in analysis.json has no 'groups'.")
    return groups


def _desired(axes: Axes, section: Section, time_s: Array) -> None:
    desired = section.array("desired", like=time_s)
    axes.plot(time_s, 100.0 * desired, color=GREEN, linewidth=1.8, label="desired", zorder=1)


def _overview(host: FigureBase, run: RunFolder) -> None:
    section = run.section("steps")
    time_s = section.array("time_s")
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    _desired(axes, section, time_s)
    for at, (name, group) in enumerate(_groups(section).items()):
        colour = _COLOURS[at % len(_COLOURS)]
        mean = 100.0 * group.array("mean", like=time_s)
        std = group.optional("std", like=time_s)
        axes.plot(time_s[step], mean[step], color=colour, linewidth=1.8, label=label_text(name))
        band(axes, time_s[step], mean[step], None if std is None else 100.0 * std[step], colour)
    axes.set_xlabel("Time (s)")
    axes.set_ylabel("Strain (%)")
    legend_below(host, axes, 5)


def _each_group(host: FigureBase, run: RunFolder) -> None:
    section = run.section("steps")
    time_s = section.array("time_s")
    step = thinned(time_s.size, _SAMPLES_DRAWN // 2)
    groups = _groups(section)
    rows = host.subplots(len(groups), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for at, (axes, (name, group)) in enumerate(zip(rows, groups.items(), strict=True)):
        colour = _COLOURS[at % len(_COLOURS)]
        _desired(axes, section, time_s)
        if "trials" in group:
            trials = 100.0 * group.rows("trials", length=time_s.size)
            axes.plot(
                time_s[step],
                trials.T[step],
                color=colour,
                linewidth=0.5,
                alpha=0.35,
                rasterized=True,
            )
        mean = group.array("mean", like=time_s)
        axes.plot(
            time_s[step],
            100.0 * mean[step],
            color=colour,
            linewidth=1.8,
            label=label_text(f"{name}, camera"),
        )
        sensed = group.optional("sensed_mean", like=time_s)
        if sensed is not None:
            axes.plot(
                time_s[step], 100.0 * sensed[step], color=GREY, linewidth=0.8, label="self-sensed"
            )
        axes.set_ylabel("Strain (%)")
        axes.legend(loc="best", ncols=3)
    rows[-1].set_xlabel("Time (s)")


PLAN = FigurePlan(
    "fig6",
    "Figure 6",
    "steps",
    "Step experiments. The actuator is first driven to zero strain, then the step follows. In "
    "open loop nothing corrects its slow motion and the error of the voltage map, so its strain "
    "differs from zero before the step and from the desired strain at the end. A: desired strain "
    "(green), and mean of the trials in each mode, measured independently by the camera, with one "
    "standard deviation as a band. B: each trial (faint), and the strain sensed by the controller "
    "(thin grey).",
    (
        Panel("A", "Open and closed loop", _overview, wide=True, height_in=3.2),
        Panel("B", "Trials and self-sensed strain", _each_group, wide=True, height_in=5.0),
    ),
)
