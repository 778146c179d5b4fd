"""What a finished campaign says: distributions, coverage, sensitivities, failed cases.

All intervals are of 95 %. Those of quantiles are distribution-free (order statistics), those of
shares are exact (Clopper and Pearson); both take the cases as independent draws.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Json, JsonObject
from haselab.campaign.definition import Campaign
from haselab.campaign.groups import LEAST_CASES, Group, groups_of, number_of, result_names
from haselab.campaign.over_axes import over_axes
from haselab.campaign.plan import Plan
from haselab.campaign.sensitivities import sensitivities, unranked_of
from haselab.store.campaign.shards import CaseRow

__all__ = [
    "compared", "draws_are_independent", "is_random", "median_interval", "most_important", "paired",
    "share_cases", "summarised", "with_infinities",
]  # fmt: skip

Floats = NDArray[np.float64]
_LEAST_RANK = 0.1  # correlation of a result that rises or falls, and does not do both
_QUANTILES = {"p05": 0.05, "median": 0.5, "p95": 0.95}
_SIDE = 0.025
_EXACT = 1e-9  # width over the value: fits of records without noise have 1e-15 to 1e-11
_RESAMPLED = 1000
_SEED = 1  # of resampling: the same rows give the same intervals
_MOST_COMPARED = 8  # values of an axis
_NUMBER = re.compile(r"(?<!\w)-?\d[\d.,]*(?:e[-+]?\d+)?", re.IGNORECASE)


def summarised(plan: Plan, rows: Sequence[CaseRow]) -> JsonObject:
    """Summarise a finished campaign.

    Args:
        plan: of it.
        rows: of all its cases.
    Returns:
        Distributions, coverage, sensitivities and failures, as JSON types.
    """
    campaign, groups = plan.campaign, groups_of(plan.campaign, rows)
    described = campaign.described()
    independent = draws_are_independent(described, grouped=len(groups) > 1)
    drawn = is_random(described)
    names = result_names(rows)
    return {
        "name": campaign.name,
        "kind": campaign.kind,
        "code": plan.code,
        "design": campaign.design.model_dump(mode="json"),
        "parameters": described["parameters"],
        "settings": campaign.tables["case"],
        "cases": len(rows),
        "failed": sum(bool(row.error) for row in rows),
        "is_random": drawn,
        "distributions": [
            _distribution(group, name, independent=independent and drawn)
            for name in names
            for group in groups
        ],
        "coverage": [
            found
            for name in names
            for group in groups
            if (found := _coverage(group, name, independent=independent))
        ],
        "without_noise": [*_without_noise(groups, names)],
        "sensitivities": list(sensitivities(campaign, groups, names, independent=independent)),
        "unranked": [*unranked_of(campaign)],
        "over_axes": _over_axes(campaign, groups, names),
        "axis_differences": [*_axis_differences(campaign, rows, names)],
        "failures": _failures(rows),
        "without_effect": [*_without_effect(campaign, rows)],
    }


def with_infinities(found: Json) -> Json:
    """Replace infinite numbers by the texts `inf` and `-inf`, because JSON has none.

    Args:
        found: numbers, texts, lists and tables.
    Returns:
        The same; NaN stays, which `to_plain` makes null.
    """
    if isinstance(found, Mapping):
        return {name: with_infinities(value) for name, value in found.items()}
    if isinstance(found, (list, tuple)):
        return [with_infinities(value) for value in found]
    if isinstance(found, float) and math.isinf(found):
        return "inf" if found > 0.0 else "-inf"
    return found


def most_important(summary: Mapping[str, Any], rows: Sequence[CaseRow]) -> str:
    """The parameters on which the first result of the kind depends most, in one line.

    Args:
        summary: see `summarised`.
        rows: of the cases.
    Returns:
        Up to three, the most important first, at the first point of the axes. Parameters whose
        interval contains 0 are left out. An empty text if there are no sensitivities.
    """
    order = [name for row in rows[:1000] for name in row.results]  # the order of the kind
    found = summary["sensitivities"]
    known = {one["result"] for one in found}
    name = next((name for name in order if name in known), None)
    if name is None:
        return ""
    found = [one for one in found if one["result"] == name]
    label = found[0]["group"]
    place = f" at {label} (first point of the axes)" if label else ""
    is_sobol = "total" in found[0]
    kind, key = (
        ("total Sobol index", "total") if is_sobol else ("rank correlation", "correlation")
    )  # fmt: skip
    listed, unclear = [], False
    for one in found:
        number = one[key]
        if one["group"] == label and not math.isnan(number["value"]):
            ends = number["ci95"]
            if ends is not None and ends[0] <= 0.0 <= ends[1]:
                unclear = True
                continue
            near = "" if ends is None else f", {ends[0]:.2g} to {ends[1]:.2g}"
            sign = _direction(one) if is_sobol else ""
            text = f"{one['parameter']} ({kind} {number['value']:.2g}{near}{sign})"
            listed.append((-abs(number["value"]), text))
    if not listed:
        return f"{name}{place}: each {kind} has an interval that contains 0" if unclear else ""
    return f"{name}{place} depends most on {', '.join(text for _, text in sorted(listed)[:3])}"


def _direction(found: Mapping[str, Any]) -> str:
    """Whether a result rises or falls with a parameter, by their rank correlation."""
    rank = found["correlation"]["value"] if "correlation" in found else 0.0
    if not abs(rank) > _LEAST_RANK:
        return ""
    return ", rises" if rank > 0.0 else ", falls"


def _over_axes(campaign: Campaign, groups: Sequence[Group], names: Sequence[str]) -> list[Json]:
    """Results over the axes; none if each point of the axes has its own distributions."""
    if len(groups) > 1:
        return []
    values = {name: groups[0].values(name) for name in names}
    return list(over_axes(campaign, groups[0].rows, values))


def _axis_differences(
    campaign: Campaign, rows: Sequence[CaseRow], names: Sequence[str]
) -> Iterator[JsonObject]:
    """Differences between the first and each other value of an axis, with all else the same.

    Cases at both values have the same drawn devices, and with `same_noise` also the same noise.
    """
    varied = [axis for axis in campaign.axes if len(axis.values) > 1]
    described = campaign.described()
    independent = (
        len(varied) == 1 and is_random(described)
        and draws_are_independent(described, grouped=True)
    )  # fmt: skip
    each = campaign.points * campaign.design.repeats
    shape = (*(len(axis.values) for axis in campaign.axes), each)
    columns = {
        name: np.array([number_of(row.results.get(name)) for row in rows]).reshape(shape)
        for name in names
    }
    for place, axis in enumerate(campaign.axes):
        if axis not in varied or len(axis.values) > _MOST_COMPARED:
            continue
        for name, values in columns.items():
            first, *others = np.moveaxis(values, place, 0)
            for value, other in zip(axis.values[1:], others, strict=True):
                found = _differences(other.ravel(), first.ravel(), independent=independent)
                if found is not None:
                    yield {"axis": axis.path, "value": value, "result": name, **found}


# ---- distributions -----------------------------------------------------------------------------


def draws_are_independent(described: Mapping[str, Any], *, grouped: bool) -> bool:
    """Whether no two cases of a group have drawn values or noise in common.

    Args:
        described: the campaign, as in its campaign.json.
        grouped: each group has the cases of one point of the axes; otherwise one has all cases.
    Returns:
        False if intervals that take the cases as independent would be too narrow.
    """
    design, parameters = described["design"], described["parameters"].values()
    is_drawn = any(isinstance(each, Mapping) for each in parameters)
    axes = math.prod(len(each) for each in parameters if not isinstance(each, Mapping))
    if design["kind"] == "saltelli" or (is_drawn and design["repeats"] > 1):
        return False
    return grouped or axes == 1 or not (is_drawn or design["same_noise"])


def is_random(described: Mapping[str, Any]) -> bool:
    """Whether the cases are random draws; a grid whose points are computed once has none.

    Args:
        described: the campaign, as in its campaign.json.
    """
    drawn = any(isinstance(each, Mapping) for each in described["parameters"].values())
    return drawn or described["design"]["repeats"] > 1


def _distribution(group: Group, name: str, *, independent: bool) -> JsonObject:
    values = np.sort(group.present(name))
    answer: JsonObject = {
        "result": name, "group": group.label, "count": values.size,
        "without_value": len(group.rows) - values.size,
    }  # fmt: skip
    if values.size == 0:
        return answer
    quantiles: JsonObject = {
        key: {
            "value": _quantile(values, share),
            "ci95": _order_interval(values, share) if independent else None,
        }
        for key, share in _QUANTILES.items()
    }
    with np.errstate(invalid="ignore", over="ignore"):
        mean = float(values.mean())  # of infinities of both signs: NaN
    if math.isinf(mean) and np.isfinite(values).all():
        mean = float((values / values.size).sum())  # only the sum of all was too large
    ends = {"least": float(values[0]), "mean": mean, "largest": float(values[-1])}
    return {**answer, **quantiles, **ends}


def _quantile(ordered: Floats, share: float) -> float:
    """Quantile of ordered values, of which the first and the last may be infinite."""
    place = share * (ordered.size - 1)
    low, high = float(ordered[math.floor(place)]), float(ordered[math.ceil(place)])
    return low if low in (high, -math.inf) else low + (place % 1.0) * (high - low)


def median_interval(values: Floats) -> Json:
    """Interval of 95 % of a median, from order statistics; None: too few values.

    Args:
        values: independent. Shape `(N,)`.
    Returns:
        Low and high end.
    Source: David and Nagaraja, Order Statistics, section 7.1.
    """
    return _order_interval(np.sort(values), 0.5)


def _order_interval(ordered: Floats, share: float) -> Json:
    from scipy.stats import binom  # slow to import

    low = int(binom.ppf(_SIDE, ordered.size, share))
    high = int(binom.ppf(1.0 - _SIDE, ordered.size, share)) + 1
    if low < 1 or high > ordered.size:
        return None
    return [float(ordered[low - 1]), float(ordered[high - 1])]


def _coverage(group: Group, name: str, *, independent: bool) -> JsonObject | None:
    """How often the interval of an estimate contains the true value; None: no case has both."""
    true = group.values(f"{name}.true")
    low, high = group.values(f"{name}.low"), group.values(f"{name}.high")
    # the interval of a parameter that is not identifiable contains any value, also one from 0 to
    # infinity, of a positive parameter
    known = np.isfinite(true) & ~np.isnan(low) & ~np.isnan(high)
    known &= np.isfinite(low) | np.isfinite(high)
    known &= ~_is_exact(group, name)
    known &= ~np.isinf(group.values(f"{name}.std"))
    inside, count = int(((low <= true) & (true <= high))[known].sum()), int(known.sum())
    if count == 0:
        return None
    return {
        "result": name, "group": group.label, "count": count, "inside": inside,
        "without_interval": len(group.rows) - count,
        "share": {
            "value": inside / count,
            "ci95": _share_interval(inside, count) if independent else None,
        },
    }  # fmt: skip


def _is_exact(group: Group, name: str) -> NDArray[np.bool_]:
    """Whether the interval of each case is only as wide as rounding errors: there was no noise."""
    low, high = group.values(f"{name}.low"), group.values(f"{name}.high")
    with np.errstate(invalid="ignore"):  # infinite ends
        return np.asarray(high - low <= _EXACT * np.abs(group.values(f"{name}.true")))


def _without_noise(groups: Sequence[Group], names: Sequence[str]) -> list[str]:
    """Estimates of which all intervals in some group are exact, so that it has no coverage."""
    return [
        name for name in names
        if any(_is_exact(group, name).any() for group in groups)
        and all(_coverage(group, name, independent=False) is None for group in groups)
    ]  # fmt: skip


def _share_interval(inside: int, count: int) -> list[float]:
    from scipy.stats import beta  # slow to import

    low = beta.ppf(_SIDE, inside, count - inside + 1) if inside else 0.0
    high = beta.ppf(1.0 - _SIDE, inside + 1, count - inside) if inside < count else 1.0
    return [float(low), float(high)]


# ---- failures and comparison -------------------------------------------------------------------


def _failures(rows: Sequence[CaseRow]) -> list[Json]:
    """Errors with the number of cases and the first of them, the most frequent first.

    Errors that differ only in their numbers are one.
    """
    failed = [(_NUMBER.sub("0", row.error), row) for row in rows if row.error]
    counts = Counter(error for error, _ in failed)
    first = dict(reversed(failed))
    return [
        {"error": first[error].error, "count": count, "index": first[error].index,
         "values": dict(first[error].values)}
        for error, count in counts.most_common()
    ]  # fmt: skip


def _without_effect(campaign: Campaign, rows: Sequence[CaseRow]) -> list[str]:
    """Axes along which no result of any case changes: the kind may not use the parameter.

    Noise that differs between the points of an axis changes the results, too, so such an axis is
    found only in results without noise, or with `same_noise`.

    Args:
        campaign: of the rows.
        rows: of all its cases.
    Returns:
        Their paths; none if all cases failed.
    """
    if all(row.error for row in rows):
        return []
    of_level = campaign.points * campaign.design.repeats
    found = list[str]()
    for axis in campaign.axes:
        seen: dict[str, str] = {}
        others = [one.path for one in campaign.axes if one is not axis]
        alike = len(axis.values) > 1 and all(
            seen.setdefault(
                repr([row.index % of_level, *(row.values[path] for path in others)]), outcome
            ) == outcome
            for row in rows
            for outcome in [repr((sorted(row.results.items()), row.error))]
        )  # fmt: skip
        found += [axis.path] if alike else []
    return found


def compared(
    here: Sequence[CaseRow],
    there: Mapping[str, Floats],
    *,
    independent: bool = True,
    in_pairs: bool = False,
) -> list[Json]:
    """Compare the results of two campaigns.

    Args:
        here: rows of this one.
        there: results of the other one, by name.
        independent: the cases of both are independent draws, see `draws_are_independent` and
            `is_random`.
        in_pairs: the cases are the same, see `share_cases`: only those with a value in both count.
    Returns:
        For each result with finite medians in both: the medians, the number of cases without a
        value, which they leave out, and the difference of the medians with its bootstrap interval.
    """
    rng = np.random.default_rng(_SEED)
    group, found = Group("", tuple(here)), list[Json]()
    for name in result_names(here):
        values, others = group.values(name), there.get(name, np.zeros(0))
        counted = ~np.isnan(values), ~np.isnan(others)
        if in_pairs and values.size == others.size:
            counted = (counted[0] & counted[1],) * 2
        first, second = values[counted[0]], others[counted[1]]
        if min(first.size, second.size) < LEAST_CASES:
            continue
        medians = [float(np.median(part)) for part in (first, second)]
        if not np.isfinite(medians).all():
            continue  # medians that were not reached have no difference
        drawn = [np.median(rng.choice(part, (_RESAMPLED, part.size)), axis=1)
                 for part in (first, second)]  # fmt: skip
        intervals = [median_interval(first), median_interval(second), None]
        if np.isfinite(drawn).all():
            intervals[2] = np.quantile(drawn[0] - drawn[1], [_SIDE, 1.0 - _SIDE]).tolist()
        if not independent:
            intervals = [None, None, None]
        found.append({
            "result": name,
            "here": {"value": medians[0], "ci95": intervals[0],
                     "without_value": len(here) - first.size},
            "there": {"value": medians[1], "ci95": intervals[1],
                      "without_value": others.size - second.size},
            "difference": {"value": medians[0] - medians[1], "ci95": intervals[2]},
        })  # fmt: skip
    return found


def share_cases(here: Mapping[str, Any], there: Mapping[str, Any]) -> bool:
    """Whether cases of the same index in two campaigns have the same draws and random numbers.

    Args:
        here: one campaign, as in its campaign.json.
        there: the other one.
    """
    names = ("seed", "design", "parameters", "order of the parameters")
    return all(here[name] == there.get(name) for name in names)


def paired(
    here: Sequence[CaseRow], there: Mapping[str, Floats], *, independent: bool
) -> list[Json]:
    """Compare two campaigns case by case, see `share_cases`.

    Args:
        here: rows of all cases of this one.
        there: results of all cases of the other one, by name.
        independent: the cases are independent draws.
    Returns:
        For each result of both: the number of cases with a finite value in both, the number of the
        others, and the smallest, the median and the largest difference (here minus there).
    """
    group, found = Group("", tuple(here)), list[Json]()
    for name in result_names(here):
        if name not in there or there[name].size != len(here):
            continue
        one = _differences(group.values(name), there[name], independent=independent)
        if one is not None:
            found.append({"result": name, **one})
    return found


def _differences(here: Floats, there: Floats, *, independent: bool) -> JsonObject | None:
    """Number, median and extremes of the finite differences; None: there are none."""
    with np.errstate(invalid="ignore"):  # infinity less infinity
        difference = here - there
    finite = np.sort(difference[np.isfinite(difference)])
    if not finite.size:
        return None
    return {
        "count": finite.size,
        "without_value": difference.size - finite.size,
        "least": float(finite[0]), "largest": float(finite[-1]),
        "median": {"value": _quantile(finite, 0.5),
                   "ci95": _order_interval(finite, 0.5) if independent else None},
    }  # fmt: skip
