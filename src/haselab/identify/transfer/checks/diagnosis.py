"""Spikes, clipping and wrong times as causes of the residuals of a transfer function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from haselab.base import InputError
from haselab.identify.record import Record
from haselab.identify.transfer.checks.clipping import clipped_input, keep_outputs, without_clipped
from haselab.identify.transfer.checks.timing import KINDS, timing_cause
from haselab.identify.transfer.layout import Layout
from haselab.identify.transfer.search import Best, best_fit

__all__ = ["CAUSES", "Diagnosis", "diagnose"]

Floats = NDArray[np.float64]
_OUTPUT, _INPUT = "clipped output", "clipped input"
CAUSES = (_OUTPUT, _INPUT, *KINDS)
_FALSE_ALARM = 1e-3  # probability that white noise alone has a spike
_MOST_SPIKES = 0.05  # of the outputs
_ISOLATED = 3  # outputs in a row that a spike may take
_SMALL = 0.6  # of the spike: its neighbours are smaller
_AROUND = 4  # outputs either side of a spike, three quarters of which
_CALM = 0.45  # are below this part of it; an unmodelled resonance rings longer
_ROUNDS = 4
_LARGE = 0.3  # of the largest change of the input: larger changes count
_FEW = 4  # spikes, below which their times are not tested
_BY_CHANCE = 1e-3  # probability that spikes come so soon after changes of the input
_COLOURED = 1e-3  # whiteness below which clipping is tested


@dataclass(frozen=True)
class Diagnosis:
    """Defects found in the records, with the fit that accounts for them.

    Args:
        best: the solution for the remaining outputs.
        notes: one sentence for each exclusion.
        fault: why the parameters are not usable, as a status; None: they are.
        cause: the one of `CAUSES` that was found; None: none, or only spikes.
    """

    best: Best
    notes: tuple[str, ...] = ()
    fault: str | None = None
    cause: str | None = None


def diagnose(
    layout: Layout, best: Best, *, applied: bool, causes: Sequence[str] = CAUSES
) -> Diagnosis:
    """The fit without spikes and clipped outputs, where these explain the records better.

    Args:
        layout: order of the parameters.
        best: solution for all outputs.
        applied: whether the inputs are known to have been applied as recorded, by the same clock.
        causes: that are tested, besides spikes.
    """
    notes: list[str] = []
    if best.whiteness_p < _COLOURED or _spikes(best.columns.residuals) is not None:
        best, said = _without_spikes(layout, best)
        notes += said
    if best.whiteness_p < _COLOURED:
        free, said = without_clipped(layout, best) if _OUTPUT in causes else (None, [])
        if free is not None:
            return Diagnosis(free, (*notes, *said), cause=_OUTPUT)
        return Diagnosis(best, tuple(notes)) if applied else _named(layout, best, notes, causes)
    return Diagnosis(best, tuple(notes))


def _named(layout: Layout, best: Best, notes: list[str], causes: Sequence[str]) -> Diagnosis:
    """Check timing faults, a slew limit and a clipped input as the cause."""
    kinds = [kind for kind in KINDS if kind in causes]
    clipped = clipped_input(layout, best) if _INPUT in causes else None
    cause = timing_cause(layout, best, kinds) if kinds else None
    if clipped is not None and cause is not None:
        if _mean_square(clipped[1]) < _mean_square(cause.best):
            cause = None
        else:
            clipped = None
    if clipped is not None:
        return Diagnosis(best, tuple(notes), clipped[0], _INPUT)
    if cause is None:
        return Diagnosis(best, tuple(notes))
    if cause.fault or cause.best.whiteness_p < _COLOURED:
        return Diagnosis(best, tuple(notes), f"no result: {cause.sentence}", cause.kind)
    sentence = cause.sentence[0].upper() + cause.sentence[1:]
    return Diagnosis(cause.best, (*notes, sentence), cause=cause.kind)


def _mean_square(best: Best) -> float:
    return best.found.cost / sum(r.y.size for r in best.records)


def _spread(residuals: Sequence[Floats]) -> float:
    """Standard deviation estimated by the median, so a few outliers do not affect it."""
    return 1.4826 * float(np.median(np.abs(np.concatenate(residuals))))


def _spikes(residuals: Sequence[Floats]) -> list[NDArray[np.bool_]] | None:
    """Mark isolated outliers among small residuals; None when there are none or too many."""
    count = sum(e.size for e in residuals)
    std = _spread(residuals)
    limit = -float(ndtri(0.5 * _FALSE_ALARM / count)) * std
    if not std > 0.0 or max(float(np.abs(e).max()) for e in residuals) <= limit:
        return None
    marks = []
    for e in residuals:
        size = np.abs(e)
        far = size > limit
        ends = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(np.int8), [0]])))
        mark = np.zeros(e.size, bool)
        for first, last in zip(ends[::2], ends[1::2], strict=True):
            around = np.r_[size[max(first - _AROUND, 0) : first], size[last : last + _AROUND]]
            beside = np.r_[size[max(first - 1, 0) : first], size[last : last + 1]]
            largest = size[first:last].max()
            small = beside.max(initial=0.0) < _SMALL * largest
            calm = np.quantile(around, 0.75) < _CALM * largest
            mark[first:last] = last - first <= _ISOLATED and small and calm
        marks.append(mark)
    found = sum(int(mark.sum()) for mark in marks)
    return marks if 0 < found <= _MOST_SPIKES * count else None


def _since_change(record: Record) -> Floats:
    """Time of each output since the last large change of the input, in s."""
    steps = np.abs(np.diff(record.u))
    large = np.flatnonzero(steps > _LARGE * steps.max(initial=0.0)) + 1
    if not large.size:
        return np.full(record.y.size, record.duration_s)
    changes_s = np.concatenate([[-record.duration_s], large / record.input_rate_hz])
    last_s = changes_s[np.searchsorted(changes_s, record.output_time_s, side="right") - 1]
    return np.asarray(record.output_time_s - last_s)


def _follow_input(records: Sequence[Record], marks: Sequence[NDArray[np.bool_]]) -> bool:
    """Whether outliers follow changes of the input; they are then model error, not spikes."""
    since_s = np.concatenate([_since_change(record) for record in records])
    mark = np.concatenate(list(marks))
    if mark.sum() < _FEW:
        return False
    from scipy.stats import ks_2samp  # the import takes half a second

    return bool(ks_2samp(since_s[mark], since_s, alternative="greater").pvalue < _BY_CHANCE)


def _without_spikes(layout: Layout, best: Best) -> tuple[Best, list[str]]:
    """The fit without spikes; a fit misled by spikes is searched again."""
    left_out, limit = 0, 0.0
    for _ in range(_ROUNDS):
        marks = _spikes(best.columns.residuals)
        if marks is None:
            break
        if _follow_input(best.records, marks):
            return best, [
                "Outputs soon after changes of the input are far off: the model does not describe "
                "how the motion begins. An additional mode may explain them."
            ]
        try:
            records = [keep_outputs(r, ~mark) for r, mark in zip(best.records, marks, strict=True)]
        except InputError:
            break
        found = best_fit(layout, records)
        if found is None:
            break
        left_out += sum(int(mark.sum()) for mark in marks)
        limit = max(limit, _spread(best.columns.residuals))
        best = found
    if not left_out:
        return best, []
    count = left_out + sum(r.y.size for r in best.records)
    return best, [f"{left_out} of {count} outputs are spikes (isolated outliers) and are excluded."]
