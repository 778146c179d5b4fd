"""Groups of results by subject, the main ones first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from haselab.report.results import Quantity

__all__ = ["ResultGroup", "is_empty", "result_groups"]


@dataclass(frozen=True)
class _Subject:
    """A subject of results.

    Args:
        name: of the group in the page's address.
        title: in plain words.
        prefixes: of the ids; of two that fit, the longer one counts.
        main: ids of the most important results, in their order.
    """

    name: str
    title: str
    prefixes: tuple[str, ...]
    main: tuple[str, ...] = ()


_FREQUENCIES = ("S20.omega_n", "S20.eq8_omega_n", "S19.omega_0")
_OF_FREQUENCIES = (
    "The natural frequencies are those of different motions and definitions, so their intervals "
    "need not overlap: S20 is of the chirp, with a slow branch (S20.omega_n) or without "
    "(S20.eq8_omega_n); S19 is of the free response, which has another amplitude and another "
    "motion before it."
)
_OF_MODEL = (
    " Where a row states a fit of the experiment alone, its value and its much narrower interval "
    "are those of the physical model of all experiments together."
)
_SUBJECTS = (
    _Subject(
        "reach", "Reach, operating point and elasticity", ("S16.", "S17.", "S18."),
        ("S18.strain_min", "S18.strain_max", "S18.baseline", "S18.rest", "S17.region_low",
         "S17.region_high"),
    ),
    _Subject(
        "maps", "Maps between voltage, strain and capacitance", ("S13.", "S14.", "S15."),
        ("S14.zero", "S15.slope", "S15.offset", "S13.residual_first", "S13.peak_drift"),
    ),
    _Subject(
        "dynamics", "Dynamics: natural frequency, damping and slow motion", ("S19.", "S20."),
        ("S20.omega_n", "S20.zeta", "S20.gain_per_volt", "S20.gain", "S20.slow_gain",
         "S20.slow_tau", "S20.delay", "S19.omega_0"),
    ),
    _Subject(
        "controllers", "Controllers: gains, stability margins and limits", ("S21.", "S22.", "S25."),
        ("S25.kp", "S25.ki", "S25.kd", "S25.phase_margin", "S25.gain_margin", "S21.kp", "S21.ki",
         "S21.phase_margin", "S21.gain_margin"),
    ),
    _Subject(
        "trials", "Steps in open and closed loop",
        ("S24.", "S22.saturated_", "S22.recovery_", "S25.rise_", "S25.overshoot_", "S25.error_"),
        ("S24.rise_open", "S24.error_open", "S24.rise_closed", "S24.error_closed", "S25.rise_own",
         "S25.overshoot_own", "S25.error_own", "S25.rise_pid", "S25.overshoot_pid",
         "S25.error_pid"),
    ),
    _Subject(
        "model-control", "Control with the physical model",
        ("S25.rise_observer", "S25.overshoot_observer", "S25.error_observer", "S27.", "S30."),
        ("S25.rise_observer", "S25.overshoot_observer", "S25.error_observer", "S27.rise_own",
         "S27.overshoot_own", "S27.error_own"),
    ),
    _Subject(
        "chip-control", "Control on the microcontroller", ("S26.", "S28."),
        ("S26.rise", "S26.overshoot", "S26.error", "S26.phase_margin"),
    ),
)  # fmt: skip
_LAST = _Subject(
    "sensing-chain", "Sensing by phase, as in the paper", ("S6.", "S7.", "S8.", "S10.")
)
_OTHER = "Further results"


@dataclass(frozen=True)
class ResultGroup:
    """Results of one subject.

    Args:
        name: in the page's address.
        title: in plain words.
        main: shown at once.
        details: shown when the reader asks for them.
        note: what a reader has to know to compare the rows; `""`: nothing.
    """

    name: str
    title: str
    main: tuple[Quantity, ...]
    details: tuple[Quantity, ...] = ()
    note: str = ""

    @property
    def tables(self) -> tuple[tuple[Quantity, ...], tuple[Quantity, ...]]:
        """The two tables, of which the second may be empty."""
        return self.main, self.details

    @property
    def has_paper(self) -> bool:
        """Whether the paper has a value of any of them."""
        return any(row.has_paper for row in (*self.main, *self.details))


def is_empty(row: Quantity) -> bool:
    """Whether a row has no value."""
    return row.measured is None or math.isnan(row.measured.value)


def result_groups(rows: Sequence[Quantity], analysis: Mapping[str, Any]) -> list[ResultGroup]:
    """Group the rows that have a value.

    Args:
        rows: of the table, in the file's order.
        analysis: parsed analysis.json, which names the experiments of other packages.

    Returns:
        Groups with at least one row; those of other packages after haselab's own, and the paper's
        way of sensing last.

    Example:
        >>> from haselab.report.results import Results
        >>> value = {"value": 1.0, "std": 0.1, "ci95": [0.8, 1.2]}
        >>> ids = ("S6.carrier_gain", "mine.end", "S20.zeta")
        >>> rows = Results.from_dict({"quantities": [{"id": i, "measured": value} for i in ids]})
        >>> [group.title for group in result_groups(rows.quantities, {})][1:]
        ['Further results', 'Sensing by phase, as in the paper']
    """
    titles = _titles(analysis)
    subjects = [*_SUBJECTS, *_foreign(rows, titles), _LAST]
    found: dict[str, list[Quantity]] = {}
    for row in rows:
        if not is_empty(row):
            found.setdefault(_subject(row.id, titles), []).append(row)
    return [_group(subject, found[subject.name]) for subject in subjects if subject.name in found]


def _titles(analysis: Mapping[str, Any]) -> dict[str, str]:
    """Title of the experiment of each row, by id."""
    listed = analysis.get("experiments")
    return {
        str(key): str(one.get("title") or _OTHER)
        for one in (listed if isinstance(listed, list) else [])
        if isinstance(one, Mapping) and isinstance(one.get("ids"), list)
        for key in one["ids"]
    }


def _foreign(rows: Sequence[Quantity], titles: Mapping[str, str]) -> list[_Subject]:
    """Subjects of results that haselab does not know: one for each experiment."""
    known = {subject.name for subject in (*_SUBJECTS, _LAST)}
    names = dict.fromkeys(_subject(row.id, titles) for row in rows)
    return [_Subject(name, name, ()) for name in names if name not in known]


def _subject(key: str, titles: Mapping[str, str]) -> str:
    """Name of the subject of a result."""
    fitting = [
        (len(prefix), subject.name)
        for subject in (*_SUBJECTS, _LAST)
        for prefix in subject.prefixes
        if key.startswith(prefix)
    ]
    return max(fitting)[1] if fitting else titles.get(key, _OTHER)


def _group(subject: _Subject, rows: Sequence[Quantity]) -> ResultGroup:
    by_id = {row.id: row for row in rows}
    main = tuple(by_id[key] for key in subject.main if key in by_id)
    details = tuple(row for row in rows if row.id not in subject.main)
    name = "results-" + "-".join("".join(c if c.isalnum() else " " for c in subject.name).split())
    if not main or len(details) == 1:  # nothing to unfold, or too little
        main, details = (*main, *details), ()
    note = ""
    if sum(key in by_id for key in _FREQUENCIES) > 1:
        modelled = any(row.direct is not None for row in rows)
        note = _OF_FREQUENCIES + (_OF_MODEL if modelled else "")
    return ResultGroup(name.lower(), subject.title, main, details, note)
