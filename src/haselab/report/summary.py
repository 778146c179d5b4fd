"""The summary at the top of the page: the main numbers in one paragraph."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from haselab.report.numbers import value_text
from haselab.report.results import VERDICTS, Quantity, Results

__all__ = ["counted", "summary_text", "verdict_counts"]

_MAIN = (
    ("S20.omega_n", "The natural frequency of the fast mode is {}"),
    ("S20.zeta", "its damping ratio is {}"),
    ("S25.rise_own", "the rise time with the controller {kind} is {}"),
    ("S25.overshoot_own", "the overshoot with the controller {kind} is {}"),
    ("S25.error_own", "the final error with the controller {kind} is {}"),
    ("S24.rise_open", "the open-loop rise time is {}"),
    ("S24.rise_closed", "the closed-loop rise time is {}"),
    ("S24.error_open", "the open-loop final error is {}"),
    ("S24.error_closed", "the closed-loop final error is {}"),
    ("S26.rise", "on the microcontroller the rise time is {}"),
    ("S26.error", "its final error is {}"),
)
_MANY = {"agrees": "agree", "disagrees": "disagree"}


def summary_text(results: Results) -> str:
    """Summarise the main numbers, the agreement with the paper and the noise-free comparison.

    Args:
        results: checked content of results.json.

    Returns:
        One paragraph of plain text.

    Example:
        >>> summary_text(Results((), {}))
        'The folder contains no results.'
    """
    rows = results.quantities
    if not rows:
        return "The folder contains no results."
    found = [(results.get(identifier), text) for identifier, text in _MAIN]
    kind = _own_kind(results)
    clauses = [
        text.format(_in_words(row), kind=kind)
        for row, text in found
        if row and row.measured and not math.isnan(row.measured.value)
    ]
    sentences = ["; ".join(clauses)] if clauses else []
    if any(row.paper is not None for row in rows):
        sentences.append(_verdicts(rows, results.simulated))
    known = [row.noise_free_inside for row in rows if row.noise_free_inside is not None]
    if known:
        sentences.append(f"{sum(known)} of {len(known)} intervals contain the noise-free value")
    if results.not_played:
        missing = sum(len(ids) for ids, _ in results.not_played)
        sentences.append(
            f"{counted(missing, 'result is', 'results are')} missing, for the reasons listed below "
            "the table of results"
        )
    return " ".join(sentence[0].upper() + sentence[1:] + "." for sentence in sentences)


def _own_kind(results: Results) -> str:
    """The kind of the study's own controller, in quotation marks."""
    study = results.provenance.get("study")
    control = study.get("control") if isinstance(study, Mapping) else None
    kind = control.get("kind") if isinstance(control, Mapping) else None
    return f"'{kind}'" if kind else "of [control] kind"


def _in_words(row: Quantity) -> str:
    unit = f" {row.unit}" if row.unit else ""
    paper = f", paper {value_text(row.paper)}{unit}" if row.paper is not None else ""
    return f"{row.measured_text}{unit} (95 % interval {row.interval_text}{paper})"


def _verdicts(rows: Sequence[Quantity], simulated: bool) -> str:
    """Agreement with the paper, each printed quantity once; a twin is no evidence."""
    compared = [row for row in rows if row.is_compared]
    found = [row for row in compared if not row.was_set]
    if simulated:
        groups = {
            "were set in the twin": sum(bool(row.set_in_twin) for row in compared),
            "follow from its parameters": sum(bool(row.follows_from_twin) for row in compared),
            "were set in the study": sum(bool(row.set_in_study) for row in compared),
            "come from simulated trials": len(found),
        }
        text = ", ".join(f"{count} {what}" for what, count in groups.items() if count)
        return (
            "the bench is simulated, so agreement or disagreement with the paper is no evidence: "
            f"of {counted(len(compared), 'printed quantity', 'printed quantities')}, {text}"
        )
    text = f"{counted(len(found), 'result', 'results')} can be compared with the paper"
    if found:
        text += f": {verdict_counts(found)}"
    if len(found) < len(compared):
        text += f"; {len(compared) - len(found)} more were set in the study and are no evidence"
    return text


def counted(count: int, one: str, more: str) -> str:
    """A number with its noun, singular or plural."""
    return f"{count} {one if count == 1 else more}"


def verdict_counts(rows: Sequence[Quantity]) -> str:
    """How many rows have each verdict, as text."""
    found = [row.verdict for row in rows]
    words = [word for word in (*VERDICTS, *sorted(set(found) - set(VERDICTS))) if word in found]
    return ", ".join(
        f"{found.count(word)} {_MANY.get(word, word) if found.count(word) > 1 else word}"
        for word in words
    )
