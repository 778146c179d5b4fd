"""A quadratic program with box constraints, as small as those of a predictive controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["BoxSolution", "solve_box"]

Floats = NDArray[np.float64]
_LEAST_DECREASE = 1e-4  # of the one that the slope promises (Armijo)
_SHORTEST = 1e-12


@dataclass(frozen=True)
class BoxSolution:
    """The minimum, and how it was found.

    Args:
        x: within the box. Shape `(n,)`.
        converged: whether the optimality conditions are met; False: `x` is only within the box.
        iterations: Newton steps.
    """

    x: Floats
    converged: bool
    iterations: int


def solve_box(
    hessian: Floats, slope: Floats, low: Floats, high: Floats, start: Floats,
    most: int = 60,
) -> BoxSolution:  # fmt: skip
    r"""Minimise a convex quadratic function in a box by projected Newton steps.

    $\min_x\ \tfrac12 x^T H x + g^T x,\quad l \le x \le h$

    A variable at an end of the box stays there while the gradient pushes it outwards. The others
    take a Newton step, which is projected onto the box and shortened until the function decreases.

    Args:
        hessian: symmetric and positive definite. Shape `(n, n)`.
        slope: gradient at 0. Shape `(n,)`.
        low: lower ends. Shape `(n,)`.
        high: upper ends, not below them. Shape `(n,)`.
        start: first guess; it is moved into the box. Shape `(n,)`.
        most: highest number of Newton steps.
    Returns:
        The solution.
    Source: D. P. Bertsekas, SIAM J. Control Optim. 20 (1982), 221.
    Example:
        >>> low, high = np.zeros(2), np.ones(2)
        >>> found = solve_box(np.eye(2), np.array([-3.0, 0.5]), low, high, low)
        >>> found.x.tolist(), found.converged
        ([1.0, 0.0], True)
    """
    x = np.minimum(np.maximum(start, low), high)
    scale = 1e-9 * (np.abs(slope).max() + np.abs(hessian).max() * np.abs(x).max()) + 1e-300
    for count in range(most):
        gradient = hessian @ x + slope
        held = ((x <= low) & (gradient > 0.0)) | ((x >= high) & (gradient < 0.0))
        free = np.flatnonzero(~held)
        if not free.size or np.abs(gradient[free]).max() <= scale:
            return BoxSolution(x, True, count)
        way = np.zeros(x.size)
        way[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        share = 1.0
        while True:
            after = np.minimum(np.maximum(x + share * way, low), high)
            moved = after - x
            change = float(gradient @ moved + 0.5 * moved @ (hessian @ moved))
            if change <= _LEAST_DECREASE * float(gradient @ moved) or share < _SHORTEST:
                break
            share *= 0.5
        if not moved.any():
            return BoxSolution(x, True, count)  # to the last bit
        x = after
    return BoxSolution(x, False, most)
