"""Read and check results.json: the quantities of a study and their provenance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from haselab.base import Estimate, InputError
from haselab.report.numbers import interval_text, value_text

__all__ = ["VERDICTS", "Quantity", "Results", "named_ids"]

VERDICTS = ("agrees", "disagrees", "inconclusive")
_MOST_IDS, _FIRST_IDS = 8, 3  # that are named with one reason
_NOWHERE = (math.nan, math.nan)


def named_ids(ids: Sequence[str]) -> str:
    """Name results that a run does not have; of many with one reason, only the first.

    Args:
        ids: of the results; results.json has all of them.

    Returns:
        One line.

    Example:
        >>> named_ids(["a", "b"]), named_ids([*"abcdefghij"])
        ('a, b', 'a, b, c and 7 more')
    """
    if len(ids) <= _MOST_IDS:
        return ", ".join(ids)
    return f"{', '.join(ids[:_FIRST_IDS])} and {len(ids) - _FIRST_IDS} more"


@dataclass(frozen=True)
class Quantity:
    """One row of the table paper / recomputed / measured.

    Args:
        id: stable name, such as `S20.omega_n`.
        name: the quantity in words.
        unit: SI unit, `""` when dimensionless.
        paper: what the paper prints: number, text, range or `None`.
        recomputed: the value computed from the paper's own numbers, or `None`.
        measured: the study's estimate, or `None` if the fit gave no result.
        noise_free: the same experiment and fit on the twin with all noise off, in `unit`; `None` on
            a real bench.
        truth: the parameter of the twin, in `unit`; `None` if the quantity is not one.
        verdict: agrees, disagrees, inconclusive, not in paper.
        note: one sentence of explanation, or `""`.
        set_in_twin: what in the twin was set to the paper's value; `""`: nothing.
        set_in_study: what in the study was set to the paper's value; `""`: nothing.
        follows_from_twin: parameters of the twin that determine the value; `""`: none.
        same_as: id of the row with the same printed quantity; `""`: none.
        direct: the fit of the experiment alone, where `measured` is by the physical model.
    """

    id: str
    name: str
    unit: str
    paper: Any
    recomputed: Any
    measured: Estimate | None
    noise_free: float | None
    truth: float | None
    verdict: str
    note: str
    set_in_twin: str = ""
    set_in_study: str = ""
    follows_from_twin: str = ""
    same_as: str = ""
    direct: Estimate | None = None

    @property
    def direct_text(self) -> str:
        """The direct fit with its 95 % interval; `""` where there is none."""
        if self.direct is None:
            return ""
        return value_text(replace(self.direct, unit="").to_dict())

    @property
    def measured_text(self) -> str:
        """The value, with the digits that its standard deviation supports."""
        return self._texts()[0]

    @property
    def interval_text(self) -> str:
        """95 % interval in brackets."""
        return self._texts()[1]

    @property
    def has_paper(self) -> bool:
        """Whether the paper has a value to compare with, printed or recomputed."""
        return self.paper is not None or self.recomputed is not None

    @property
    def was_set(self) -> bool:
        """Whether the value was set beforehand, so that agreement is no evidence."""
        return bool(self.set_in_twin or self.set_in_study or self.follows_from_twin)

    @property
    def is_compared(self) -> bool:
        """Whether the row counts as a comparison with the paper, each printed quantity once."""
        return self.verdict in VERDICTS and not self.same_as

    @property
    def noise_free_inside(self) -> bool | None:
        """Whether the interval contains the noise-free value; `None` if that is unknown."""
        return self._inside(self.noise_free)

    @property
    def truth_inside(self) -> bool | None:
        """Whether the interval contains the twin's parameter; `None` if that is unknown."""
        return self._inside(self.truth)

    def _inside(self, value: float | None) -> bool | None:
        if self.measured is None or value is None:
            return None
        low, high = self.measured.ci95
        if math.isnan(self.measured.value) or (math.isnan(low) and math.isnan(high)):
            return None
        return not (value < low or value > high)

    def _texts(self) -> tuple[str, str]:
        if self.measured is None:
            return value_text(None), value_text(None)
        return interval_text(self.measured.value, self.measured.std, self.measured.ci95)


@dataclass(frozen=True)
class Results:
    """The content of results.json.

    Args:
        quantities: rows of the table, in the file's order.
        provenance: versions, seeds, configuration, as the study wrote them.
        simulated: whether the bench was simulated.
        verdict_rule: how agreement was decided; `""` if the file does not say.
        not_played: results of the study that this run does not have: their ids, and why.
    """

    quantities: tuple[Quantity, ...]
    provenance: Mapping[str, Any]
    simulated: bool = False
    verdict_rule: str = ""
    not_played: tuple[tuple[tuple[str, ...], str], ...] = ()

    @classmethod
    def from_dict(cls, data: Any) -> Results:
        """Check and read the parsed JSON document.

        Args:
            data: the document.

        Returns:
            The checked content.

        Raises:
            InputError: `quantities` is missing or a row lacks its id, or a number is not a number.

        Example:
            >>> Results.from_dict({"quantities": [], "provenance": {}}).quantities
            ()
        """
        if not isinstance(data, Mapping) or not isinstance(data.get("quantities"), list):
            raise InputError(
                "results.json has no list 'quantities'. Write the folder again with "
                "'haselab analyse DIR'."
            )
        rows = tuple(_quantity(row, at) for at, row in enumerate(data["quantities"]))
        provenance = data.get("provenance")
        return cls(
            rows,
            provenance if isinstance(provenance, Mapping) else {},
            data.get("simulated") is True,
            str(data.get("verdict_rule") or ""),
            _not_played(data.get("not_played")),
        )

    def get(self, identifier: str) -> Quantity | None:
        """The row with this id, or `None`."""
        return next((row for row in self.quantities if row.id == identifier), None)


def _not_played(data: Any) -> tuple[tuple[tuple[str, ...], str], ...]:
    items = data if isinstance(data, list) else []
    return tuple(
        (tuple(map(str, item["ids"])), str(item.get("reason") or "no reason given."))
        for item in items
        if isinstance(item, Mapping) and isinstance(item.get("ids"), list)
    )


def _number(value: Any) -> float:
    """Read a JSON number; null, written for NaN and infinity, becomes NaN."""
    return math.nan if value is None else float(value)


def _estimate(data: Any, unit: str) -> Estimate | None:
    if data is None:
        return None
    low, high = data.get("ci95") or _NOWHERE
    return Estimate(
        _number(data["value"]),
        _number(data.get("std")),
        (_number(low), _number(high)),
        str(data.get("unit") or unit),
    )


def _quantity(row: Any, at: int) -> Quantity:
    where = f"results.json: quantity {at}"
    if not isinstance(row, Mapping) or not isinstance(row.get("id"), str):
        raise InputError(
            f"{where} has no text 'id'. Write the folder again with 'haselab analyse'."
        )
    where = f"results.json: quantity {row['id']}"
    unit = str(row.get("unit") or "")
    alone = {name: row.get(name) for name in ("noise_free", "truth")}
    try:
        measured, direct = (_estimate(row.get(name), unit) for name in ("measured", "direct"))
        values = {name: None if value is None else float(value) for name, value in alone.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: 'measured' = {row.get('measured')!r}, 'direct' = {row.get('direct')!r}, "
            + ", ".join(f"{name!r} = {value!r}" for name, value in alone.items())
            + '. The first two must be null or {"value", "std", "ci95": [low, high], "unit"}, the '
            "others null or a number. "
            "Write the folder again with 'haselab analyse'."
        ) from error
    return Quantity(
        id=row["id"],
        name=str(row.get("name") or row["id"]),
        unit=unit,
        paper=row.get("paper"),
        recomputed=row.get("recomputed"),
        measured=measured,
        noise_free=values["noise_free"],
        truth=values["truth"],
        verdict=str(row.get("verdict") or "no verdict"),
        note=str(row.get("note") or ""),
        set_in_twin=str(row.get("set_in_twin") or ""),
        set_in_study=str(row.get("set_in_study") or ""),
        follows_from_twin=str(row.get("follows_from_twin") or ""),
        same_as=str(row.get("same_as") or ""),
        direct=direct,
    )
