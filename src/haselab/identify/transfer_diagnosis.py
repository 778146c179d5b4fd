"""Spikes and clipping as rival explanations of what a transfer function leaves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from haselab.base import InputError
from haselab.identify.record import Record
from haselab.identify.transfer_layout import Layout
from haselab.identify.transfer_problem import Problem
from haselab.identify.transfer_search import Best, best_fit
from haselab.identify.transfer_start import delay_margin_s

__all__ = ["Diagnosis", "diagnosed"]

Floats = NDArray[np.float64]
_FALSE_ALARM = 1e-3  # probability that white noise alone has a spike
_MOST_SPIKES = 0.05  # of the outputs
_ISOLATED = 3  # outputs in a row that a spike may take
_QUIET = 0.6  # of the spike: its neighbours are below
_ROUNDS = 4
_COLOURED = 1e-3  # whiteness below which clipping is tried
_BETTER = 50.0  # twice the gain of logarithmic likelihood that names a cause
_SHARE = 0.7  # of the residuals' energy that must remain less than
_LEVELS = (0.999, 0.99, 0.97, 0.93, 0.88, 0.8, 0.7)  # quantiles at which a clipping is looked for
_INPUT_LEVELS = (0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
_CLEAR = 4.0  # standard deviations below a rail where an output counts as free of it


@dataclass(frozen=True)
class Diagnosis:
    """What was found in the records besides the plant.

    Args:
        best: the solution for what is left of them.
        notes: sentences about what was left out.
        fault: what makes the numbers unusable, as a status; None: nothing.
    """

    best: Best
    notes: tuple[str, ...] = ()
    fault: str | None = None


def diagnosed(layout: Layout, best: Best) -> Diagnosis:
    """The solution without spikes and clipped outputs, where these explain the records better.

    Args:
        layout: order of the numbers.
        best: solution for all outputs.
    """
    notes: list[str] = []
    if best.whiteness_p < _COLOURED or _spikes(best.columns.residuals) is not None:
        best, said = _without_spikes(layout, best)
        notes += said
    if best.whiteness_p < _COLOURED:
        free, said = _without_clipped(layout, best)
        if free is not None:
            return Diagnosis(free, (*notes, *said))
        fault = _clipped_input(layout, best)
        if fault is not None:
            return Diagnosis(best, tuple(notes), fault)
    return Diagnosis(best, tuple(notes))


def _spread(residuals: Sequence[Floats]) -> float:
    """Standard deviation by the median, which a few outliers do not move."""
    return 1.4826 * float(np.median(np.abs(np.concatenate(residuals))))


def _spikes(residuals: Sequence[Floats]) -> list[NDArray[np.bool_]] | None:
    """Which outputs are spikes: far off, alone among quiet neighbours; None: none or too many."""
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
            beside = np.r_[size[max(first - 1, 0) : first], size[last : last + 1]]
            quiet = beside.max(initial=0.0) < _QUIET * size[first:last].max()
            mark[first:last] = last - first <= _ISOLATED and quiet
        marks.append(mark)
    found = sum(int(mark.sum()) for mark in marks)
    return marks if 0 < found <= _MOST_SPIKES * count else None


def _kept(record: Record, keep: NDArray[np.bool_]) -> Record:
    return replace(record, y=record.y[keep], output_time_s=record.output_time_s[keep])


def _refit(layout: Layout, records: Sequence[Record], start: Best, *, anew: bool) -> Best | None:
    known = [] if anew else [start.found.search]
    return best_fit(layout, records, known)


def _without_spikes(layout: Layout, best: Best) -> tuple[Best, list[str]]:
    """The fit without spikes; a fit that spikes have misled is searched anew."""
    left_out, limit = 0, 0.0
    for _ in range(_ROUNDS):
        marks = _spikes(best.columns.residuals)
        if marks is None:
            break
        try:
            records = [_kept(r, ~mark) for r, mark in zip(best.records, marks, strict=True)]
        except InputError:
            break
        found = _refit(layout, records, best, anew=True)
        if found is None:
            break
        left_out += sum(int(mark.sum()) for mark in marks)
        limit = max(limit, _spread(best.columns.residuals))
        best = found
    if not left_out:
        return best, []
    count = left_out + sum(r.y.size for r in best.records)
    return best, [
        f"{left_out} of {count} outputs are spikes, alone and far off the model; they are left out."
    ]


def _without_clipped(layout: Layout, best: Best) -> tuple[Best | None, list[str]]:
    """The fit to outputs that a limit did not reach; None where no limit explains the records."""
    records = best.records
    count = sum(r.y.size for r in records)
    whole = Problem(layout, records, delay_margin_s(records))
    y = np.concatenate([r.y for r in records])
    chosen: tuple[float, Best, float, float] | None = None
    for low, high in _rails(y):
        found = _fit_between(layout, best, (y > low) & (y < high))
        if found is None:
            continue
        modelled = np.concatenate(whole.predict(found.found))
        bounds = _settled_rails(y, modelled, low, high)
        cost = float(((y - np.clip(modelled, *bounds)) ** 2).sum())
        if chosen is None or cost < chosen[0]:
            chosen = (cost, found, *bounds)
    if chosen is None:
        return None, []
    cost, found, low, high = chosen
    gain = count * math.log(best.found.cost / max(cost, 1e-300))
    if gain < _BETTER or cost > _SHARE * best.found.cost:
        return None, []
    for _ in range(2):  # free of the rail by the model, not by the noise of the output
        modelled = np.concatenate(whole.predict(found.found))
        std = math.sqrt(found.found.cost / sum(r.y.size for r in found.records))
        lowest, highest = low + _CLEAR * std, high - _CLEAR * std
        again = _fit_between(layout, best, (modelled > lowest) & (modelled < highest))
        if again is None:
            return None, []
        found = again
    left_out = count - sum(r.y.size for r in found.records)
    return found, [
        f"The output is clipped at {_shown(low, high)}: {left_out} of {count} outputs near that "
        "are left out."
    ]


def _shown(low: float, high: float) -> str:
    rails = [f"{rail:.4g}" for rail in (low, high) if math.isfinite(rail)]
    return " and ".join(rails)


def _rails(y: Floats) -> Iterator[tuple[float, float]]:
    """Ranges of the output that a clipping may have left free."""
    for share in _LEVELS:
        high, low = float(np.quantile(y, share)), float(np.quantile(y, 1.0 - share))
        yield -math.inf, high
        yield low, math.inf
        yield low, high


def _settled_rails(y: Floats, modelled: Floats, low: float, high: float) -> tuple[float, float]:
    """Rails at the median of the outputs whose model is beyond the range."""
    above, below = y[modelled > high], y[modelled < low]
    return (
        float(np.median(below)) if below.size > 2 else -math.inf,
        float(np.median(above)) if above.size > 2 else math.inf,
    )


def _fit_between(layout: Layout, best: Best, keep: NDArray[np.bool_]) -> Best | None:
    """The fit to the outputs that are kept; None where the rest is no record."""
    ends = np.cumsum([r.y.size for r in best.records])[:-1]
    try:
        records = [
            _kept(r, part) for r, part in zip(best.records, np.split(keep, ends), strict=True)
        ]
    except InputError:
        return None
    return _refit(layout, records, best, anew=False)


def _clipped_input(layout: Layout, best: Best) -> str | None:
    """A status, where an input that was limited without being recorded so explains the records."""
    count = sum(r.y.size for r in best.records)
    u = np.concatenate([r.u for r in best.records])
    middle = 0.5 * float(u.max() + u.min())
    half = 0.5 * float(np.ptp(u))
    chosen: tuple[float, float, float] | None = None
    for level in _INPUT_LEVELS:
        for low, high in (
            (middle - level * half, middle + level * half),
            (-math.inf, middle + level * half),
            (middle - level * half, math.inf),
        ):
            if not ((u < low) | (u > high)).any():
                continue
            limited = [_limited(r, low, high) for r in best.records]
            if any(np.ptp(r.u) == 0.0 for r in limited):
                continue
            found = _refit(layout, limited, best, anew=False)
            if found is not None and (chosen is None or found.found.cost < chosen[0]):
                chosen = (found.found.cost, low, high)
    if chosen is None:
        return None
    cost, low, high = chosen
    gain = count * math.log(best.found.cost / max(cost, 1e-300))
    if gain < _BETTER or cost > _SHARE * best.found.cost:
        return None
    return (
        f"no result: the input seems to be clipped at about {_shown(low, high)}, which the "
        "recorded input is not; record the input that was applied, or stay within the limit"
    )


def _limited(record: Record, low: float, high: float) -> Record:
    before = record.input_before
    return replace(
        record,
        u=np.clip(record.u, low, high),
        input_before=None if before is None else float(np.clip(before, low, high)),
    )
