"""The page of a scoreboard: ratios to the physical limit, all numbers, and traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import jinja2

from haselab.base.chart import Chart, Curve, Panel
from haselab.report.chart_file import draw_chart
from haselab.report.numbers import number_text
from haselab.report.overview.summary import counted
from haselab.report.style import figure_style, inline_svg, to_svg
from haselab.scoreboard import TASKS, Entry, Game, Played, Row, board_rows, limits_of

__all__ = ["scoreboard_page"]

_MOST_CURVES = 6


@dataclass(frozen=True)
class _Ratios:
    """One controller in one class: a cell for each number that has a limit."""

    controller: str
    loop: str
    cells: tuple[str, ...]


@dataclass(frozen=True)
class _Shown:
    """A row as text."""

    title: str
    unit: str
    controller: str
    loop: str
    median: str
    worst: str
    bound: str
    violations: int


@dataclass(frozen=True)
class _Part:
    """One task on the page."""

    name: str
    title: str
    svg: str
    shown: str
    rows: tuple[_Shown, ...]
    limits: tuple[str, ...]


def scoreboard_page(game: Game) -> str:
    """Compose one self-contained HTML document.

    Args:
        game: that was played.
    Returns:
        The page; the same game gives the same bytes.
    """
    rows, plan = board_rows(game), game.plan
    limited = list(dict.fromkeys((row.task, row.metric) for row in rows if row.bound is not None))
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    text = _packaged("scoreboard.html.j2")
    return environment.from_string(text).render(
        title="SIMULATED: scoreboard of controllers",
        style=_packaged("style.css"),
        summary=f"{len(plan.controllers)} controllers, {len(plan.tasks)} tasks, "
        f"{counted(plan.seeds, 'seed', 'seeds')} from {plan.seed}, on simulated devices. Each "
        "controller knows the model that was identified from one simulated record of the public "
        "device, with noise.",
        columns=[f"{task} {metric}" for task, metric in limited],
        ratios=_ratios(rows, limited),
        tasks=[_part(game, name, rows) for name in plan.tasks],
        entries=[_Entry(one) for one in game.entries],
        failures=_failures(game.played),
    )


class _Entry:
    """A design as text."""

    def __init__(self, entry: Entry) -> None:
        self.controller, self.loop, self.device = entry.controller, entry.loop, entry.device
        values = ", ".join(f"{name} = {value:.4g}" for name, value in entry.values.items())
        self.text = entry.reason or values or "no parameters"


def _packaged(name: str) -> str:
    return resources.files("haselab.report").joinpath("templates", name).read_text(encoding="utf-8")


def _ratios(rows: Sequence[Row], limited: Sequence[tuple[str, str]]) -> list[_Ratios]:
    pairs = dict.fromkeys((row.controller, row.loop) for row in rows)
    found = {(row.controller, row.loop, row.task, row.metric): row.ratio_to_bound for row in rows}
    return [
        _Ratios(controller, loop, tuple(
            "" if (ratio := found.get((controller, loop, *name))) is None else f"{ratio:.2f}"
            for name in limited
        ))
        for controller, loop in pairs
    ]  # fmt: skip


def _part(game: Game, name: str, rows: Sequence[Row]) -> _Part:
    task = TASKS[name]
    titles = {metric.name: metric.title for metric in task.metrics}
    own = [row for row in rows if row.task == name]
    own.sort(key=lambda row: list(titles).index(row.metric))  # stable: controllers in their order
    shown = tuple(
        _Shown(
            titles[row.metric], row.unit, row.controller, row.loop, _number(row.median),
            _number(row.worst), _number(row.bound) if row.bound is not None else "",
            row.violations,
        )
        for row in own
    )  # fmt: skip
    loop = next((one for one in game.plan.classes if one in task.classes), "")
    traces = [one for one in game.played
              if (one.task, one.loop) == (name, loop) and one.trace is not None]  # fmt: skip
    svg = ""
    if traces:
        chart = _chart(f"{name}: {task.title}", traces)
        with figure_style():
            svg = inline_svg(to_svg(draw_chart(chart), name.lower(), chart.title))
    limits = tuple(f"{', '.join(titles[one] for one in names)}: {limit}."
                   for _, limit, names in limits_of([name]))  # fmt: skip
    return _Part(name, task.title, svg, f"Class {loop}." if svg else "", shown, limits)


def _number(value: float | None) -> str:
    return "not reached" if value is None else number_text(value)


def _chart(title: str, traces: Sequence[Played]) -> Chart:
    """Panels of a few controllers each, with the reference."""
    panels = []
    for first in range(0, len(traces), _MOST_CURVES):
        part = traces[first : first + _MOST_CURVES]
        assert part[0].trace is not None
        time_s, reference, _ = part[0].trace
        curves = [Curve(time_s, reference, "reference", "steps")]
        curves += [Curve(one.trace[0], one.trace[2], one.controller)
                   for one in part if one.trace is not None]  # fmt: skip
        panels.append(Panel("Time (s)", "Strain", curves))
    return Chart(title, tuple(panels))


@dataclass(frozen=True)
class _Failure:
    where: str
    reason: str


def _failures(played: Sequence[Played]) -> list[_Failure]:
    return [
        _Failure(f"{one.controller}, {one.loop}, {one.task}, seed {one.index}", one.failure)
        for one in played if one.failure
    ]  # fmt: skip
