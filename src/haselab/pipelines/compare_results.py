"""Compare the results of two runs row by row: differences, and whether noise explains them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist
from typing import Any

from haselab.base import InputError, JsonObject, is_real
from haselab.store.text_file import parse_json, read_text

__all__ = ["ComparedRow", "ResultsComparison", "compare_results"]

_RESULTS = "results.json"
_FALSE_ALARMS = 0.05  # share of comparisons without any change that still have a row marked
_SAME = 1e-3  # relative difference up to which a setting counts as the same
_SHOWN = 3  # rows and notes that are named in one sentence


@dataclass(frozen=True)
class ComparedRow:
    """One row of the results of two runs.

    Args:
        id: of the row, such as `S20.omega_n`.
        name: in words.
        unit: SI unit, `""` when dimensionless.
        first: value, std and ci95 in the first run; None: that run has no such row.
        second: the same of the second run.
        difference: the second value minus the first; None if it is not known.
        difference_ci95: its 95 % interval, from the intervals of both values; an end is infinite
            where an interval is open.
        deviations: the difference divided by the combined standard deviation; None if unknown.
        exceeds: whether the difference is larger than noise explains in a comparison of so many
            rows; None where that is not known: without an interval, or if settings of the same
            subject, such as the gains of a design, differ.
    """

    id: str
    name: str
    unit: str
    first: Mapping[str, Any] | None
    second: Mapping[str, Any] | None
    difference: float | None = None
    difference_ci95: tuple[float, float] | None = None
    deviations: float | None = None
    exceeds: bool | None = None

    @property
    def outside(self) -> bool | None:
        """Whether 0 lies outside the interval of the difference; None without an interval."""
        if self.difference_ci95 is None or self.deviations is None:
            return None
        low, high = self.difference_ci95
        return not low <= 0.0 <= high

    def to_dict(self) -> JsonObject:
        """Convert to a dictionary with the names of the attributes."""
        ends = self.difference_ci95
        return {
            "id": self.id, "name": self.name, "unit": self.unit,
            "first": self.first, "second": self.second, "difference": self.difference,
            "difference_ci95": None if ends is None else list(ends),
            "deviations": self.deviations, "exceeds": self.exceeds,
        }  # fmt: skip


@dataclass(frozen=True)
class ResultsComparison:
    """The results of two runs beside each other.

    Args:
        rows: all rows of both runs, in the order of the first. A row with two units is two rows.
        limit_deviations: a difference beyond it is marked; it grows with the number of rows.
        notes: what differs between the runs besides the results.
    """

    rows: tuple[ComparedRow, ...]
    limit_deviations: float
    notes: tuple[str, ...] = ()

    @property
    def compared(self) -> int:
        """Number of rows whose difference has an interval."""
        return sum(row.exceeds is not None for row in self.rows)

    @property
    def outside(self) -> int:
        """Number of rows with 0 outside the 95 % interval of the difference."""
        return sum(row.outside is True for row in self.rows if row.exceeds is not None)

    @property
    def exceeding(self) -> tuple[str, ...]:
        """Ids of the rows whose difference is larger than noise explains."""
        return tuple(row.id for row in self.rows if row.exceeds)

    @property
    def status(self) -> str:
        """`ok`, or what the comparison found."""
        if not self.compared:
            return "the runs have no row in common whose difference has an interval"
        found = self.exceeding
        if not found:
            return "ok"
        named = ", ".join(found[:_SHOWN]) + (" and others" if len(found) > _SHOWN else "")
        many = f"{len(found)} of {self.compared} rows differ" if len(found) > 1 else (
            f"1 of {self.compared} rows differs"
        )  # fmt: skip
        return f"{many} by more than noise explains: {named}"

    def to_dict(self) -> JsonObject:
        """Convert to a dictionary, for JSON."""
        return {
            "compared": self.compared,
            "outside_95_percent": self.outside,
            "expected_outside_by_noise": 0.05 * self.compared,
            "limit_deviations": self.limit_deviations,
            "exceeding": list(self.exceeding),
            "only_in_first": [row.id for row in self.rows if row.second is None],
            "only_in_second": [row.id for row in self.rows if row.first is None],
            "notes": list(self.notes),
            "status": self.status,
            "rows": [row.to_dict() for row in self.rows],
        }


def compare_results(first: Path, second: Path) -> ResultsComparison:
    """Compare results.json of two runs.

    The interval of a difference is computed from both intervals: with distances a and b of the ends
    from the values, its ends are at a distance of sqrt(a^2 + b^2). The errors of both runs are
    assumed to be independent. A difference exceeds what noise explains if 0 lies outside its
    interval and it has more combined standard deviations than the largest of so many independent
    rows has in 95 % of all comparisons.

    Args:
        first: folder of a run.
        second: folder of another run.
    Returns:
        The comparison; differences are the second value minus the first.
    Raises:
        InputError: a folder has no results that can be read.
    """
    documents = [_document(folder) for folder in (first, second)]
    one, other = (
        _rows(document, folder) for document, folder in zip(documents, (first, second), strict=True)
    )
    rows: list[ComparedRow] = []
    for key in {**one, **other}:
        left, right = one.get(key), other.get(key)
        if left and right and left["unit"] != right["unit"]:  # of two versions: not comparable
            rows += [_compared(key, left, None), _compared(key, None, right)]
        else:
            rows.append(_compared(key, left, right))
    chosen = [row for row in rows if _is_other_setting(row)]
    unlike = {_subject(row) for row in chosen}
    count = sum(row.deviations is not None and _subject(row) not in unlike for row in rows)
    limit = _limit(count)
    judged = tuple(row if _subject(row) in unlike else _judged(row, limit) for row in rows)
    notes = _notes(*documents)
    if chosen:
        named = ", ".join(row.id for row in chosen)
        notes.append(
            f"{named} are settings, such as gains of a design, and differ between the runs. So the "
            "other rows with the same first part of the id are not judged"
        )
    return ResultsComparison(judged, limit, tuple(notes))


def _subject(row: ComparedRow) -> str:
    return row.id.partition(".")[0]


def _is_other_setting(row: ComparedRow) -> bool:
    """Whether a row is a number that was chosen, so without an interval, and has changed."""
    if row.first is None or row.second is None or not row.difference:
        return False
    values = [(one["value"], *one["ci95"]) for one in (row.first, row.second)]
    exact = all(low == value == high for value, low, high in values)
    return exact and abs(row.difference) > _SAME * max(abs(value) for value, _, _ in values)


def _limit(count: int) -> float:
    """The size that the largest of so many normal deviations exceeds in 5 % of all cases."""
    each = 1.0 - (1.0 - _FALSE_ALARMS) ** (1.0 / max(count, 1))
    return NormalDist().inv_cdf(1.0 - each / 2.0)


def _judged(row: ComparedRow, limit: float) -> ComparedRow:
    if row.deviations is None:
        return row
    exceeds = bool(row.outside) and abs(row.deviations) > limit
    return ComparedRow(
        row.id, row.name, row.unit, row.first, row.second, row.difference,
        row.difference_ci95, row.deviations, exceeds,
    )  # fmt: skip


def _document(folder: Path) -> Mapping[str, Any]:
    path = folder / _RESULTS
    if folder.is_dir() and not path.exists():
        if (folder / "session.h5").exists():
            raise InputError(
                f"The run has no results yet. Create them with 'haselab analyse {folder}'."
            )
        raise InputError(
            f"The folder is not that of a run: it has neither {_RESULTS} nor session.h5. Name the "
            f"--out folder of a run: {folder}"
        )
    found = parse_json(read_text(path), path)
    if not isinstance(found, Mapping):
        raise _unreadable(folder)
    return found


def _rows(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    try:
        found = {str(row["id"]): row for row in document["quantities"] if row["measured"]}
        if not all(_is_result(row) for row in found.values()):
            raise ValueError
    except (ValueError, KeyError, TypeError, AttributeError):
        raise _unreadable(folder) from None
    return found


def _unreadable(folder: Path) -> InputError:
    return InputError(
        f"{_RESULTS} of the run cannot be read. Write it again with 'haselab analyse {folder}'."
    )


def _is_result(row: Mapping[str, Any]) -> bool:
    """Whether a row can be compared; a number that is not known is null."""
    measured = row["measured"]
    low, high = measured["ci95"]
    numbers = (measured["value"], measured["std"], low, high)
    texts = (row["name"], row["unit"])
    return all(one is None or is_real(one) for one in numbers) and all(
        isinstance(one, str) for one in texts
    )


def _compared(
    key: str, first: Mapping[str, Any] | None, second: Mapping[str, Any] | None
) -> ComparedRow:
    one, other = (None if row is None else row["measured"] for row in (first, second))
    about = first or second or {}
    row = ComparedRow(key, about["name"], about["unit"], one, other)
    if one is None or other is None or None in (one["value"], other["value"]):
        return row
    difference = other["value"] - one["value"]
    (below, above), (other_below, other_above) = _distances(one), _distances(other)
    ends = (
        difference - math.hypot(other_below, above),
        difference + math.hypot(other_above, below),
    )
    together = math.hypot(one["std"] or math.nan, other["std"] or math.nan)
    known = 0.0 < together < math.inf
    return ComparedRow(
        key, row.name, row.unit, one, other, difference, ends,
        difference / together if known else None,
    )  # fmt: skip


def _distances(measured: Mapping[str, Any]) -> tuple[float, float]:
    """Distances of both ends of the interval from the value; infinite for an open end."""
    value, (low, high) = measured["value"], measured["ci95"]
    return (
        math.inf if low is None else max(value - low, 0.0),
        math.inf if high is None else max(high - value, 0.0),
    )


def _notes(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """What differs between two runs besides their results."""
    one, other = (_about(document) for document in (first, second))
    notes = []
    for what, of_one, of_other in (
        ("kinds of actuator", one["kind"], other["kind"]),
        ("studies", one["study"], other["study"]),
        ("hung masses", one["mass"], other["mass"]),
    ):
        if of_one and of_other and of_one != of_other:
            notes.append(f"different {what}: {of_one} and {of_other}")
    if one["study"] == other["study"] and one["sha256"] != other["sha256"]:
        differing = ", ".join(_differing(one["sections"], other["sections"]))
        notes.append(
            "both studies have the same name, but differ"
            + (f" in {differing}" if differing else " in their files")
        )
    if one["simulated"] != other["simulated"]:
        notes.append("one run is simulated, the other is of a real bench")
    if one["recorded"] and one["recorded"] == other["recorded"] and first == second:
        notes.append("both folders have the same results: they are copies of one run")
    if one["unverified"] or other["unverified"]:
        notes.append("results are marked as unverified: a recording did not match its checksums")
    return notes


def _about(document: Mapping[str, Any]) -> dict[str, Any]:
    provenance = _table(document, "provenance")
    study, rig = _table(provenance, "study"), _table(provenance, "rig_config")
    mass = _table(rig, "load").get("mass_kg")
    return {
        "kind": str(rig.get("kind") or ""),
        "study": str(study.get("name") or ""),
        "mass": f"{mass:g} kg" if is_real(mass) else "",
        "sha256": provenance.get("study_sha256"),
        "sections": study,
        "simulated": document.get("simulated") is True,
        "recorded": provenance.get("recorded"),
        "unverified": document.get("unverified") is True,
    }


def _differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    return [key for key in {**one, **other} if one.get(key) != other.get(key)]


def _table(table: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    found = table.get(name)
    return found if isinstance(found, Mapping) else {}
