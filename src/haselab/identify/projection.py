"""Separable least squares: linear parameters are solved, nonlinear ones searched."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Basis", "Solution", "minimise", "project"]

Floats = NDArray[np.float64]
_RIDGE = 1e-10
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Basis:
    """Functions of one record and their derivatives with respect to the searched parameters.

    Args:
        target: output that the functions have to explain. Shape `(M,)`.
        shared: functions whose factors are common to all records. Shape `(M, S)`.
        own: functions with a factor of this record alone. Shape `(M, Q)`.
        by_search: derivatives of `shared` and `own`, side by side. Shape `(L, M, S + Q)`.
        known: part of the output with known factors. Shape `(M,)`.
        known_by_search: derivatives of `known`. Shape `(L, M)`.
    """

    target: Floats
    shared: Floats
    own: Floats
    by_search: Floats
    known: Floats
    known_by_search: Floats


@dataclass(frozen=True)
class Solution:
    """Best factors for given searched parameters.

    Args:
        search: searched parameters. Shape `(L,)`.
        shared: common factors. Shape `(S,)`.
        own: factors of each record. Shape `(Q,)` each.
        residuals: target minus model, one array per record. Shape `(M_r,)`.
        columns: sensitivities to `search` and `shared`, orthogonal to `own`. Shape `(M_r, L + S)`.
        cost: sum of the squared residuals.
    """

    search: Floats
    shared: Floats
    own: tuple[Floats, ...]
    residuals: tuple[Floats, ...]
    columns: tuple[Floats, ...]
    cost: float


def _freed(own: Floats) -> tuple[Floats, Floats]:
    """Orthonormal basis of the columns and its triangle, regularised by a ridge of 1e-10."""
    scale = np.sqrt((own**2).sum(axis=0)).max(initial=0.0) or 1.0
    q, r = np.linalg.qr(np.vstack([own, _RIDGE * scale * np.eye(own.shape[1])]))
    return q[: own.shape[0]], r


def project(search: Floats, bases: Sequence[Basis]) -> Solution:
    """Linear least squares for the factors, and the sensitivities that remain.

    Source: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973), 413.
    """
    freed = [_freed(basis.own) for basis in bases]
    targets = [basis.target - basis.known for basis in bases]
    rest = [t - q @ (q.T @ t) for t, (q, _) in zip(targets, freed, strict=True)]
    shared = [b.shared - q @ (q.T @ b.shared) for b, (q, _) in zip(bases, freed, strict=True)]
    factors = _solve(np.vstack(shared), np.concatenate(rest))
    own, columns, residuals = [], [], []
    for basis, (q, r), target, reduced in zip(bases, freed, targets, shared, strict=True):
        gap = target - basis.shared @ factors
        mine = np.asarray(np.linalg.solve(r, q.T @ gap), dtype=np.float64)
        error = gap - basis.own @ mine
        slope = basis.by_search @ np.concatenate([factors, mine]) + basis.known_by_search
        columns.append(np.hstack([(slope - (slope @ q) @ q.T).T, reduced]))
        own.append(mine)
        residuals.append(error)
    cost = sum(float(e @ e) for e in residuals)
    return Solution(search, factors, tuple(own), tuple(residuals), tuple(columns), cost)


def _solve(matrix: Floats, target: Floats) -> Floats:
    """Least squares with scaled columns; a column of zeros gets the factor zero."""
    if matrix.shape[1] == 0:
        return np.zeros(0)
    scale = np.sqrt((matrix**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    scaled = matrix / scale
    q, r = np.linalg.qr(np.vstack([scaled, _RIDGE * np.eye(matrix.shape[1])]))
    return np.asarray(np.linalg.solve(r, q[: target.size].T @ target) / scale)


def _step(solution: Solution, damping: float) -> Floats:
    """Damped Gauss-Newton step of the searched parameters."""
    size = solution.search.size
    columns = np.vstack(solution.columns)
    slope, shared = columns[:, :size], columns[:, size:]
    if shared.shape[1]:
        q, _ = _freed(shared)
        slope = slope - q @ (q.T @ slope)
    gram = slope.T @ slope
    weight = np.diag(gram).copy()
    weight[weight == 0.0] = 1.0
    gradient = slope.T @ np.concatenate(solution.residuals)
    matrix = gram + np.diag(damping * weight + 1e-14 * weight.max(initial=0.0))
    return np.asarray(np.linalg.solve(matrix, gradient))


def minimise(
    evaluate: Callable[[Floats], Sequence[Basis]],
    start: Floats,
    bounds: tuple[Floats, Floats],
    iterations: int = 60,
    gain: float = 1e-10,
) -> tuple[Solution, bool]:
    """Levenberg-Marquardt search inside bounds, with the factors projected out.

    Args:
        evaluate: bases of all records at given searched parameters.
        start: first numbers. Shape `(L,)`.
        bounds: lowest and highest numbers. Shape `(L,)` each.
        iterations: most steps.
        gain: relative gain of a step below which the search stops.
    Returns:
        Best solution, and whether the search converged.
    Source: Kaufman, BIT 15 (1975), 49, for the projected Jacobian.
    """
    best = project(start, evaluate(start))
    if start.size == 0 or best.cost == 0.0:
        return best, True
    damping = 1e-3
    for _ in range(iterations):
        trial = np.clip(best.search + _step(best, damping), *bounds)
        moved = float(np.abs(trial - best.search).max())
        if moved <= _TOLERANCE:
            return best, True
        following = project(trial, evaluate(trial))
        if following.cost < best.cost:
            gained = (best.cost - following.cost) / best.cost
            best, damping = following, max(damping / 10.0, 1e-12)
            if gained < gain or best.cost == 0.0:
                return best, True
        else:
            if damping >= 1e8:
                return best, True
            damping *= 10.0
    return best, False
