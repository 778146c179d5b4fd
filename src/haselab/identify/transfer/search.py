"""Global search for a transfer function: likely starts first, all of them in case of doubt."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from haselab.identify.noise import whiteness_p
from haselab.identify.record import Record
from haselab.identify.transfer.checks.ambiguity import has_unique_delay
from haselab.identify.transfer.layout import Layout, layout_of
from haselab.identify.transfer.problem import LEAST_GAIN, Columns, Found, TransferProblem
from haselab.identify.transfer.start import (
    SHARES,
    coarse_grid,
    delay_grid,
    delay_margin_s,
    delayed_starts,
    richer_start,
    search_bounds,
    starting_points,
    thinned,
)

__all__ = ["Best", "best_fit", "has_line", "settled"]

Floats = NDArray[np.float64]
_FEW = 150  # outputs per searched parameter used to rank and refine starts
_RULED_OUT = 100.0  # twice the difference of logarithmic likelihoods on fewer outputs
_ABOUT = 9  # delays near the best one at which fewer poles are tried
_FULL = 6  # solutions that are refined on all outputs
_MOST = 40_000  # largest number of outputs on which a likely start is tried directly
_LIKELY = 2
_WHITE = 1e-3
_CANDIDATES = 2  # for the three numbers of one resonance; 2 more for each further number
_APART = 0.15
_LINE = 0.02  # damping ratio below which a pair among others may fit the noise
_DAMPED = 0.3
_PLACES = 6


@dataclass(frozen=True)
class Best:
    """The best solution that was found.

    Args:
        records: the experiments that were fitted.
        found: its parameters.
        columns: its residuals and sensitivities.
        bounds: lowest and highest searched parameters.
        whiteness_p: Ljung-Box probability of the residuals.
        others: further solutions from other starts.
    """

    records: Sequence[Record]
    found: Found
    columns: Columns
    bounds: tuple[Floats, Floats]
    whiteness_p: float
    others: tuple[Found, ...] = ()


def best_fit(
    layout: Layout,
    records: Sequence[Record],
    known: Sequence[Floats] = (),
    gain: float = LEAST_GAIN,
) -> Best | None:
    """Fit from several starts; None when none leads to a finite model.

    A likely start ends the search when its residuals are white and no other delay could
    explain as much. Otherwise starts at all delays are ranked and refined on fewer outputs, the
    likely ones on all. Known starts are the only ones. A search ends when a step lowers the cost by
    less than `gain`, relative to it.
    """
    problem = TransferProblem(layout, records, delay_margin_s(records))
    bounds = search_bounds(layout, records)
    spread = sum(float(((r.y - r.y.mean()) ** 2).sum()) for r in records)
    tried: list[Best] = []

    def explains(start: Floats) -> bool:
        best = settled(problem, records, np.clip(start, *bounds), bounds, gain)
        if best is None:
            return False
        tried.append(best)
        return best.whiteness_p > _WHITE and best.found.cost < 0.5 * spread

    starts = starting_points(layout, records)
    used: list[Floats] = []
    if not known and sum(record.y.size for record in records) <= _MOST:
        for start in islice(starts, _LIKELY):
            used.append(start)
            if explains(start) and has_unique_delay(layout, tried[-1].columns.residuals, records):
                if not any(True for _ in _without_lines(layout, tried[-1].found.search)):
                    return tried[-1]
                break
    found = list(known) or _polished(layout, records, [*used, *starts], delay_grid(layout, records))
    explained = [explains(start) for start in found]  # all of them, so that other minima are known
    if not any(explained) and not known:
        nearest = min(tried, key=lambda best: best.found.cost, default=None)
        for start in _from_simpler(layout, records, nearest):
            explains(start)
    if not tried:
        return None
    first = min(tried, key=lambda best: best.found.cost)
    for start in _without_lines(layout, first.found.search):
        explains(start)
    first = min(tried, key=lambda best: best.found.cost)
    return replace(first, others=tuple(best.found for best in tried if best is not first))


def _from_simpler(
    layout: Layout, records: Sequence[Record], nearest: Best | None
) -> Iterator[Floats]:
    """Starts from the fit with one fast pole fewer, at delays near the best one."""
    structure = layout.structure
    if structure.poles <= 2 or structure.fixed:
        return
    poles = structure.poles - 1
    simpler = layout_of(replace(structure, poles=poles, zeros=min(structure.zeros, poles - 1)))
    grid_s = delay_grid(layout, records)
    if nearest is not None and grid_s.size > 1:
        off = np.abs(grid_s - layout.full(nearest.found.search)[-1])
        grid_s = np.sort(grid_s[np.argsort(off)[:_ABOUT]])
    starts = _polished(simpler, records, [], grid_s)
    best = best_fit(simpler, records, starts) if starts else None
    if best is not None:
        yield from richer_start(layout, simpler, best.found.search, records)


def has_line(layout: Layout, search: Floats) -> bool:
    """Whether one of several pole pairs is nearly undamped, as a pair that fits noise."""
    numbers = layout.full(search)
    pairs = layout.sections[0].pairs
    return layout.structure.poles > 2 and any(numbers[z] < math.log(_LINE) for _, z in pairs)


def _without_lines(layout: Layout, search: Floats) -> Iterator[Floats]:
    """Starts with a damped pair in place of one that is nearly undamped.

    Among other poles such a pair may fit one line of the noise and hide a weakly excited
    resonance.
    """
    pairs = layout.sections[0].pairs
    numbers = layout.full(search)
    if layout.structure.poles < 3 or not np.isnan(layout.template[: 2 * len(pairs)]).all():
        return
    for at_omega, at_zeta in pairs:
        if numbers[at_zeta] > math.log(_LINE):
            continue
        others = [numbers[omega] for omega, _ in pairs if omega != at_omega]
        others += [-numbers[at] for at in layout.sections[0].reals]
        for omega in np.linspace(min(others) - 0.7, max(others) + 1.2, _PLACES):
            start = numbers.copy()
            start[at_omega], start[at_zeta] = omega, math.log(_DAMPED)
            start[-1] -= 2.0 * _DAMPED / math.exp(omega)  # its lag at low frequencies
            yield start[layout.free]


def settled(
    problem: TransferProblem,
    records: Sequence[Record],
    start: Floats,
    bounds: tuple[Floats, Floats],
    gain: float = LEAST_GAIN,
) -> Best | None:
    """The solution from one start, its parameters in order; None: no finite one."""
    found = problem.minimise(start, bounds, gain)
    if not math.isfinite(found.cost):
        return None
    ordered = problem.layout.ordered(found.search)
    if (ordered != found.search).any():
        found = replace(problem.project(ordered), settled=found.settled)
    columns = problem.columns(found)
    return Best(records, found, columns, bounds, whiteness_p(columns.residuals))


def _polished(
    layout: Layout, records: Sequence[Record], starts: Iterable[Floats], delays_s: Floats
) -> list[Floats]:
    """Solutions on fewer outputs that are not ruled out by better ones, the best first."""
    bounds = search_bounds(layout, records)
    reduced = thinned(records, _FEW * layout.free.size)
    few = TransferProblem(layout, reduced, delay_margin_s(records))
    spread = sum(float(((r.y - r.y.mean()) ** 2).sum()) for r in reduced)
    ranked = _ranked(few, starts, bounds)
    for share in SHARES:
        ranked += _ranked(few, delayed_starts(layout, records, delays_s, share), bounds)
        ranked.sort(key=lambda f: f.cost)
        if ranked and ranked[0].cost < 0.5 * spread:
            break
    else:
        ranked += _ranked(few, coarse_grid(layout, records), bounds)
        ranked.sort(key=lambda f: f.cost)
    if not ranked:
        return []
    scale = np.ones(layout.free.size)
    if delays_s.size > 1:
        scale[-1] = _APART / (0.5 * (delays_s[1] - delays_s[0]))
    most = max(_CANDIDATES * (layout.free.size - 2), 1) + 2 * _CANDIDATES
    found = [
        few.minimise(f.search, bounds, gain=1e-3) for f in islice(_distinct(ranked, scale), most)
    ]
    found = sorted((f for f in found if math.isfinite(f.cost)), key=lambda f: f.cost)
    if not found:
        return []
    kept = sum(record.y.size for record in reduced)
    least = found[0].cost * (1.0 + _RULED_OUT / kept)
    close = [f for k, f in enumerate(found) if k == 0 or f.cost < least]
    return [f.search for f in islice(_distinct(close, scale), _FULL)]


def _ranked(
    problem: TransferProblem, starts: Iterable[Floats], bounds: tuple[Floats, Floats]
) -> list[Found]:
    found = (problem.project(np.clip(start, *bounds)) for start in starts)
    return sorted((f for f in found if math.isfinite(f.cost)), key=lambda f: f.cost)


def _distinct(ranked: Sequence[Found], scale: Floats) -> Iterator[Found]:
    """Solutions that differ from all earlier ones by 15 % in a parameter or half a delay step."""
    kept: list[Found] = []
    for found in ranked:
        if all((scale * np.abs(found.search - f.search)).max(initial=0.0) > _APART for f in kept):
            kept.append(found)
            yield found
