"""The summary at the top of the page: agreement with the paper and what is missing."""

from __future__ import annotations

from collections.abc import Sequence

from haselab.report.results import VERDICTS, Quantity, Results

__all__ = ["counted", "summary_text", "verdict_counts"]

_MANY = {"agrees": "agree", "disagrees": "disagree"}


def summary_text(results: Results) -> str:
    """Summarise the number of results, the agreement with the paper and the noise-free comparison.

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
    sentences = [f"{counted(len(rows), 'result', 'results')}, by subject below"]
    if any(row.paper is not None for row in rows):
        sentences.append(_verdicts(rows, results.simulated))
    known = [row.noise_free_inside for row in rows if row.noise_free_inside is not None]
    if known:
        sentences.append(f"{sum(known)} of {len(known)} intervals contain the noise-free value")
    if results.not_played:
        missing = sum(len(ids) for ids, _ in results.not_played)
        sentences.append(
            f"{counted(missing, 'result is', 'results are')} missing, for the reasons listed below "
            "the other results"
        )
    return " ".join(sentence[0].upper() + sentence[1:] + "." for sentence in sentences)


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
