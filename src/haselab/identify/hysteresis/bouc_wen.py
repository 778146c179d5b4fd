"""Bouc-Wen hysteresis from loops: sharpness, shape and exponent, searched from several starts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from haselab import _models
from haselab.identify.hysteresis.problem import (
    HysteresisProblem,
    Numbers,
    Scale,
    Shapes,
    Solved,
    zones_of,
)
from haselab.models.hysteresis.bouc_wen import BoucWen

__all__ = ["BoucWenFamily", "bouc_wen_model", "solve_bouc_wen"]

Floats = NDArray[np.float64]
_SHARPNESS = (0.3, 300.0)  # per half span of the input
_SIGMA = (0.5, 20.0)
_EXPONENT = (1.0, 10.0)
_STARTS = ((0.7, 2.0, 6.0, 20.0, 60.0), (0.6, 1.0, 3.0))
_POLISHED = 3
_DIFFERENCE = 1e-5


@dataclass(frozen=True)
class BoucWenFamily:
    """One memory state in [-1, 1]; log sharpness, sigma and optionally the exponent are searched.

    Args:
        free_exponent: whether the exponent is searched; otherwise it is 1.
    """

    free_exponent: bool = False

    @property
    def factors(self) -> int:
        """Number of memory states."""
        return 1

    def bounds(self) -> tuple[Floats, Floats]:
        """Lowest and highest searched parameters."""
        ranges = np.array([np.log(_SHARPNESS), _SIGMA, _EXPONENT])[: 2 + self.free_exponent]
        return ranges[:, 0], ranges[:, 1]

    def factor_bounds(self) -> tuple[Floats, Floats]:
        """The weight is unbounded."""
        return np.array([-np.inf]), np.array([np.inf])

    def _memory(self, search: Floats, problem: HysteresisProblem) -> Floats:
        exponent = float(search[2]) if self.free_exponent else 1.0
        memories = []
        for u in problem.inputs:
            w = np.empty_like(u)
            state = np.array([0.0, u[0]])
            sharpness, sigma = math.exp(search[0]), float(search[1])
            _models.run_bouc_wen(sharpness, sigma, exponent, state, u, w)
            memories.append(w)
        return problem.pick(memories)

    def shapes(self, search: Floats, problem: HysteresisProblem) -> Shapes:
        """The memory state and its numerical derivatives on the problem's rows."""
        here = self._memory(search, problem)
        slopes = np.empty((search.size, here.size, 1))
        for k in range(search.size):
            moved = search.copy()
            moved[k] += _DIFFERENCE
            slopes[k, :, 0] = (self._memory(moved, problem) - here) / _DIFFERENCE
        return Shapes(here[:, None], slopes)


def solve_bouc_wen(problem: HysteresisProblem, curve: Numbers, free_exponent: bool) -> Solved:
    """Best solution of several starts, ranked by the gain of each memory state over a curve.

    Args:
        problem: records and rows.
        curve: parameters of the curve alone, without memory.
        free_exponent: whether the exponent is searched.
    Returns:
        The best solution.
    """
    family = BoucWenFamily(free_exponent)
    outer = zones_of(curve.bends).slope_at(curve.offset + curve.gain * problem.u)
    inner = zones_of(curve.bends).invert(problem.y)
    linear = np.column_stack([np.ones_like(problem.u), problem.u])
    starts = []
    for sharpness, sigma in product(*_STARTS):
        search = np.array([math.log(sharpness), sigma, 1.2][: 2 + free_exponent])
        columns = np.column_stack([linear, family.shapes(search, problem).memories])
        found = np.linalg.lstsq(outer[:, None] * columns, outer * inner, rcond=None)[0]
        missed = outer * (inner - columns @ found)
        weight = np.asarray(found[2:], dtype=np.float64)
        numbers = Numbers(search, float(found[0]), abs(float(found[1])), weight, curve.bends)
        starts.append((float(missed @ missed), numbers))
    starts.sort(key=lambda entry: entry[0])
    tried = [problem.solve(family, numbers) for _, numbers in starts[:_POLISHED]]
    return min(tried, key=lambda solved: solved.cost)


def bouc_wen_model(numbers: Numbers, scale: Scale) -> BoucWen:
    """Convert the parameters to a model in physical units.

    Args:
        numbers: scaled parameters.
        scale: scaling of the problem.
    Returns:
        The model.
    """
    ratio = scale.half_y / scale.half_u
    return BoucWen(
        numbers.gain * ratio,
        float(numbers.factors[0]) * scale.half_y,
        math.exp(numbers.search[0]) / scale.half_u,
        float(numbers.search[1]),
        float(numbers.search[2]) if numbers.search.size > 2 else 1.0,
        scale.middle_y + scale.half_y * numbers.offset - ratio * numbers.gain * scale.middle_u,
        zones_of(numbers.bends, scale),
    )
