"""Results over the axes of a campaign that has too few cases at each point for distributions."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base import Json, JsonObject
from haselab.campaign.definition import Axis, Campaign
from haselab.store.campaign.shards import CaseRow

__all__ = ["over_axes"]

Floats = NDArray[np.float64]
_MOST_POINTS = 400  # of a table over two axes


def over_axes(
    campaign: Campaign, rows: Sequence[CaseRow], values: Mapping[str, Floats]
) -> Iterator[JsonObject]:
    """Summarise each result at each value of an axis, over all values of the other axes.

    If exactly two axes vary, it is also summarised at each pair of their values, up to 400 pairs.

    Args:
        campaign: of the rows.
        rows: of all its cases.
        values: results of these cases by name; NaN where there is none. Shape `(N,)` each.
    Yields:
        One result over one axis or two: for each of their points the number of cases with a value
        and of those without, and the smallest, the median and the largest value. Axes with a
        single value are left out.
    """
    varied = [axis for axis in campaign.axes if len(axis.values) > 1]
    chosen: list[tuple[Axis, ...]] = [(axis,) for axis in varied]
    if len(varied) == 2 and len(varied[0].values) * len(varied[1].values) <= _MOST_POINTS:
        chosen.append(tuple(varied))
    for axes in chosen:
        places = _places(axes, rows)
        for name in values:
            points = [
                {"at": list(point), **_summary(values[name][places[point]])}
                for point in itertools.product(*(axis.values for axis in axes))
            ]
            yield {"result": name, "axes": [axis.path for axis in axes], "points": points}


def _places(axes: Sequence[Axis], rows: Sequence[CaseRow]) -> dict[tuple[Json, ...], list[int]]:
    """Indices of the rows at each point of some axes."""
    found: dict[tuple[Json, ...], list[int]] = {
        point: [] for point in itertools.product(*(axis.values for axis in axes))
    }
    for place, row in enumerate(rows):
        found[tuple(row.values[axis.path] for axis in axes)].append(place)
    return found


def _summary(values: Floats) -> JsonObject:
    present = np.sort(values[~np.isnan(values)])
    counts: JsonObject = {
        "count": present.size, "without_value": values.size - present.size,
    }  # fmt: skip
    if present.size == 0:
        return counts
    median = statistics.median(present.tolist())  # that of numpy warns of infinities of both signs
    return counts | {
        "least": float(present[0]), "median": median, "largest": float(present[-1]),
    }  # fmt: skip
