"""Noise of the lines of a response: independent, or correlated between neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import csr_array
from scipy.special import chdtr, chdtrc

from haselab.identify.noise import coloured_covariance

__all__ = ["IndependentLines", "LineNoise", "MixedLines"]

Floats = NDArray[np.float64]
_LAGS = 40
_RIDGE = 0.2


class LineNoise(Protocol):
    """Noise model of a weighted fit; rows are first all real, then all imaginary parts."""

    def whiten(self, values: Floats) -> Floats:
        """Weight the rows along the last axis. Shape `(..., 2K)`."""

    def covariance(self, columns: Floats, residuals: Floats) -> Floats:
        """Covariance of the parameters, from weighted sensitivities `(2K, P)` and misfits."""

    def chi_squared(self, columns: Floats, residuals: Floats) -> tuple[float, float]:
        """Ratio of the mean squared misfit to its expectation, and its probability."""


class IndependentLines:
    """Lines weighted by their std; correlation is estimated from the misfits along frequency.

    Args:
        std: standard deviation of the complex gains. Shape `(K,)`.
    """

    def __init__(self, std: Floats) -> None:
        self._weight = np.tile(math.sqrt(2.0) / std, 2)

    def whiten(self, values: Floats) -> Floats:
        """Weight the rows along the last axis."""
        return values * self._weight

    def covariance(self, columns: Floats, residuals: Floats) -> Floats:
        """Covariance by an autoregressive model of the misfits, separately for both parts."""
        halves = np.split(columns, 2)
        return coloured_covariance(halves, np.split(residuals, 2), columns.shape[1])

    def chi_squared(self, columns: Floats, residuals: Floats) -> tuple[float, float]:
        """Chi-square test with the effective number of correlated lines."""
        power, numbers = float(residuals @ residuals), columns.shape[1]
        shared = _shared(np.split(residuals, 2), power)
        degrees = max(residuals.size / shared - numbers, 1.0)
        return _two_sided(power / max(residuals.size - numbers, 1), degrees)


class MixedLines:
    """Lines whose errors are known linear combinations of independent variables.

    Weights are the inverse of the covariance with 20 % more on its diagonal: where the
    combinations are nearly alike, the exact inverse would amplify differences caused only by the
    small bias of the estimator. Intervals use the covariance itself.

    Args:
        mixing: errors are this matrix times variables of unit variance. Shape `(2K, M)`.
    """

    def __init__(self, mixing: csr_array) -> None:
        covariance = (mixing @ mixing.T).toarray()
        lifted = covariance + _RIDGE * np.diag(np.diag(covariance))
        self._root = cholesky(lifted, lower=True)
        half = solve_triangular(self._root, covariance, lower=True)
        self._left = np.asarray(solve_triangular(self._root, half.T, lower=True).T)

    def whiten(self, values: Floats) -> Floats:
        """Weight the rows along the last axis."""
        rows = values.reshape(-1, self._root.shape[0]).T
        return np.asarray(solve_triangular(self._root, rows, lower=True).T.reshape(values.shape))

    def covariance(self, columns: Floats, residuals: Floats) -> Floats:
        """Covariance of the parameters, scaled to the misfits."""
        size = np.sqrt((columns**2).sum(axis=0)) + 1e-300
        scaled = columns / size
        inverse = np.linalg.pinv(scaled.T @ scaled, hermitian=True)
        ratio, _ = self.chi_squared(columns, residuals)
        inner = inverse @ (scaled.T @ self._left @ scaled) @ inverse
        return np.asarray(ratio * inner / np.outer(size, size))

    def chi_squared(self, columns: Floats, residuals: Floats) -> tuple[float, float]:
        """Chi-square test against the expected misfits after the fit."""
        basis = np.linalg.qr(columns / (np.sqrt((columns**2).sum(axis=0)) + 1e-300))[0]
        freed = self._left - basis @ (basis.T @ self._left)
        freed = freed - (freed @ basis) @ basis.T
        expected = float(np.trace(freed))
        degrees = expected**2 / float((freed**2).sum())
        return _two_sided(float(residuals @ residuals) / expected, degrees)


def _shared(residuals: Sequence[Floats], power: float) -> float:
    """Number of rows per independent row."""
    shared = 1.0
    for lag in range(1, min(_LAGS, residuals[0].size // 4)):
        correlation = sum(float(e[lag:] @ e[:-lag]) for e in residuals) / max(power, 1e-300)
        if correlation < 0.0:
            break
        shared += 2.0 * correlation**2
    return shared


def _two_sided(ratio: float, degrees: float) -> tuple[float, float]:
    """The ratio with its two-sided probability under chi-square."""
    power = ratio * degrees
    return ratio, float(2.0 * min(chdtrc(degrees, power), chdtr(degrees, power), 0.5))
