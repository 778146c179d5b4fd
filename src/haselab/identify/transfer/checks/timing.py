"""Clock drift, lost outputs or rows and a slew limit as explanations of the residuals of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from haselab import _identify
from haselab.base import InputError
from haselab.identify.noise import autoregression
from haselab.identify.record import Record
from haselab.identify.residual_tests import input_correlation_p
from haselab.identify.transfer.checks.ambiguity import whitened_energy
from haselab.identify.transfer.checks.clipping import keep_outputs, richer_fits
from haselab.identify.transfer.layout import Layout
from haselab.identify.transfer.problem import Found, TransferProblem
from haselab.identify.transfer.search import Best, best_fit
from haselab.identify.transfer.start import delay_grid, delay_margin_s

__all__ = ["KINDS", "Cause", "timing_cause"]

Floats = NDArray[np.float64]
KINDS = ("drift", "slew", "lost outputs", "lost rows")
# Twice the gain of logarithmic likelihood that identifies a cause, besides the search's own gain.
_BETTER = 50.0
_MOST_NUMBERS = 4  # searched parameters: three poles and a delay; more would take minutes
_WHITE = 1e-3
_UNRELATED = 0.01
_MOST_LEFT = 0.3  # of the residuals' energy, where they are not white
_DRIFT = 0.01  # largest difference of two clocks
_MOST_DRIFTS = 15  # either side
_SLEWS = 12
_LONGEST = 0.2  # of a record: the longest time that a typical step of the input may take
_FINER = 4  # points per sample of a slew-limited input
_STEPS = 18  # of the search for one number
_ROUGH = 1e-6  # of the cost: a step that gains less ends such a search
_NUDGE = 1e-3  # of the distance of two places: to find the slope of the residuals
_ENOUGH = 4_000  # outputs that decide where a cause is searched for
_UNEVEN = 0.5 * (math.sqrt(5.0) - 1.0)  # golden ratio: parts of its multiples fill 0 to 1 evenly
_PART = 0.4  # of a record, from either end, to which a model is fitted
_MOST_LOST = 0.1  # of a record
_MOST_SHIFTS = 400
_NEAR = 12  # outputs about a place where rows may be missing
_KEPT = 3
_ELSEWHERE = 0.1
_ROUNDS = 3
_EDGE = 16  # outputs at either end, where a loss cannot be detected


@dataclass(frozen=True)
class Cause:
    """An explanation of the residuals of a fit.

    Args:
        best: the fit with it.
        sentence: description for the user.
        places: number of places that were searched.
        fault: whether the result is unusable; else `best` is the result.
        kind: what it is, one of `KINDS`.
    """

    best: Best
    sentence: str
    places: int
    fault: bool
    kind: str


_CauseSearch = Callable[[Layout, Best, Sequence[Floats]], Cause | None]


def timing_cause(layout: Layout, best: Best, kinds: Sequence[str] = KINDS) -> Cause | None:
    """The most likely cause of these kinds, or None when none explains the records.

    It has to be more likely than the fit and than linear models with another pole or slow branch,
    by 50 in twice the logarithmic likelihood and by what the search over many places gains from
    noise alone, and to leave white residuals, or a third of them uncorrelated with the input.
    """
    if layout.free.size > _MOST_NUMBERS:
        return None
    causes = [cause for cause in _causes(layout, best, kinds) if _explains(cause, best)]
    if not causes:
        return None
    count = sum(r.y.size for r in best.records)
    chosen = min(causes, key=lambda cause: _mean_square(cause.best))
    polynomial = autoregression(chosen.best.columns.residuals)[0]
    own = _log_energy(chosen.best, polynomial)
    for _, richer in richer_fits(layout, best):
        if count * (_log_energy(richer, polynomial) - own) < _BETTER:
            return None
    return chosen


def _causes(layout: Layout, best: Best, kinds: Sequence[str]) -> Iterator[Cause]:
    starts = [best.found.search]
    first = best.records[0]
    part = _part_fit(layout, first, np.arange(first.y.size) < _PART * first.y.size, starts)
    if part is not None and np.abs(part.found.search - starts[0]).max(initial=0.0) > _ELSEWHERE:
        starts.append(part.found.search)  # a part may show clearly what the whole record hides
    lost_outputs = partial(_lost_outputs, first=part)
    searches: tuple[_CauseSearch, ...] = (_drift, _slew, lost_outputs, _lost_rows)
    for kind, search in zip(KINDS, searches, strict=True):
        cause = search(layout, best, starts) if kind in kinds else None
        if cause is not None:
            yield cause


def _mean_square(best: Best) -> float:
    return best.found.cost / sum(r.y.size for r in best.records)


def _log_energy(best: Best, polynomial: Floats) -> float:
    residuals = best.columns.residuals
    energy = max(whitened_energy(residuals, polynomial), 1e-300)
    return math.log(energy / sum(e.size for e in residuals))


def _explains(cause: Cause, best: Best) -> bool:
    polynomial = autoregression(cause.best.columns.residuals)[0]
    count = sum(r.y.size for r in best.records)
    gain = count * (_log_energy(best, polynomial) - _log_energy(cause.best, polynomial))
    if gain < _BETTER + 2.0 * math.log(cause.places):
        return False
    if cause.best.whiteness_p > _WHITE:
        return True
    related = input_correlation_p(cause.best.records, cause.best.columns.residuals)
    return related > _UNRELATED and _mean_square(cause.best) < _MOST_LEFT * _mean_square(best)


def _refit(layout: Layout, records: Sequence[Record], starts: Sequence[Floats]) -> Best | None:
    return best_fit(layout, records, starts)


def _least(
    layout: Layout,
    best: Best,
    changed: Callable[[Record, float], Record],
    starts: Sequence[Floats],
    places: Sequence[float],
    reach: float,
) -> tuple[float, Best] | None:
    """The best value of a change of the records, of some places and then between them.

    Outputs that are spread over the records decide where it is; the fit is to all of them.
    """
    few, margin_s = _spread_out(best.records), delay_margin_s(best.records)

    def found_at(value: float, known: Sequence[Floats]) -> Found | None:
        try:
            records = [changed(record, value) for record in few]
        except InputError:
            return None
        problem = TransferProblem(layout, records, margin_s)
        inside = (np.clip(start, *best.bounds) for start in known)
        found = [problem.minimise(start, best.bounds, _ROUGH) for start in inside]
        return min(found, key=lambda one: one.cost)

    def fitted(value: float, start: Floats) -> Best | None:
        try:
            return _refit(layout, [changed(record, value) for record in best.records], [start])
        except InputError:
            return None

    tried = [(value, found) for value in places if (found := found_at(value, starts)) is not None]
    if not tried:
        return None
    at, least = min(tried, key=lambda pair: pair[1].cost)
    low, high = at - reach, at + reach

    def cost(value: float) -> float:
        nonlocal at, least
        found = found_at(value, [least.search, *starts])
        if found is not None and found.cost < least.cost:
            at, least = value, found
        return math.inf if found is None else found.cost

    minimize_scalar(
        cost, bounds=(low, high), method="bounded",
        options={"maxiter": _STEPS, "xatol": 1e-4 * reach},
    )  # fmt: skip
    fit = fitted(at, least.search)
    if fit is None:
        return None
    if few is not best.records:
        at, fit = _stepped(fitted, at, fit, _NUDGE * reach)
    return at, fit


def _stepped(
    fitted: Callable[[float, Floats], Best | None], at: float, fit: Best, nudge: float
) -> tuple[float, Best]:
    """One step of Gauss and Newton towards the value that leaves the least residuals."""
    other = fitted(at + nudge, fit.found.search)
    if other is None:
        return at, fit
    residuals, others = (np.concatenate(one.columns.residuals) for one in (fit, other))
    slope = (others - residuals) / nudge
    steepness = float(slope @ slope)
    nearer = at - float(slope @ residuals) / steepness if steepness > 0.0 else at
    finer = fitted(nearer, fit.found.search)
    if finer is None or not finer.found.cost < fit.found.cost:
        return at, fit
    return nearer, finer


def _spread_out(records: Sequence[Record]) -> Sequence[Record]:
    """The records with fewer outputs, at uneven distances: they see every part of a period."""
    stride = sum(record.y.size for record in records) / _ENOUGH
    if stride < 2.0:
        return records
    few = []
    for record in records:
        index = np.arange(int(record.y.size / stride))
        picked = (stride * (index + index * _UNEVEN % 1.0)).astype(np.intp)
        keep = np.zeros(record.y.size, bool)
        keep[picked[picked < keep.size]] = True
        few.append(record if keep.sum() < 2 * _EDGE else keep_outputs(record, keep))
    return few


def _motion_s(layout: Layout, records: Sequence[Record]) -> float:
    """An eighth of a period of the output's motion."""
    known = not math.isnan(float(layout.template[-1]))
    free = _free_delay(layout) if known else layout
    grid_s = delay_grid(free, records)
    return float(grid_s[1] - grid_s[0]) if grid_s.size > 1 else records[0].output_step_s


def _free_delay(layout: Layout) -> Layout:
    """The layout with a free delay."""
    template = layout.template.copy()
    template[-1] = math.nan
    return replace(layout, template=template)


def _drift(layout: Layout, best: Best, starts: Sequence[Floats]) -> Cause | None:
    """The output's clock runs faster or slower than the input's."""
    longest_s = max(r.duration_s for r in best.records)
    # A shift by a quarter period at either end of the record is within reach of the search.
    step = min(2.0 * 2.0 * _motion_s(layout, best.records) / longest_s, _DRIFT)
    count = min(int(_DRIFT / step), _MOST_DRIFTS)

    def drifting(record: Record, part: float) -> Record:
        return replace(record, output_time_s=record.output_time_s * (1.0 + part))

    places = [k * step for k in range(-count, count + 1)]
    found = _least(layout, best, drifting, starts, places, step)
    if found is None:
        return None
    part, fit = found
    way = "slower" if part > 0.0 else "faster"
    return Cause(
        fit,
        f"the clock of the output seems to run {abs(100.0 * part):.3g} % {way} than that of the "
        "input; record both with one clock, or give the output's true times",
        2 * count + 1 + _STEPS,
        fault=True,
        kind="drift",
    )


def _slew(layout: Layout, best: Best, starts: Sequence[Floats]) -> Cause | None:
    """The applied input follows the recorded one at a limited rate."""
    changes = np.concatenate([np.abs(np.diff(r.u)) for r in best.records])
    largest = float(changes.max(initial=0.0))
    changes = changes[changes > 1e-3 * largest]
    if changes.size == 0 or any(r.hold == "band-limited" for r in best.records):
        return None
    usual = float(np.median(changes))
    shortest_s = 0.5 / max(r.input_rate_hz for r in best.records)
    longest_s = _LONGEST * min(r.duration_s for r in best.records)
    places = np.log(usual / np.geomspace(shortest_s, longest_s, _SLEWS))

    def slow(record: Record, logarithm: float) -> Record:
        return _limited(record, math.exp(logarithm))

    reach = float(places[0] - places[1])
    found = _least(layout, best, slow, starts, places.tolist(), reach)
    if found is None:
        return None
    logarithm, fit = found
    return Cause(
        fit,
        f"the applied input seems to be limited to a rate of {math.exp(logarithm):.4g} per second "
        "(slew limit), but the recorded input is faster; record the applied input, or stay below "
        "the limit",
        _SLEWS + _STEPS,
        fault=True,
        kind="slew",
    )


def _limited(record: Record, rate: float) -> Record:
    """The record with its input limited to a rate."""
    period_s = 1.0 / (record.input_rate_hz * _FINER)
    most = rate * period_s
    fine = np.repeat(record.u, _FINER)
    if record.hold == "first":
        at = np.arange(fine.size) / _FINER
        fine = np.interp(at, np.arange(record.u.size), record.u)
    before = record.input_before if record.input_before is not None else float(record.u[0])
    applied = _identify.follow_slowly(fine, before, most)
    return replace(record, u=applied, input_rate_hz=record.input_rate_hz * _FINER, hold="first")


def _lost_outputs(
    layout: Layout, best: Best, starts: Sequence[Floats], first: Best | None
) -> Cause | None:
    """From some output on, all times are wrong by a whole number of samples.

    `first` is the fit to the first part of the first record.
    """
    chosen: Cause | None = None
    for i, record in enumerate(best.records):
        for at, shift, start in _shifts(layout, record, starts, first if i == 0 else None):
            found = _moved(layout, best, i, (at, shift), [*starts, start])
            if found is None or (chosen and _mean_square(found[0]) >= _mean_square(chosen.best)):
                continue
            fit, (at, shift) = found
            from_s = record.output_time_s[at]
            sentence = (
                f"{shift} outputs before {from_s:.4g} s seem to be lost: the later ones follow the "
                "input too early; their times are corrected."
                if shift > 0
                else f"from {from_s:.4g} s on the outputs are {-shift} samples late (repeated "
                "outputs, or lost inputs); their times are corrected."
            )
            places = record.y.size * _MOST_SHIFTS
            chosen = Cause(fit, sentence, places, fault=False, kind="lost outputs")
    return chosen


def _moved(
    layout: Layout, best: Best, i: int, place: tuple[int, int], starts: Sequence[Floats]
) -> tuple[Best, tuple[int, int]] | None:
    """The fit with later outputs shifted, and the place that is most likely by this fit."""
    record, fit = best.records[i], None
    for _ in range(_ROUNDS):
        at, shift = place
        times_s = record.output_time_s.copy()
        times_s[at:] += shift * record.output_step_s
        try:
            moved = replace(record, output_time_s=times_s)
        except InputError:
            return None
        found = _refit(layout, [moved if k == i else r for k, r in enumerate(best.records)], starts)
        if found is None or (fit and _mean_square(found) >= _mean_square(fit[0])):
            break
        fit = (found, place)
        again = _places(layout, record, found, np.arange(record.y.size) < at, early=True)
        if not again or (again[0][1], again[0][2]) == place:
            break
        place = (again[0][1], again[0][2])
    return fit


def _most_lost(record: Record) -> int:
    return min(int(_MOST_LOST * record.y.size), _MOST_SHIFTS // 2)


def _shifts(
    layout: Layout, record: Record, starts: Sequence[Floats], first: Best | None
) -> list[tuple[int, int, Floats]]:
    """Likely places and sizes of a loss, from models of the first and last part of a record.

    Each comes with the parameters of that model, for the corrected times.
    """
    count = record.y.size
    found: list[tuple[float, int, int, Floats]] = []
    for early in (True, False):
        keep = np.arange(count) < _PART * count
        keep = keep if early else keep[::-1]
        # After a loss the output may come before its input: a known delay accounts for it.
        free = math.isnan(float(layout.template[-1]))
        pad_s = 0.0 if early or not free else _most_lost(record) * record.output_step_s
        later = [np.append(start[:-1], start[-1] + pad_s) for start in starts] if pad_s else starts
        padded = replace(record, output_time_s=record.output_time_s + pad_s)
        fit = first if early and first is not None else _part_fit(layout, padded, keep, later)
        if fit is not None:
            for total, at, shift in _places(layout, padded, fit, keep, early=early)[:_KEPT]:
                start = fit.found.search.copy()
                if free and not early:
                    start[-1] += shift * record.output_step_s - pad_s
                found.append((total, at, shift, start))
    found.sort(key=lambda place: place[0])
    return [(at, shift, start) for _, at, shift, start in found[:_KEPT]]


def _part_fit(
    layout: Layout, record: Record, keep: NDArray[np.bool_], starts: Sequence[Floats]
) -> Best | None:
    """The fit to some outputs; all delays are searched where the residuals are not white."""
    try:
        part = [keep_outputs(record, keep)]
    except InputError:
        return None
    fit = best_fit(layout, part, starts)
    if fit is None or fit.whiteness_p < _WHITE:
        other = best_fit(layout, part)
        if fit is None or (other is not None and other.found.cost < fit.found.cost):
            fit = other
    return fit


def _places(
    layout: Layout, record: Record, fit: Best, keep: NDArray[np.bool_], *, early: bool
) -> list[tuple[float, int, int]]:
    """Sum of squares, place and size of a loss for each size, the most likely first.

    The model belongs to the early or the late outputs; the others are shifted against it.
    """
    count, step_s, most = record.y.size, record.output_step_s, _most_lost(record)
    wide_s = step_s * np.arange(-most, count + most) + record.output_time_s[0]
    inside = wide_s >= 0.0
    rows = wide_s[inside]
    grid = replace(record, y=np.arange(rows.size) * 1.0, output_time_s=rows)
    # Without the free motion of the start, which a late part does not determine.
    found = replace(fit.found, own=[np.zeros_like(fit.found.own[0])])
    modelled = np.empty(wide_s.size)
    modelled[inside] = TransferProblem(layout, [grid], delay_margin_s([grid])).predict(found)[0]
    modelled[~inside] = modelled[inside][0]
    modelled += float(np.mean((record.y - modelled[most : most + count])[keep]))
    base = np.concatenate([[0.0], np.cumsum((record.y - modelled[most : most + count]) ** 2)])
    places = []
    for shift in range(-most, most + 1):
        first = most + shift
        squared = (record.y - modelled[first : first + count]) ** 2
        other = np.concatenate([[0.0], np.cumsum(squared)])
        total = base + other[-1] - other if early else other + base[-1] - base
        at = int(np.argmin(total[_EDGE:-_EDGE])) + _EDGE
        if shift:
            places.append((float(total[at]), at, shift if early else -shift))
    return sorted(places)


def _lost_rows(layout: Layout, best: Best, starts: Sequence[Floats]) -> Cause | None:
    """Rows of input and output are missing; the plant has a new initial state after them."""
    chosen: Cause | None = None
    for i, record in enumerate(best.records):
        e = best.columns.residuals[i] ** 2
        if record.hold == "band-limited" or not layout.structure.initial_state:
            continue
        width = max(_EDGE, e.size // 40)
        burst = np.convolve(e, np.ones(width), "valid")
        start = int(np.argmax(burst))
        inside = e[start : start + width]
        first = start + int(np.argmax(inside > 0.1 * inside.max()))
        for at in range(first - _NEAR, first + 3):
            parts = _parted(layout, best, record, at)
            if parts is None:
                continue
            records = [*best.records[:i], *parts, *best.records[i + 1 :]]
            fit = _refit(layout, records, starts)
            if fit is None or (chosen and _mean_square(fit) >= _mean_square(chosen.best)):
                continue
            chosen = Cause(
                fit,
                f"rows seem to be missing at {record.output_time_s[at]:.4g} s; the record is cut "
                "there.",
                record.y.size,
                fault=False,
                kind="lost rows",
            )
    return chosen


def _parted(layout: Layout, best: Best, record: Record, at: int) -> list[Record] | None:
    """The record before and after an output; without outputs that missing inputs may affect."""
    if not _EDGE <= at < record.y.size - _EDGE:
        return None
    cut_s = float(record.output_time_s[at])
    edge = round(cut_s * record.input_rate_hz)
    delay_s = max(float(layout.full(best.found.search)[-1]), 0.0)
    start_s = edge / record.input_rate_hz
    late = record.output_time_s >= cut_s + delay_s + 2.0 * record.output_step_s
    if late.sum() < _EDGE or edge >= record.u.size - 1:
        return None
    try:
        before = keep_outputs(record, np.arange(record.y.size) < at)
        after = replace(
            record,
            u=record.u[edge:],
            y=record.y[late],
            output_time_s=record.output_time_s[late] - start_s,
            input_before=float(record.u[edge]),
        )
    except InputError:
        return None
    return [before, after]
