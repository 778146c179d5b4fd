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
_MANY = {"agrees": "agree", "disagrees": "disagree"}
_VERDICTS = ("agrees", "disagrees", "inconclusive")


def summary_text(results: Results) -> str:
    """Main numbers, how many rows agree with the paper, how many intervals hold what has no noise.

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
    clauses = [text.format(_in_words(row)) for row, text in found if row and row.measured]
    sentences = ["; ".join(clauses)] if clauses else []
    if any(row.paper is not None for row in rows):
        sentences.append(_verdicts(rows))
    known = [row.noise_free_inside for row in rows if row.noise_free_inside is not None]
    if known:
        sentences.append(f"{sum(known)} of {len(known)} intervals contain the noise-free value")
    return " ".join(sentence[0].upper() + sentence[1:] + "." for sentence in sentences)


def _in_words(row: Quantity) -> str:
    unit = f" {row.unit}" if row.unit else ""
    paper = f", paper {value_text(row.paper)}{unit}" if row.paper is not None else ""
    return f"{row.measured_text}{unit} (95 % interval {row.interval_text}{paper})"


def _verdicts(rows: tuple[Quantity, ...]) -> str:
    """Counts of verdicts; rows whose value was put into the twin stand apart."""
    counts = {}
    for name, chosen in (
        ("found", [row for row in rows if not row.was_set]),
        ("set", [row for row in rows if row.was_set]),
    ):
        verdicts = [row.verdict for row in chosen if row.verdict in _VERDICTS]
        counts[name] = (
            len(verdicts),
            ", ".join(
                f"{verdicts.count(word)} {_MANY.get(word, word)}"
                for word in _VERDICTS
                if word in verdicts
            ),
        )
    told = f"{counts['found'][0]} results can be compared with the paper: {counts['found'][1]}"
    if counts["set"][0]:
        told += (
            f"; {counts['set'][0]} more were set in the twin or in the study and are no evidence"
        )
    return told
