"""The global search of a transfer function: likely starts first, all of them where in doubt."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from haselab.identify.noise import whiteness_p
from haselab.identify.record import Record
from haselab.identify.transfer_layout import Layout, layout_of
from haselab.identify.transfer_problem import Columns, Found, Problem
from haselab.identify.transfer_start import (
    coarse_grid,
    delay_margin_s,
    richer_start,
    search_bounds,
    starting_points,
    thinned,
)

__all__ = ["Best", "best_fit"]

Floats = NDArray[np.float64]
_FEW = 400  # outputs on which starts are ranked and polished
_MOST = 40_000  # outputs on which a likely start is tried at once
_LIKELY = 2
_WHITE = 1e-3
_CANDIDATES = 2  # for the three numbers of one resonance; 2 more for each further number
_APART = 0.15


@dataclass(frozen=True)
class Best:
    """The best solution that was found.

    Args:
        records: the experiments that it belongs to.
        found: its numbers.
        columns: its residuals and sensitivities.
        bounds: lowest and highest searched numbers.
        whiteness_p: Ljung-Box probability of the residuals.
    """

    records: Sequence[Record]
    found: Found
    columns: Columns
    bounds: tuple[Floats, Floats]
    whiteness_p: float


def best_fit(layout: Layout, records: Sequence[Record]) -> Best | None:
    """The best of several starts; None when none leads to a finite model.

    A likely start whose residuals are white ends the search, for nothing is left to explain.
    Else all starts are ranked and polished on fewer outputs, the best on all.
    """
    margin_s, bounds = delay_margin_s(records), search_bounds(layout, records)
    problem = Problem(layout, records, margin_s)
    spread = sum(float(((r.y - r.y.mean()) ** 2).sum()) for r in records)
    starts = starting_points(layout, records)
    tried: list[Best] = []
    used: list[Floats] = []
    if sum(record.y.size for record in records) <= _MOST:
        for start in islice(starts, _LIKELY):
            used.append(start)
            best = _settled(problem, records, np.clip(start, *bounds), bounds)
            if best is not None:
                tried.append(best)
                if best.whiteness_p > _WHITE and best.found.cost < 0.5 * spread:
                    return best
    few = Problem(layout, thinned(records, _FEW), margin_s)
    polished = _polished(few, layout, records, [*used, *starts], bounds, spread)
    for start in [*(found.search for found in polished[:1]), *_from_simpler(layout, records)]:
        best = _settled(problem, records, np.clip(start, *bounds), bounds)
        tried += [] if best is None else [best]
    return min(tried, key=lambda best: best.found.cost, default=None)


def _from_simpler(layout: Layout, records: Sequence[Record]) -> Iterator[Floats]:
    """Starts from the fit with one fast pole fewer."""
    structure = layout.structure
    if structure.poles <= 2 or structure.fixed:
        return
    poles = structure.poles - 1
    simpler = layout_of(replace(structure, poles=poles, zeros=min(structure.zeros, poles - 1)))
    best = best_fit(simpler, records)
    if best is not None:
        yield from richer_start(layout, simpler, best.found.search, records)


def _settled(
    problem: Problem, records: Sequence[Record], start: Floats, bounds: tuple[Floats, Floats]
) -> Best | None:
    found = problem.minimise(start, bounds)
    if not math.isfinite(found.cost):
        return None
    columns = problem.columns(found)
    return Best(records, found, columns, bounds, whiteness_p(columns.residuals))


def _polished(
    few: Problem,
    layout: Layout,
    records: Sequence[Record],
    starts: Iterable[Floats],
    bounds: tuple[Floats, Floats],
    spread: float,
) -> list[Found]:
    """Solutions on fewer outputs, the best first."""
    ranked = _ranked(few, starts, bounds)
    thin = sum(record.y.size for record in records)
    kept = sum(residual.size for residual in few.columns(ranked[0]).residuals) if ranked else 0
    if not ranked or ranked[0].cost > 0.5 * spread * kept / thin:
        ranked = sorted(
            [*ranked, *_ranked(few, coarse_grid(layout, records), bounds)], key=lambda f: f.cost
        )
    most = max(_CANDIDATES * (layout.free.size - 2), 1)
    found = [few.minimise(f.search, bounds, gain=1e-3) for f in islice(_distinct(ranked), most)]
    return sorted((f for f in found if math.isfinite(f.cost)), key=lambda f: f.cost)


def _ranked(
    problem: Problem, starts: Iterable[Floats], bounds: tuple[Floats, Floats]
) -> list[Found]:
    found = (problem.project(np.clip(start, *bounds)) for start in starts)
    return sorted((f for f in found if math.isfinite(f.cost)), key=lambda f: f.cost)


def _distinct(ranked: Sequence[Found]) -> Iterator[Found]:
    """Those that differ from all earlier ones by 15 % or more in some searched number."""
    kept: list[Found] = []
    for found in ranked:
        if all(np.abs(found.search - f.search).max(initial=0.0) > _APART for f in kept):
            kept.append(found)
            yield found
