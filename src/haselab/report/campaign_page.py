"""The page of a campaign: distributions, coverage, sensitivities, failures, and a comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Chart, Curve, Panel
from haselab.report.chart_file import draw_chart
from haselab.report.numbers import ABSENT, number_text
from haselab.report.style import figure_style, inline_svg, to_svg

__all__ = ["campaign_page"]

Floats = NDArray[np.float64]
_MANY = 0.05  # share of failed cases that the page warns of
_MOST_FIGURES = 12
_MOST_CURVES = 6
_MOST_CHANGES = 12
_MOST_CHARACTERS = 160
_MOST_LISTED = 12
_MOST_RESULTS, _MOST_VALUES = 8, 50  # columns and rows of a table over an axis

#: Results of the cases, by name and by group.
Values = Mapping[str, Mapping[str, Floats]]


@dataclass(frozen=True)
class _Table:
    title: str
    about: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def campaign_page(summary: Mapping[str, Any], values: Values) -> str:
    """Compose one self-contained HTML document.

    Args:
        summary: of the campaign, see `haselab.campaign`.
        values: results of the cases.
    Returns:
        The page; the same campaign gives the same bytes.
    """
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    design = summary["design"]
    repeats = f", {design['repeats']} times each" if design["repeats"] > 1 else ""
    return environment.from_string(_packaged("campaign.html.j2")).render(
        title=f"SIMULATED: campaign {summary['name']}",
        style=_packaged("style.css"),
        lead=f"{summary['cases']:,} cases of the kind {summary['kind']}, {summary['failed']:,} of "
        f"them failed. Design: {design['kind']}{repeats}. haselab {summary['code']}.",
        about=_about(summary),
        figures=[*_figures(values), *_figures_over(summary["over_axes"])],
        left_out=_left_out(values, summary["over_axes"]),
        tables=[table for table in _tables(summary) if table.rows],
    )


def _packaged(name: str) -> str:
    return resources.files("haselab.report").joinpath("templates", name).read_text(encoding="utf-8")


def _about(summary: Mapping[str, Any]) -> str:
    parts = [_meaning(summary)]
    if summary["failed"] > _MANY * summary["cases"]:
        parts.append(
            f"{summary['failed']:,} of {summary['cases']:,} cases failed. All distributions, "
            "medians and sensitivities are those of the other cases, which may not represent all "
            "cases: see the parameters of the failed cases."
        )
    if unused := summary.get("without_effect", ()):
        parts.append(f"No result depends on {', '.join(unused)}.")
    if unranked := summary["unranked"]:
        parts.append(
            f"The sensitivities leave out {', '.join(unranked)}, whose values are not numbers."
        )
    if exact := summary.get("without_noise", ()):
        parts.append(
            f"There is no coverage of {', '.join(exact)}: the cases have no noise, so their "
            "intervals are only as wide as rounding errors."
        )
    if summary["is_random"] and not summary["sensitivities"]:
        parts.append(
            "There are no sensitivities: too few cases have a value, or no result changes."
        )
    return " ".join(parts)


def _meaning(summary: Mapping[str, Any]) -> str:
    if not summary["is_random"]:
        return (
            "Each point of the grid was computed once. Shares of these cases are not "
            "probabilities, so quantiles have no intervals."
        )
    text = (
        "Intervals are of 95 %: those of quantiles and median differences are from order "
        "statistics, those of coverage by Clopper and Pearson, those of rank correlations by "
        "Fisher's transformation, and those of Sobol indices from resampling. A dash means that "
        "there are too few cases, or that cases share drawn values or noise."
    )
    if summary["design"]["kind"] in ("sobol", "latin-hypercube"):
        text += (
            " Intervals take the cases as independent draws; points of this design are spread "
            "more evenly, which makes the intervals too wide."
        )
    return text


def _left_out(values: Values, over: Sequence[Mapping[str, Any]]) -> str:
    """Say what the figures do not show."""
    parts = ["Each figure of a result shows the share of cases at or below a value."]
    if len(values) > _MOST_FIGURES:
        parts.append(f"The figures show the first {_MOST_FIGURES} of {len(values)} results.")
    most = max((len(groups) for groups in values.values()), default=0)
    if most > _MOST_CURVES:
        parts.append(f"They show the first {_MOST_CURVES} of {most} points of the axes.")
    for path, levels in {
        one["axes"][1]: len({point["at"][1] for point in one["points"]})
        for one in over if len(one["axes"]) == 2
    }.items():  # fmt: skip
        if levels > _MOST_CURVES:
            parts.append(f"They show the first {_MOST_CURVES} of {levels} values of {path}.")
    if (drawn := len(_drawn_over(over))) > _MOST_FIGURES:
        parts.append(f"Of {drawn} figures over axes, {_MOST_FIGURES} are shown.")
    return " ".join(parts)


def _figures(values: Values) -> Iterator[str]:
    for number, (name, groups) in enumerate(values.items()):
        if number == _MOST_FIGURES:
            return
        curves = [
            _shares(part, label) for label, part in list(groups.items())[:_MOST_CURVES]
            if np.isfinite(part).any()
        ]  # fmt: skip
        if curves:
            chart = Chart(name, (Panel(name, "Share of cases", curves),))
            with figure_style():
                yield inline_svg(to_svg(draw_chart(chart), f"campaign-{number}", name))


def _shares(values: Floats, label: str) -> Curve:
    """Share of the cases at or below each value; below 1 at the end if some were not reached."""
    reached = np.sort(values[np.isfinite(values)])
    return Curve(reached, np.arange(1, reached.size + 1) / values.size, label, "steps")


def _tables(summary: Mapping[str, Any]) -> Iterator[_Table]:
    yield _Table(
        "Parameters", f"Varied parameters. {_settings(summary)}",
        ("Parameter", "Values", "Kind"),
        [
            (path, _listed(numbers), shape)
            for path, chosen in summary["parameters"].items()
            for shape, numbers in (
                chosen.items() if isinstance(chosen, Mapping) else [("axis", chosen)]
            )
        ] or [(ABSENT, ABSENT, "only repeats")],
    )  # fmt: skip
    yield from _sensitivities(summary["sensitivities"])
    yield _Table(
        "Results", "Intervals of 95 % are in parentheses.",
        ("Result", "Point of the axes", "Cases", "Without a value", "Smallest", "5 %", "Median",
         "95 %", "Largest"),
        [
            (one["result"], one["group"], str(one["count"]), str(one["without_value"]),
             _text(one.get("least")), *(_with_interval(one.get(key)) for key in
             ("p05", "median", "p95")), _text(one.get("largest")))
            for one in summary["distributions"]
        ],
    )  # fmt: skip
    yield _Table(
        "Coverage of the intervals",
        "How often the stated interval of 95 % contains the true value, which the simulation knows "
        "and the analysis does not. Correct intervals contain it in 95 % of the cases. Failed "
        "cases and those in which the estimate was not identifiable have no interval and do not "
        "count.",
        ("Estimate", "Point of the axes", "Cases", "Without an interval", "Inside", "Share"),
        [
            (one["result"], one["group"], str(one["count"]), str(one["without_interval"]),
             str(one["inside"]),
             _with_interval(one["share"]))
            for one in summary["coverage"]
        ],
    )  # fmt: skip
    yield from _over(summary["over_axes"])
    yield from _along(summary["axis_differences"])
    yield _Table(
        "Failed cases",
        "Errors, the most frequent first, with the first case of each. Errors that differ only in "
        "their numbers are counted together. failed.txt has all tracebacks. Add --retry-failed to "
        "compute these cases again.",
        ("Error", "Cases", "First case", "Its parameters"),
        [
            (one["error"][:_MOST_CHARACTERS], str(one["count"]), str(one["index"]),
             ", ".join(f"{path} = {_shown(value)}" for path, value in one["values"].items()))
            for one in summary["failures"]
        ],
    )  # fmt: skip
    yield _Table(
        "Comparison",
        f"This campaign compared with that in {summary.get('compared_with', '')}. The interval of "
        "the difference comes from resampling both; without random draws there is none. Cases "
        "without a value are left out, and so are results whose median was not reached. If both "
        "campaigns have the same cases, only those with a value in both count. "
        f"{_differences(summary)}",
        ("Result", "Median here", "Median there", "Difference", "Without a value, here and there"),
        [
            (
                one["result"],
                *(_with_interval(one[key]) for key in ("here", "there", "difference")),
                f"{one['here']['without_value']} and {one['there']['without_value']}",
            )
            for one in summary.get("comparison", ())
        ],
    )
    yield _Table(
        "Comparison case by case",
        f"This campaign minus that in {summary.get('compared_with', '')}. A case has the same "
        "drawn values and random numbers in both, so differences between the devices cancel. "
        "Cases without a finite value in both are left out. "
        f"{_differences(summary)}",
        ("Result", "Cases", "Left out", "Smallest difference", "Median difference",
         "Largest difference"),
        [
            (one["result"], *_differing(one)) for one in summary.get("paired", ())
        ],
    )  # fmt: skip


def _settings(summary: Mapping[str, Any]) -> str:
    fixed = [
        f"{name} = {_shown(value)}" for name, value in summary["settings"].items()
        if f"case.{name}" not in summary["parameters"]
    ]  # fmt: skip
    return f"Other settings in [case]: {', '.join(fixed)}." if fixed else ""


def _listed(values: Sequence[object]) -> str:
    if len(values) > _MOST_LISTED:
        ends = f"{_shown(values[0])}, {_shown(values[1])}, ..., {_shown(values[-1])}"
        return f"{ends} ({len(values)} values)"
    return ", ".join(map(_shown, values))


def _over(found: Sequence[Mapping[str, Any]]) -> Iterator[_Table]:
    """Tables of the results over each axis, and over both if there are two."""
    by_axes: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for one in found:
        by_axes.setdefault(tuple(one["axes"]), []).append(one)
    for axes, results in by_axes.items():
        if len(axes) == 1:
            yield _over_one(axes[0], results[:_MOST_RESULTS], len(results))
        else:
            yield from (_over_two(axes, result) for result in results[:_MOST_RESULTS])


def _along(found: Sequence[Mapping[str, Any]]) -> Iterator[_Table]:
    for path in dict.fromkeys(one["axis"] for one in found):
        yield _Table(
            f"Differences along {path}",
            "Result at a value minus that at the first value of the axis, in cases with the same "
            "values of all other parameters: differences between devices cancel. Cases "
            "without a finite value in both are left out.",
            ("Result", path, "Cases", "Left out", "Smallest difference", "Median difference",
             "Largest difference"),
            [
                (one["result"], _shown(one["value"]), *_differing(one))
                for one in found if one["axis"] == path
            ],
        )  # fmt: skip


def _differing(one: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        str(one["count"]), str(one["without_value"]), _text(one["least"]),
        _with_interval(one["median"]), _text(one["largest"]),
    )  # fmt: skip


def _over_one(path: str, results: Sequence[Mapping[str, Any]], count: int) -> _Table:
    points = results[0]["points"]
    more = "" if len(points) <= _MOST_VALUES else (
        f" The first {_MOST_VALUES} of {len(points)} values; summary.json has all."
    )  # fmt: skip
    more += "" if count == len(results) else f" The first {len(results)} of {count} results."
    return _Table(
        f"Results over {path}",
        "Median of the cases at each value, over all values of the other parameters; in "
        f"parentheses the smallest and the largest result (not a 95 % interval).{more}",
        (path, "Cases", *(one["result"] for one in results)),
        [
            (_shown(point["at"][0]), str(point["count"] + point["without_value"]),
             *(_spread(one["points"][k]) for one in results))
            for k, point in enumerate(points[:_MOST_VALUES])
        ],
    )  # fmt: skip


def _over_two(axes: Sequence[str], result: Mapping[str, Any]) -> _Table:
    points = {tuple(point["at"]): point for point in result["points"]}
    rows, columns = (list(dict.fromkeys(at[k] for at in points)) for k in (0, 1))
    return _Table(
        f"{result['result']} over {axes[0]} and {axes[1]}",
        f"Median of the cases at each point. Columns: {axes[1]}.",
        (axes[0], *map(_shown, columns)),
        [
            (_shown(row), *(_spread(points[row, column], spread=False) for column in columns))
            for row in rows
        ],
    )


def _spread(point: Mapping[str, Any], *, spread: bool = True) -> str:
    if not point["count"]:
        return ABSENT
    if not spread or point["least"] == point["largest"]:
        return _text(point["median"])
    return f"{_text(point['median'])} ({_text(point['least'])} to {_text(point['largest'])})"


def _drawn_over(found: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """What has a figure: results over two axes, else over one; the first one has numbers."""
    crossed = [one for one in found if len(one["axes"]) == 2]
    return [
        one for one in crossed or found
        if all(type(point["at"][0]) in (int, float) for point in one["points"])
    ]  # fmt: skip


def _figures_over(found: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Medians over a numeric axis; of two axes over the first, with one curve for each value.

    Only the first `_MOST_CURVES` values have a curve.
    """
    for number, one in enumerate(_drawn_over(found)[:_MOST_FIGURES]):
        curves = []
        for value in list(dict.fromkeys(tuple(point["at"][1:]) for point in one["points"])):
            points = [point for point in one["points"] if tuple(point["at"][1:]) == value]
            y = np.array([point.get("median", math.nan) for point in points])
            good = np.isfinite(y)
            x = np.array([float(point["at"][0]) for point in points])
            label = f"{one['axes'][1]} = {_shown(value[0])}" if value else ""
            order = np.argsort(x[good])
            if good.any():
                curves.append(Curve(x[good][order], y[good][order], label))
        if curves:
            panel = Panel(one["axes"][0], one["result"], curves[:_MOST_CURVES])
            chart = Chart(f"{one['result']}, median", (panel,))
            with figure_style():
                yield inline_svg(to_svg(draw_chart(chart), f"axis-{number}", one["result"]))


def _differences(summary: Mapping[str, Any]) -> str:
    """In what the two campaigns differ."""
    doubts = [f" About the other campaign: {doubt}." for doubt in summary.get("doubts", ())]
    return _changed_values(summary.get("differs_in", ())) + "".join(doubts)


def _changed_values(changes: Sequence[str]) -> str:
    if not changes:
        return "The two campaign files are equal."
    more = len(changes) - _MOST_CHANGES
    listed = "; ".join(changes[:_MOST_CHANGES]) + (f"; and {more} more" if more > 0 else "")
    return f"The campaigns differ: {listed}."


def _sensitivities(found: Sequence[Mapping[str, Any]]) -> Iterator[_Table]:
    yield _Table(
        "Sensitivity: Sobol indices",
        "First-order index: share of the variance that a parameter causes alone. Total index: "
        "together with all others. It cannot be smaller than the first-order index; where it "
        "is, the estimates are too inaccurate. "
        "Intervals of 95 % from resampling. A block of samples in which "
        "a case has no finite value is left out; if many are, the indices are those of a part of "
        "the distributions only.",
        ("Result", "Point of the axes", "Parameter", "First-order index", "Total index", "Blocks",
         "Left out"),
        [
            (one["result"], one["group"], one["parameter"], _with_interval(one["first"]),
             _with_interval(one["total"]), str(one["blocks"]), str(one["blocks_left_out"]))
            for one in _largest_first([one for one in found if "first" in one], "total")
        ],
    )  # fmt: skip
    yield _Table(
        "Sensitivity: rank correlation",
        "Spearman's correlation of a parameter and a result: 1 and −1 for a monotone relation, 0 "
        "also for one that rises and falls. A result that was not reached ranks above all others.",
        ("Result", "Point of the axes", "Parameter", "Correlation", "Cases", "Without a value"),
        [
            (one["result"], one["group"], one["parameter"], _with_interval(one["correlation"]),
             str(one["count"]), str(one["without_value"]))
            for one in _largest_first([one for one in found if "correlation" in one], "correlation")
        ],
    )  # fmt: skip


def _largest_first(found: Sequence[Mapping[str, Any]], key: str) -> list[Mapping[str, Any]]:
    """The parameters of each result and group, the most important first."""
    pairs = dict.fromkeys((one["result"], one["group"]) for one in found)
    places = {pair: place for place, pair in enumerate(pairs)}

    def order(one: Mapping[str, Any]) -> tuple[int, float]:
        size = abs(one[key]["value"])  # NaN for a parameter that does not vary
        return places[one["result"], one["group"]], math.inf if math.isnan(size) else -size

    return sorted(found, key=order)


def _with_interval(number: Mapping[str, Any] | None) -> str:
    if number is None:
        return ABSENT
    ends = number["ci95"]
    shown = ABSENT if ends is None else f"{_text(ends[0])} to {_text(ends[1])}"
    return f"{_text(number['value'])} ({shown})"


def _text(value: float | None) -> str:
    if value is not None and math.isinf(value):
        return "not reached" if value > 0.0 else "−infinity"
    return number_text(value)


def _shown(value: object) -> str:
    return number_text(value) if isinstance(value, float) else str(value)
