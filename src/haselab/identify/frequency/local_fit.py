"""Rational least squares of many short windows of a spectrum at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["LocalProblem", "Solved", "solve", "start_denominators", "tune_denominators"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_LINEAR_STEPS = 3
_STEPS = 12
_REST = 1e-9
_FLOOR = 1e-2
_SINGULAR = 1e-12


@dataclass(frozen=True)
class LocalProblem:
    """Least squares of `y = linear @ factors / (1 + slopes @ d)` in each of K windows.

    Args:
        linear: columns of numerator and leakage; the first is the requested one. `(K, R, P)`.
        slopes: factors of the two coefficients `d` of the denominator. Shape `(K, R, 2)`.
        y: spectrum of the output. Shape `(K, R)`.
    """

    linear: Complexes
    slopes: Complexes
    y: Complexes

    def at(self, which: NDArray[Any]) -> LocalProblem:
        """The problem restricted to some windows."""
        return LocalProblem(self.linear[which], self.slopes[which], self.y[which])

    def bottom(self, d: Complexes) -> Complexes:
        """Denominators on all rows, with a contrast of at most 1e12. Shape `(K, R, 1)`."""
        bottom = 1.0 + self.slopes @ d[:, :, None]
        least = _SINGULAR * np.abs(bottom).max(axis=1, keepdims=True)
        return np.asarray(np.where(np.abs(bottom) < least, least, bottom))


@dataclass(frozen=True)
class Solved:
    """Best factors of each window at known denominators.

    Args:
        first: first factor. Shape `(K,)`.
        by_row: its derivatives with respect to the outputs. Shape `(K, R)`.
        by_d: its derivatives with respect to the denominator. Shape `(K, 2)`.
        slopes: derivatives of the fitted outputs with respect to the denominator, with the other
            factors solved for. Shape `(K, R, 2)`.
        cost: sum of the squared misfits. Shape `(K,)`.
    """

    first: Complexes
    by_row: Complexes
    by_d: Complexes
    slopes: Complexes
    cost: Floats


def solve(problem: LocalProblem, d: Complexes) -> Solved:
    """Linear least squares at denominators `d`, Shape `(K, 2)`."""
    bottom = problem.bottom(d)
    q, inverse, size = _orthogonal(problem.linear / bottom)
    dual = q.conj().transpose(0, 2, 1)
    along = dual @ problem.y[:, :, None]
    fitted = q @ along
    slopes = -problem.slopes * fitted / bottom
    top = inverse[:, :1] / size[:, :, :1]
    shared = dual @ slopes
    return Solved(
        (top @ along)[:, 0, 0],
        (top @ dual)[:, 0],
        -(top @ shared)[:, 0],
        slopes - q @ shared,
        (np.abs(problem.y - fitted[:, :, 0]) ** 2).sum(axis=1),
    )


def _orthogonal(matrix: Complexes) -> tuple[Complexes, Complexes, Floats]:
    """Orthonormal basis of scaled columns, inverse of the triangle, and the scales `(K, 1, P)`."""
    size = np.sqrt((np.abs(matrix) ** 2).sum(axis=1, keepdims=True)) + 1e-300
    q, triangle = np.linalg.qr(matrix / size)
    diagonal = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
    triangle[(diagonal < _SINGULAR).any(axis=1)] += _SINGULAR * np.eye(matrix.shape[2])
    return q, np.linalg.inv(triangle), size


def start_denominators(problem: LocalProblem) -> Complexes:
    """Initial denominators by iteratively weighted linear least squares.

    Source: Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963), 56.
    """
    weight = np.ones((*problem.y.shape, 1))
    d = np.zeros((problem.y.shape[0], 2), dtype=np.complex128)
    for _ in range(_LINEAR_STEPS):
        wide = np.concatenate([problem.linear, -problem.slopes * problem.y[:, :, None]], axis=2)
        q, inverse, size = _orthogonal(wide * weight)
        along = q.conj().transpose(0, 2, 1) @ (problem.y[:, :, None] * weight)
        d = ((inverse @ along)[:, :, 0] / size[:, 0])[:, -2:]
        bottom = np.abs(problem.bottom(d))
        weight = 1.0 / np.maximum(bottom, _FLOOR * bottom.max(axis=1, keepdims=True))
    return d


@dataclass
class _Projected:
    """Misfits with the factors solved for, and their derivatives by the denominators."""

    misfit: Complexes
    slopes: Complexes
    cost: Floats

    def keep(self, which: NDArray[np.bool_]) -> _Projected:
        return _Projected(self.misfit[which], self.slopes[which], self.cost[which])

    def take(self, which: NDArray[np.bool_], other: _Projected) -> None:
        self.misfit[which] = other.misfit[which]
        self.slopes[which] = other.slopes[which]
        self.cost[which] = other.cost[which]


def _projected(problem: LocalProblem, d: Complexes) -> _Projected:
    bottom = problem.bottom(d)
    q, _, _ = _orthogonal(problem.linear / bottom)
    dual = q.conj().transpose(0, 2, 1)
    fitted = q @ (dual @ problem.y[:, :, None])
    slopes = -problem.slopes * fitted / bottom
    slopes = slopes - q @ (dual @ slopes)
    misfit = problem.y - fitted[:, :, 0]
    return _Projected(misfit, slopes, (np.abs(misfit) ** 2).sum(axis=1))


def _step(now: _Projected, damping: Floats) -> Complexes:
    """Damped Gauss-Newton steps of the denominators."""
    dual = now.slopes.conj().transpose(0, 2, 1)
    gram = dual @ now.slopes
    weight = np.einsum("kii->ki", gram).real
    lift = damping[:, None] * weight + 1e-12 * weight.max(axis=1, keepdims=True) + 1e-300
    step = np.linalg.solve(gram + lift[:, :, None] * np.eye(2), dual @ now.misfit[:, :, None])
    return np.asarray(step[:, :, 0])


def tune_denominators(problem: LocalProblem, d: Complexes) -> Complexes:
    """Denominators of least output misfit from a starting value, for all windows at once.

    Source: Levenberg-Marquardt on the projected misfit, Kaufman, BIT 15 (1975), 49.
    """
    d = d.copy()
    damping = np.full(d.shape[0], 1e-3)
    at, now = np.arange(d.shape[0]), _projected(problem, d)
    for _ in range(_STEPS):
        step = _step(now, damping[at])
        trial = _projected(problem.at(at), d[at] + step)
        better = trial.cost < now.cost
        gained = now.cost - trial.cost > _REST * now.cost
        d[at[better]] += step[better]
        damping[at] *= np.where(better, 0.1, 10.0)
        now.take(better, trial)
        going = (~better | gained) & (damping[at] < 1e6)
        if not going.any():
            break
        at, now = at[going], now.keep(going)
    return d
