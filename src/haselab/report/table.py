"""The table paper / recomputed / measured, for a terminal."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from haselab.report.numbers import value_text
from haselab.report.overview.summary import counted, verdict_counts
from haselab.report.results import Quantity, Results, named_ids

__all__ = ["results_table"]

_HEAD = (
    "id",
    "unit",
    "paper",
    "recomputed",
    "measured",
    "95 % interval",
    "noise-free",
    "agreement",
)
_GAP = "  "


def results_table(results: Mapping[str, Any], *, columns: int = 100) -> str:
    """Format a results document as plain text for the terminal.

    Args:
        results: the parsed results.json.
        columns: width of the terminal, at least 60.

    Returns:
        Lines of at most `columns` characters, if all numbers fit. The column `noise-free` is left
        out if no row has such a value, and those about a paper if no row is compared with one.

    Raises:
        InputError: the document is not a results document.

    Example:
        >>> row = {"id": "S20.zeta", "paper": 0.09, "verdict": "agrees", "measured":
        ...        {"value": 0.0912, "std": 0.0011, "ci95": [0.0891, 0.0934], "unit": ""}}
        >>> print(results_table({"quantities": [row]}))  # doctest: +NORMALIZE_WHITESPACE
        id        unit  paper  recomputed  measured  95 % interval     agreement
        --------  ----  -----  ----------  --------  ----------------  ---------
        S20.zeta        0.09   —           0.0912    [0.0891, 0.0934]  agrees
        <BLANKLINE>
        1 quantity: 1 agrees
    """
    found = Results.from_dict(results)
    rows = found.quantities
    noise_free = any(row.noise_free is not None for row in rows)
    paper = any(row.has_paper for row in rows)
    hidden = set() if noise_free else {"noise-free"}
    hidden |= set() if paper or not rows else {"paper", "recomputed", "agreement"}
    keep = [at for at, name in enumerate(_HEAD) if name not in hidden]
    cells = [[_cells(row)[at] for at in keep] for row in rows]
    head = [_HEAD[at] for at in keep]
    widths = _widths([head, *cells], columns)
    lines = _wrapped(head, widths)
    lines.append(_GAP.join("-" * width for width in widths))
    for row in cells:
        lines.extend(_wrapped(row, widths))
    return "\n".join(
        [
            *lines,
            "",
            *_missing(found, columns),
            *_empty(found, columns),
            *_blind(found, columns),
            *textwrap.wrap(_count(found), columns, break_on_hyphens=False),
        ]
    )


def _cells(row: Quantity) -> tuple[str, ...]:
    return (
        row.id,
        row.unit,
        value_text(row.paper),
        value_text(row.recomputed),
        row.measured_text,
        row.interval_text,
        value_text(row.noise_free) + (" (outside)" if row.noise_free_inside is False else ""),
        row.verdict + _mark(row),
    )


def _mark(row: Quantity) -> str:
    if row.set_in_twin or row.set_in_study:
        return " (set)"
    return " (twin)" if row.follows_from_twin else ""


def _widths(rows: list[list[str]], columns: int) -> list[int]:
    """Widths of the columns; the widest after the id are narrowed, but never below a word.

    So no number is broken, even if the lines become too long.
    """
    of = range(len(rows[0]))
    widths = [max(len(row[at]) for row in rows) for at in of]
    words = [max((len(word) for row in rows for word in row[at].split()), default=0) for at in of]
    while sum(widths) + len(_GAP) * (len(widths) - 1) > columns:
        wide = [at for at in of[1:] if widths[at] > words[at]]
        if not wide:
            break
        widths[max(wide, key=lambda at: widths[at])] -= 1
    return widths


def _wrapped(row: list[str], widths: list[int]) -> list[str]:
    columns = [textwrap.wrap(cell, width) or [""] for cell, width in zip(row, widths, strict=True)]
    height = max(len(column) for column in columns)
    padded = [column + [""] * (height - len(column)) for column in columns]
    return [
        _GAP.join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in zip(*padded, strict=True)
    ]


def _count(results: Results) -> str:
    rows = results.quantities
    text = counted(len(rows), "quantity", "quantities")
    if any(row.has_paper for row in rows):
        text += f": {verdict_counts(rows)}"
    if any(row.was_set for row in rows):
        text += (
            ". (set): set in the twin or in the study; (twin): follows from the twin's parameters; "
            "neither is evidence"
        )
    if any(row.noise_free_inside is False for row in rows):
        text += ". (outside): the noise-free result is outside the measured 95 % interval"
        if any(row.noise_free_inside is False and row.note for row in rows):
            text += " (see the notes of these rows in the report)"
    if results.simulated:
        compared = any(row.has_paper for row in rows)
        text += ". SIMULATED" + (": no verdict is evidence about the paper" if compared else "")
    return text


def _blind(results: Results, columns: int) -> list[str]:
    """Lines that name the results which the record does not determine."""
    ids = [row.id for row in results.quantities if row.note.startswith("not identifiable")]
    if not ids:
        return []
    text = f"not identifiable, so use no number alone (reasons in the report): {', '.join(ids)}"
    return textwrap.wrap(text, columns, subsequent_indent="  ", break_on_hyphens=False)


def _empty(results: Results, columns: int) -> list[str]:
    """Lines that give the reason why a row has no value, the first part of its note."""
    notes = [(row.id, row.note.partition("; ")[0]) for row in results.quantities]
    return [
        line
        for key, note in notes
        if note.startswith("no value: ")
        for line in textwrap.wrap(
            f"{key} has {note}", columns, subsequent_indent="  ", break_on_hyphens=False
        )
    ]


def _missing(results: Results, columns: int) -> list[str]:
    """Lines about results of the study that the run does not have."""
    lines = []
    for ids, reason in results.not_played:
        lines += textwrap.wrap(
            f"no result: {named_ids(ids)}: {reason}", columns, subsequent_indent="  ",
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
    return lines
