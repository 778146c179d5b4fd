"""Cases at the points of the axes, and the names of their results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Json
from haselab.campaign.definition import Campaign
from haselab.store.campaign.shards import CaseRow

__all__ = ["LEAST_CASES", "Group", "groups_of", "number_of", "result_names"]

Floats = NDArray[np.float64]
_OF_ESTIMATES = (".std", ".low", ".high", ".true")
_MOST_GROUPS = 24
LEAST_CASES = 8


@dataclass(frozen=True)
class Group:
    """Cases at one point of the axes.

    Args:
        label: values of the axes, in words; empty: all cases.
        rows: of the cases.
    """

    label: str
    rows: tuple[CaseRow, ...]

    def values(self, name: str) -> Floats:
        """A result of all cases; NaN where there is none. Shape `(N,)`."""
        return np.array([number_of(row.results.get(name)) for row in self.rows])

    def present(self, name: str) -> Floats:
        """A result of the cases that have it, infinite where it was not reached. Shape `(N,)`."""
        found = self.values(name)
        return found[~np.isnan(found)]


def number_of(value: Json) -> float:
    """A value as a number; NaN if it is none.

    Args:
        value: of a parameter or a result.
    """
    return float(value) if isinstance(value, (int, float)) else math.nan


def result_names(rows: Sequence[CaseRow]) -> list[str]:
    """Names of the results, without what belongs to an estimate.

    Args:
        rows: of cases.
    Returns:
        The names in alphabetical order.
    """
    found = dict.fromkeys(name for row in rows for name in row.results)
    return [name for name in sorted(found) if not name.endswith(_OF_ESTIMATES)]


def groups_of(campaign: Campaign, rows: Sequence[CaseRow]) -> list[Group]:
    """The cases at each point of the axes; all together if there is little at each, or too many.

    Args:
        campaign: of the rows.
        rows: in the order of their indices.
    Returns:
        The groups.
    """
    many = math.prod(len(axis.values) for axis in campaign.axes)
    each = campaign.count // many
    if many == 1 or many > _MOST_GROUPS or each < LEAST_CASES:
        return [Group("", tuple(rows))]
    short = _short_names([axis.path for axis in campaign.axes])
    found: dict[str, list[CaseRow]] = {}
    for row in rows:
        label = ", ".join(
            f"{name} = {row.values[axis.path]}"
            for name, axis in zip(short, campaign.axes, strict=True)
        )
        found.setdefault(label, []).append(row)
    return [Group(label, tuple(part)) for label, part in found.items()]


def _short_names(paths: Sequence[str]) -> list[str]:
    """The last parts of the paths; whole paths where those would not say which parameter it is."""
    last = [path.rpartition(".")[2] for path in paths]
    clear = len(set(last)) == len(last) and not any(name.isdecimal() for name in last)
    return last if clear else list(paths)
