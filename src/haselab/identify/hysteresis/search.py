"""The best hysteresis model of each kind: dead zones, operators and rate chosen by BIC."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from haselab.identify.hysteresis.bouc_wen import BoucWenFamily, solve_bouc_wen
from haselab.identify.hysteresis.loops import LoopRecord
from haselab.identify.hysteresis.prandtl_ishlinskii import (
    PlayFamily,
    add_operator,
    evenly_spaced,
    play_model,
    with_rate,
)
from haselab.identify.hysteresis.problem import Family, HysteresisProblem, Numbers, Scale, Solved
from haselab.identify.model_choice import APART, bic, effective_count
from haselab.identify.training_output import grid_step

__all__ = [
    "BOUC_WEN",
    "CURVE",
    "ONE_RATE",
    "PLAYS",
    "Candidate",
    "rate_spread",
    "rounding_floor",
    "search_hysteresis",
]

Floats = NDArray[np.float64]
CURVE, PLAYS, BOUC_WEN = "curve", "prandtl-ishlinskii", "bouc-wen"
ONE_RATE = 1.5  # spread of the rates below which they count as one rate
_ZONES = (0, 2, 4, 8)
_TRIED_WITH = 2  # operators used while the dead zones are chosen
_MOST = 10
_SPREAD = (3, 6)
_PATIENCE = 2  # operators in a row that may fail to lower the criterion
_ROWS = 2500
_ROUNDING = 1e-18  # mean square of residuals, in units of half the span
_MOST_DIGITS, _OFF_DIGIT = 9, 1e-4  # of a printed number; largest distance from a whole unit
_OF_STEPS = 0.25  # of the mean square of rounding errors; below, the outputs are exact
_FILTER_SAMPLES = 4.0
_FILTERS = (0.0, 1.0, 2.0, 8.0, 16.0, 32.0, 64.0)


@dataclass(frozen=True)
class Candidate:
    """A solved model.

    Args:
        kind: curve, prandtl-ishlinskii or bouc-wen.
        family: memory model.
        solved: its parameters, with their cost on the thinned rows.
        detail: criterion within its kind, with every sample taken as independent: a part that
            repeats with the loop justifies parameters, even if it is not noise.
        bic: criterion between kinds, with the effective number of samples of the residuals.
    """

    kind: str
    family: Family
    solved: Solved
    detail: float
    bic: float


def rate_spread(problem: HysteresisProblem) -> float:
    """Ratio of the high to the low rates of the input in the rows (90 % to 10 % quantile)."""
    rates = [
        np.abs(np.diff(u, prepend=u[0])) * rate_hz
        for u, rate_hz in zip(problem.inputs, problem.rates_hz, strict=True)
    ]
    low, high = np.quantile(problem.pick(rates), [0.1, 0.9])
    return float(high / low) if low > 0.0 else float("inf") if high > 0.0 else 1.0


def rounding_floor(y: Floats, left: float) -> float:
    """Return the mean square of the rounding errors of an output, which repeat with the loop.

    Args:
        y: output. Shape `(N,)`.
        left: mean square of the residuals of the best model.
    Returns:
        The mean square; 0 if the output has no steps, or if the residuals are much smaller.
    """
    floor = max(grid_step(y), _last_digit(y)) ** 2 / 12.0
    return floor if left > _OF_STEPS * floor else 0.0


def _last_digit(y: Floats) -> float:
    """Unit of the last decimal digit of printed numbers; 0 if they have too many digits."""
    span = float(np.ptp(y))
    first = math.floor(math.log10(span)) if span > 0.0 else 0
    for power in range(first, first - _MOST_DIGITS, -1) if span > 0.0 else ():
        counts = y / 10.0**power
        if np.abs(counts - np.round(counts)).max() < _OFF_DIGIT:
            return float(10.0**power)
    return 0.0


class _Judge:
    """The criterion of all candidates, with one effective number of samples."""

    def __init__(
        self, problem: HysteresisProblem, richest: Solved, family: Family, outputs: Floats
    ) -> None:
        residuals = np.split(problem.residuals(family, richest.numbers), problem.ends)
        self.count = problem.y.size
        half_y, mean = problem.scale.half_y, richest.cost / self.count
        self.floor = max(rounding_floor(outputs, mean * half_y**2) / half_y**2, _ROUNDING)
        self.effective = effective_count(residuals)

    def rate(self, kind: str, family: Family, solved: Solved) -> Candidate:
        size = solved.numbers.vector.size
        detail, between = (
            bic(solved.cost, self.count, samples, size, self.floor)
            for samples in (self.count, self.effective)
        )
        return Candidate(kind, family, solved, detail, between)


def _best(tried: Sequence[Candidate]) -> Candidate:
    """The best candidate within its kind, with the lowest criterion of all tried."""
    lowest = min(candidate.bic for candidate in tried)
    return replace(min(tried, key=lambda candidate: candidate.detail), bic=lowest)


def search_hysteresis(
    records: Sequence[LoopRecord], scale: Scale, wanted: Sequence[str], operators: int | None
) -> tuple[HysteresisProblem, dict[str, Candidate]]:
    """The best candidate of each wanted kind, and of a curve without memory.

    Args:
        records: loops.
        scale: scaling of the search.
        wanted: kinds besides the curve.
        operators: number of play operators; None: chosen by BIC.
    Returns:
        The thinned problem, and candidates by kind.
    """
    problem = HysteresisProblem(records, scale, [record.settled() for record in records], _ROWS)
    none = PlayFamily(0)
    curves = [
        problem.solve(none, Numbers(np.zeros(0), 0.0, 1.0, np.zeros(0), np.ones(count)))
        for count in _ZONES
    ]
    paths = [_grow(problem, [(none, curve)], _TRIED_WITH) for curve in curves]
    family, richest = min((path[-1] for path in paths), key=lambda entry: entry[1].cost)
    outputs = np.concatenate([record.y for record in records])
    judge = _Judge(problem, richest, family, outputs)
    chosen = min(range(len(_ZONES)), key=lambda k: judge.rate(PLAYS, *paths[k][-1]).detail)
    curved = [judge.rate(CURVE, none, curve) for curve in curves]
    found = {CURVE: _best(curved)}
    if PLAYS in wanted:
        # Dead zones may have replaced operators not yet added, so also try without them.
        plays = [
            _best_plays(problem, judge, curves[k].numbers, paths[k], operators)
            for k in sorted({0, chosen})
        ]
        available = [candidate for candidate in plays if candidate is not None]
        if available:
            found[PLAYS] = _best(available)
    if BOUC_WEN in wanted:
        found[BOUC_WEN] = _best_bouc_wen(problem, judge, curves)
    return problem, found


def _best_bouc_wen(
    problem: HysteresisProblem, judge: _Judge, curves: Sequence[Solved]
) -> Candidate:
    """Choose the dead zones at an exponent of 1, then free the exponent."""
    tried = [
        judge.rate(BOUC_WEN, BoucWenFamily(), solve_bouc_wen(problem, curve.numbers, False))
        for curve in curves
    ]
    best = min(range(len(tried)), key=lambda k: tried[k].detail)
    free = solve_bouc_wen(problem, curves[best].numbers, True)
    return _best([*tried, judge.rate(BOUC_WEN, BoucWenFamily(True), free)])


def _grow(
    problem: HysteresisProblem, path: list[tuple[PlayFamily, Solved]], count: int
) -> list[tuple[PlayFamily, Solved]]:
    """Add operators until there are `count` or no further one is needed."""
    path = list(path)
    while path[-1][0].count < count:
        following = add_operator(problem, *path[-1])
        if following is None:
            break
        path.append(following)
    return path


def _best_plays(
    problem: HysteresisProblem,
    judge: _Judge,
    curve: Numbers,
    path: list[tuple[PlayFamily, Solved]],
    operators: int | None,
) -> Candidate | None:
    path = [entry for entry in path if entry[0].count > 0]
    if not path:
        return None
    side = path[0][0].side
    spread = [
        evenly_spaced(problem, curve, side, count)
        for count in ([operators] if operators else _SPREAD)
    ]
    tried = [
        _best_count(problem, judge, path, operators),
        *(judge.rate(PLAYS, *entry) for entry in spread if entry[0].count),
    ]
    if operators is not None:
        most = max(_count(candidate) for candidate in tried)
        tried = [candidate for candidate in tried if _count(candidate) == most]
    plain = _best(tried)
    if rate_spread(problem) < ONE_RATE:
        return plain
    filter_s = _FILTER_SAMPLES / max(problem.rates_hz)
    family = cast(PlayFamily, plain.family)
    widened = judge.rate(PLAYS, *with_rate(problem, family, plain.solved, filter_s))
    if operators is not None:
        return _best([plain, _filtered(problem, judge, widened)])
    first = with_rate(problem, *path[min(1, len(path) - 1)], filter_s)
    grown = _best_count(problem, judge, [first], operators)
    return _best([plain, _filtered(problem, judge, _best([grown, widened]))])


def _count(candidate: Candidate) -> int:
    return cast(PlayFamily, candidate.family).count


def _filtered(problem: HysteresisProblem, judge: _Judge, rated: Candidate) -> Candidate:
    """The best filter of the rate, from time constants a factor of 2 apart."""
    family = cast(PlayFamily, rated.family)
    tried = [rated]
    for samples in _FILTERS:
        other = replace(family, filter_s=samples / max(problem.rates_hz))
        solved = problem.solve(other, rated.solved.numbers)
        tried.append(judge.rate(PLAYS, other, solved))
    lowest = min(candidate.detail for candidate in tried)
    # Among filters that fit equally well, one with a stable inverse.
    equal = [candidate for candidate in tried if candidate.detail < lowest + APART]
    return min(equal, key=lambda candidate: (_runs_away(problem, candidate), candidate.detail))


def _runs_away(problem: HysteresisProblem, rated: Candidate) -> bool:
    model = play_model(cast(PlayFamily, rated.family), rated.solved.numbers, problem.scale)
    return model.feedback(max(problem.rates_hz)) >= 1.0


def _best_count(
    problem: HysteresisProblem,
    judge: _Judge,
    path: list[tuple[PlayFamily, Solved]],
    operators: int | None,
) -> Candidate:
    """Add operators one by one until the criterion has not fallen twice."""
    if operators is not None:
        path = [entry for entry in path if entry[0].count <= operators]
        return judge.rate(PLAYS, *_grow(problem, path, operators)[-1])
    tried = [judge.rate(PLAYS, *entry) for entry in path]
    while path[-1][0].count < _MOST:
        best = min(range(len(tried)), key=lambda k: tried[k].detail)
        if len(tried) - 1 - best >= _PATIENCE:
            break
        following = add_operator(problem, *path[-1])
        if following is None:
            break
        path = [*path, following]
        tried.append(judge.rate(PLAYS, *following))
    return _best(tried)
