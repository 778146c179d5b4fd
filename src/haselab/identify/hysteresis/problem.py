"""Least squares common to the hysteresis models: a sum of memory states followed by dead zones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from haselab.identify.hysteresis.loops import LoopRecord
from haselab.models.hysteresis.common import DeadZones

__all__ = [
    "LEAST_GAIN",
    "Family",
    "HysteresisProblem",
    "Numbers",
    "Scale",
    "Shapes",
    "Solved",
    "zones_of",
]

Floats = NDArray[np.float64]
LEAST_GAIN = 0.01  # of the loop's mean slope: a model without a gain has no inverse
_STEEPEST = 50.0
_FLATTEST = 0.02
_STUCK = 1e6


@dataclass(frozen=True)
class Shapes:
    """Memory states for given searched parameters, on the rows of a problem.

    Args:
        memories: memory states, multiplied by the linear factors. Shape `(N, C)`.
        slopes: derivatives of `memories` with respect to the searched parameters.
            Shape `(L, N, C)`.
    """

    memories: Floats
    slopes: Floats


class Family(Protocol):
    """Memory model of a hysteresis model, with its searched parameters."""

    @property
    def factors(self) -> int:
        """Number of memory states."""

    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest searched parameters. Shape `(L,)` each."""

    def factor_bounds(self) -> tuple[Floats, Floats]:
        """Bounds of the factors of the memory states. Shape `(C,)` each."""

    def shapes(self, search: Floats, problem: HysteresisProblem) -> Shapes:
        """Memory states and their derivatives on the problem's rows."""


@dataclass(frozen=True)
class Numbers:
    """All parameters of a model, scaled as in the problem.

    Args:
        search: searched parameters of the family. Shape `(L,)`.
        offset: of the sum.
        gain: of the input.
        factors: of the memory states. Shape `(C,)`.
        bends: inverse slopes of the segments of the dead zones, see `zones_of`. Shape `(M,)`.
    """

    search: Floats
    offset: float
    gain: float
    factors: Floats
    bends: Floats

    @property
    def vector(self) -> Floats:
        """All parameters as one vector."""
        return np.concatenate([self.search, [self.offset, self.gain], self.factors, self.bends])

    def like(self, vector: Floats) -> Numbers:
        """Parameters of the same structure from a vector."""
        at = self.search.size
        factors = vector[at + 2 : at + 2 + self.factors.size]
        rest = vector[at + 2 + self.factors.size :]
        return Numbers(vector[:at], float(vector[at]), float(vector[at + 1]), factors, rest)


@dataclass(frozen=True)
class Solved:
    """A least-squares solution.

    Args:
        numbers: where the search converged.
        cost: sum of the squared residuals on the problem's rows.
    """

    numbers: Numbers
    cost: float


@dataclass(frozen=True)
class Scale:
    """Scaling of a problem: `u = middle_u + half_u u'`, `y = middle_y + half_y y'`.

    `half_y` is negative where the output falls as the input rises.
    """

    middle_u: float
    half_u: float
    middle_y: float
    half_y: float

    @classmethod
    def of(cls, records: Sequence[LoopRecord]) -> Scale:
        """Scaling to settled inputs and outputs that span -1 to 1 and rise together."""
        masks = [record.settled() for record in records]
        u = np.concatenate([record.u[mask] for record, mask in zip(records, masks, strict=True)])
        y = np.concatenate([record.y[mask] for record, mask in zip(records, masks, strict=True)])
        sign = 1.0 if float(np.cov(u, y)[0, 1]) >= 0.0 else -1.0
        half_u, half_y = 0.5 * float(np.ptp(u)), 0.5 * float(np.ptp(y))
        return cls(float(u.min()) + half_u, half_u, float(y.min()) + half_y, sign * half_y)


def _corners(count: int) -> Floats:
    """Outputs at which the dead zones begin: evenly spaced between -1 and 1. Shape `(M,)`."""
    return np.linspace(-1.0, 1.0, count + 2)[1:-1]


def _overlaps(y: Floats, count: int) -> tuple[Floats, Floats]:
    """Overlap of the path from 0 to each output with the middle segment and with the others.

    Shapes `(N,)`, `(N, M)`.
    """
    corners, half = _corners(count), count // 2
    if count == 0:
        return y, np.zeros((y.size, 0))
    edges = np.concatenate([[-np.inf], corners, [np.inf]])
    others = np.delete(np.arange(count + 1), half)
    inner = np.where(others < half, edges[others + 1], edges[others])
    parts = np.clip(y[:, None], edges[others], edges[others + 1]) - inner
    return np.clip(y, corners[half - 1], corners[half]), parts


def zones_of(bends: Floats, scale: Scale | None = None) -> DeadZones:
    """Dead zones whose segments are evenly spaced in the output, so that each has samples.

    Args:
        bends: inverse slopes of all segments except the middle one, which is 1; lowest first, as
            many below as above it. Shape `(M,)`.
        scale: target scaling, if any.
    Returns:
        Dead zones.
    """
    half = bends.size // 2
    upper = np.diff(np.concatenate([[1.0], 1.0 / bends[half:]]))
    lower = np.diff(np.concatenate([[1.0], 1.0 / bends[:half][::-1]]))[::-1]
    weights = np.concatenate([lower, upper])
    middle, parts = _overlaps(_corners(bends.size), bends.size)
    thresholds = middle + parts @ bends
    if scale is None:
        return DeadZones(tuple(thresholds.tolist()), tuple(weights.tolist()))
    thresholds = scale.middle_y + scale.half_y * thresholds
    order = slice(None) if scale.half_y > 0.0 else slice(None, None, -1)
    return DeadZones(
        tuple(thresholds[order].tolist()), tuple(weights[order].tolist()), scale.middle_y
    )


class HysteresisProblem:
    """Scaled records and the rows that count.

    Args:
        records: loops.
        scale: scaling.
        kept: rows that count, one mask a record.
        most: largest number of rows; more are thinned evenly.
    """

    def __init__(
        self,
        records: Sequence[LoopRecord],
        scale: Scale,
        kept: Sequence[NDArray[np.bool_]],
        most: int | None = None,
    ) -> None:
        self.scale = scale
        self.rates_hz = [record.rate_hz for record in records]
        self.inputs = [(r.u - scale.middle_u) / scale.half_u for r in records]
        step = 1 if most is None else max(1, math.ceil(sum(k.sum() for k in kept) / most))
        self.rows = [np.flatnonzero(mask)[::step] for mask in kept]
        self.u = self.pick(self.inputs)
        self.y = np.concatenate(
            [(r.y[rows] - scale.middle_y) / scale.half_y
             for r, rows in zip(records, self.rows, strict=True)]
        )  # fmt: skip
        self.ends = np.cumsum([rows.size for rows in self.rows])[:-1]

    def pick(self, columns: Sequence[Floats]) -> Floats:
        """Select the rows that count from one array per record."""
        return np.concatenate(
            [column[rows] for column, rows in zip(columns, self.rows, strict=True)]
        )

    def sum_of(self, numbers: Numbers, shapes: Shapes) -> Floats:
        """Input of the dead zones. Shape `(N,)`."""
        inner = numbers.offset + numbers.gain * self.u + shapes.memories @ numbers.factors
        return np.asarray(inner)

    def residuals(self, family: Family, numbers: Numbers) -> Floats:
        """Measured minus modelled. Shape `(N,)`."""
        return self.linearised(family, numbers)[0]

    def linearised(self, family: Family, numbers: Numbers) -> tuple[Floats, Floats]:
        """Residuals, and derivatives of the modelled output with respect to `numbers.vector`.

        Shapes `(N,)`, `(N, P)`.
        """
        shapes = family.shapes(numbers.search, self)
        inner, zones = self.sum_of(numbers, shapes), zones_of(numbers.bends)
        modelled = zones.apply(inner)
        outer = zones.slope_at(inner)[:, None]
        by_search = (shapes.slopes @ numbers.factors).T
        linear = np.column_stack([np.ones_like(self.u), self.u, shapes.memories])
        own = _overlaps(modelled, numbers.bends.size)[1]
        return self.y - modelled, np.hstack([outer * by_search, outer * linear, -outer * own])

    def solve(self, family: Family, start: Numbers, steps: int = 20, gain: float = 1e-5) -> Solved:
        """Bounded least squares from a start.

        Args:
            family: memory model.
            start: starting parameters; moved inside the bounds.
            steps: largest number of evaluations.
            gain: relative gain of a step below which the search stops.
        Returns:
            Where it converged.
        """
        bounds = _bounds(family, start)
        best = start.like(np.clip(start.vector, *bounds))
        residuals, columns = self.linearised(family, best)
        cost, damping = float(residuals @ residuals), 1e-3
        for _ in range(steps):
            step = _damped_step(best.vector, residuals, columns, bounds, damping)
            trial = best.like(np.clip(best.vector + step, *bounds))
            missed, slopes = self.linearised(family, trial)
            following = float(missed @ missed)
            if not following < cost:
                damping *= 10.0
                if damping > _STUCK:
                    break
                continue
            gained = (cost - following) / cost
            best, residuals, columns, cost = trial, missed, slopes, following
            damping = max(0.1 * damping, 1e-9)
            if gained < gain:
                break
        return Solved(best, cost)


def _bounds(family: Family, start: Numbers) -> tuple[Floats, Floats]:
    """Bounds of the parameters, in the order of `Numbers.vector`."""
    low, high = family.bounds()
    least, most = family.factor_bounds()
    bends = np.ones(start.bends.size)
    lower = np.concatenate([low, [-np.inf, LEAST_GAIN], least, bends / _STEEPEST])
    upper = np.concatenate([high, [np.inf, np.inf], most, bends / _FLATTEST])
    return lower, upper


def _damped_step(
    at: Floats, residuals: Floats, columns: Floats, bounds: tuple[Floats, Floats], damping: float
) -> Floats:
    """Levenberg-Marquardt step of the parameters that are not at a bound."""
    gradient = columns.T @ residuals
    stopped = ((at <= bounds[0]) & (gradient < 0.0)) | ((at >= bounds[1]) & (gradient > 0.0))
    free = np.flatnonzero(~stopped)
    gram = columns[:, free].T @ columns[:, free]
    weight = np.diag(gram) + 1e-14 * float(np.diag(gram).max(initial=0.0)) + 1e-300
    step = np.zeros(at.size)
    step[free] = np.linalg.solve(gram + np.diag(damping * weight), gradient[free])
    return step
