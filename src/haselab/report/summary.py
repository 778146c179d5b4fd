"""The paragraph at the head of the page: the main numbers in words."""

from __future__ import annotations

from haselab.report.numbers import value_text
from haselab.report.results import Quantity, Results

__all__ = ["summary_text"]

_MAIN = (
    ("S20.omega_n", "The fast mode lies at {}"),
    ("S20.zeta", "its damping ratio is {}"),
    ("S24.rise_open", "the open-loop step rises in {}"),
    ("S24.rise_closed", "the closed-loop step in {}"),
    ("S24.error_open", "the open loop keeps an error of {}"),
    ("S24.error_closed", "the closed loop one of {}"),
    ("S26.rise", "the step on the chip rises in {}"),
    ("S26.error", "its loop keeps an error of {}"),
)


def summary_text(results: Results) -> str:
    """Main numbers, how many rows agree with the paper, how many intervals hold the truth.

    Args:
        results: checked content of results.json.

    Returns:
        One paragraph of plain text.

    Example:
        >>> summary_text(Results((), {}))
        'The folder holds no quantities.'
    """
    rows = results.quantities
    if not rows:
        return "The folder holds no quantities."
    found = [(results.get(identifier), text) for identifier, text in _MAIN]
    clauses = [text.format(_in_words(row)) for row, text in found if row and row.measured]
    sentences = ["; ".join(clauses)] if clauses else []
    if any(row.paper is not None for row in rows):
        sentences.append(_verdicts(rows))
    known = [row.truth_inside for row in rows if row.truth_inside is not None]
    if known:
        sentences.append(f"On the twin, {sum(known)} of {len(known)} intervals hold the truth")
    return " ".join(sentence[0].upper() + sentence[1:] + "." for sentence in sentences)


def _in_words(row: Quantity) -> str:
    unit = f" {row.unit}" if row.unit else ""
    paper = f", paper {value_text(row.paper)}{unit}" if row.paper is not None else ""
    return f"{row.measured_text}{unit} (95 % interval {row.interval_text}{paper})"


def _verdicts(rows: tuple[Quantity, ...]) -> str:
    compared = [row for row in rows if row.verdict in ("agrees", "disagrees")]
    agree = sum(row.verdict == "agrees" for row in compared)
    return (
        f"Of {len(compared)} quantities that the paper gives, {agree} agree with it and "
        f"{len(compared) - agree} disagree; {len(rows) - len(compared)} have no verdict "
        "against the paper"
    )
