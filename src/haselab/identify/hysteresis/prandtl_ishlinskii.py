"""Prandtl-Ishlinskii operators from loops: thresholds, weights and rate dependence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab._models import Plays
from haselab.identify.hysteresis.problem import (
    HysteresisProblem,
    Numbers,
    Scale,
    Shapes,
    Solved,
    zones_of,
)
from haselab.models.hysteresis.play import PrandtlIshlinskii

__all__ = ["PlayFamily", "add_operator", "evenly_spaced", "play_model", "simplified", "with_rate"]

Floats = NDArray[np.float64]
_GRID = 40
_WIDEST = 0.98  # of half the span: a wider play operator never moves
_NARROWEST = 1e-3
_APART = 0.01
_IDLE = 1e-3  # of the gain: a smaller weight has no effect
# Starting rate dependence: increase at the highest rate, relative to the middle threshold.
_FIRST_SHARES = (0.05, 0.4)


@dataclass(frozen=True)
class PlayFamily:
    """Play operators; their thresholds and, last, the rate dependence in s are searched.

    Args:
        count: number of operators.
        side: 1 where the output lags, -1 where it leads, 0 if not known yet.
        rated: whether the rate dependence is searched.
        filter_s: time constant of the rate's filter, in s.
    """

    count: int
    side: int = 0
    rated: bool = False
    filter_s: float = 0.0

    @property
    def factors(self) -> int:
        """Number of memory states."""
        return self.count

    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest thresholds in units of half the span, rate dependence in s."""
        low = np.full(self.count + self.rated, _NARROWEST)
        high = np.full(self.count + self.rated, _WIDEST)
        if self.rated:
            low[-1], high[-1] = 0.0, np.inf
        return low, high

    def factor_bounds(self) -> tuple[Floats, Floats]:
        """Weights have the sign of `side`: not below 0 if the output lags."""
        zero, free = np.zeros(self.count), np.full(self.count, np.inf)
        return (zero, free) if self.side >= 0 else (-free, zero)

    def shapes(self, search: Floats, problem: HysteresisProblem) -> Shapes:
        """Play operators and their derivatives on the problem's rows."""
        thresholds = np.ascontiguousarray(search[: self.count])
        rate_s = float(search[-1]) if self.rated else 0.0
        plays: list[Floats] = []
        sides: list[Floats] = []
        reaches: list[Floats] = []
        for u, rate_hz in zip(problem.inputs, problem.rates_hz, strict=True):
            pull = PrandtlIshlinskii(1.0, rate_filter_s=self.filter_s).pull(rate_hz)
            state = np.full(self.count + 2, u[0])
            state[-2] = 0.0
            tables = [np.empty((u.size, self.count)) for _ in range(3)]
            operators = Plays(thresholds, np.zeros(self.count), 0.0, rate_s, pull, rate_hz)
            operators.columns(state, u, *tables)
            for kept, table in zip((plays, sides, reaches), tables, strict=True):
                kept.append(table)
        slopes = np.zeros((search.size, problem.u.size, self.count))
        side = problem.pick(sides)
        for i in range(self.count):
            slopes[i, :, i] = side[:, i]
        if self.rated:
            slopes[-1] = problem.pick(reaches)
        return Shapes(problem.pick(plays), slopes)


def add_operator(
    problem: HysteresisProblem, family: PlayFamily, solved: Solved
) -> tuple[PlayFamily, Solved] | None:
    """Add one operator where the residuals need it most, and fit all parameters again.

    Args:
        problem: records and rows.
        family: operators so far.
        solved: their solution.
    Returns:
        The larger family with its solution; None if the residuals need no further operator.
    Source: score test of each threshold on a grid, orthogonal to all parameters found so far.
    """
    numbers = solved.numbers
    own = numbers.search[: family.count]
    grid = np.linspace(0.0, _WIDEST, _GRID + 1)[1:]
    grid = grid[(np.abs(grid[:, None] - own) > _APART).all(axis=1)]
    trial = PlayFamily(grid.size, 0, family.rated, family.filter_s)
    at = np.append(grid, numbers.search[-1:]) if family.rated else grid
    inner = problem.sum_of(numbers, family.shapes(numbers.search, problem))
    outer = zones_of(numbers.bends).slope_at(inner)[:, None]
    columns = outer * trial.shapes(at, problem).memories
    residuals, known = problem.linearised(family, numbers)
    known = known / np.maximum(np.sqrt((known**2).sum(axis=0)), 1e-300)
    inverse = np.linalg.pinv(known.T @ known, rcond=1e-10, hermitian=True)
    columns = columns - known @ (inverse @ (known.T @ columns))
    norm = np.sqrt((columns**2).sum(axis=0))
    score = columns.T @ residuals / np.where(norm > 1e-9, norm, np.inf)
    # One sign for all weights keeps the slopes after a reversal monotone.
    best = int(np.argmax(score * family.side if family.side else np.abs(score)))
    side = family.side or int(np.sign(score[best]))
    if score[best] * side <= 0.0:
        return None
    weight = score[best] / norm[best]
    larger = PlayFamily(family.count + 1, side, family.rated, family.filter_s)
    search = np.concatenate([own, [grid[best]], numbers.search[family.count :]])
    gain = max(numbers.gain - weight, 0.1 * numbers.gain)
    start = Numbers(search, numbers.offset, gain, np.append(numbers.factors, weight), numbers.bends)
    return larger, problem.solve(larger, start)


def evenly_spaced(
    problem: HysteresisProblem, curve: Numbers, side: int, count: int
) -> tuple[PlayFamily, Solved]:
    """Fit evenly spaced operators, and drop those without a weight.

    Args:
        problem: records and rows.
        curve: parameters of the curve alone.
        side: of the weights.
        count: initial number of operators.
    Returns:
        The family with its solution.
    """
    family = PlayFamily(count, side)
    search = _WIDEST * np.arange(1, count + 1) / (count + 1)
    weights = np.full(count, side * 0.3 * curve.gain / count)
    gain = curve.gain - 0.5 * float(weights.sum())
    numbers = problem.solve(
        family, Numbers(search, curve.offset, gain, weights, curve.bends)
    ).numbers
    used = np.abs(numbers.factors) > _IDLE * numbers.gain
    fewer = PlayFamily(int(used.sum()), side)
    start = Numbers(
        numbers.search[used], numbers.offset, numbers.gain, numbers.factors[used], numbers.bends
    )
    return fewer, problem.solve(fewer, start)


def with_rate(
    problem: HysteresisProblem, family: PlayFamily, solved: Solved, filter_s: float
) -> tuple[PlayFamily, Solved]:
    """Fit the same operators with thresholds that increase with the rate.

    Args:
        problem: records and rows.
        family: rate-independent operators.
        solved: their solution.
        filter_s: time constant of the rate's filter, in s.
    Returns:
        The family with its rate dependence searched, and its best solution of two starts.
    """
    rated = PlayFamily(family.count, family.side, True, filter_s)
    highest = max(
        float(np.abs(np.diff(u)).mean()) * rate_hz
        for u, rate_hz in zip(problem.inputs, problem.rates_hz, strict=True)
    )
    own = solved.numbers
    typical = float(np.median(own.search))
    tried = []
    for share in _FIRST_SHARES:
        search = np.append((1.0 - 0.5 * share) * own.search, share * typical / highest)
        start = Numbers(search, own.offset, own.gain, own.factors, own.bends)
        tried.append(problem.solve(rated, start))
    return rated, min(tried, key=lambda entry: entry.cost)


def simplified(family: PlayFamily, numbers: Numbers) -> tuple[PlayFamily, Numbers]:
    """Merge operators with equal thresholds, and turn the narrowest one into a gain.

    Args:
        family: the operators.
        numbers: their parameters.
    Returns:
        The family with its numbers, with distinct, ascending thresholds.
    """
    gain, thresholds, weights = numbers.gain, [0.0], [0.0]
    for k in np.argsort(numbers.search[: family.count]):
        threshold, weight = float(numbers.search[k]), float(numbers.factors[k])
        if threshold < thresholds[-1] + 2.0 * _NARROWEST:
            weights[-1] += weight
        else:
            thresholds.append(threshold)
            weights.append(weight)
    gain += weights[0]
    fewer = replace(family, count=len(thresholds) - 1)
    search = np.concatenate([thresholds[1:], numbers.search[family.count :]])
    return fewer, Numbers(search, numbers.offset, gain, np.array(weights[1:]), numbers.bends)


def play_model(family: PlayFamily, numbers: Numbers, scale: Scale) -> PrandtlIshlinskii:
    """Convert the parameters to a model in physical units.

    Args:
        family: the operators.
        numbers: scaled parameters.
        scale: scaling of the problem.
    Returns:
        Model with ascending thresholds, see `simplified`.
    """
    family, numbers = simplified(family, numbers)
    ratio = scale.half_y / scale.half_u
    moved = numbers.gain + float(numbers.factors.sum())
    return PrandtlIshlinskii(
        numbers.gain * ratio,
        tuple((numbers.search[: family.count] * scale.half_u).tolist()),
        tuple((numbers.factors * ratio).tolist()),
        scale.middle_y + scale.half_y * numbers.offset - ratio * moved * scale.middle_u,
        float(numbers.search[-1]) if family.rated else 0.0,
        family.filter_s if family.rated else 0.0,
        zones_of(numbers.bends, scale),
    )
