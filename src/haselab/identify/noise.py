"""What residuals tell: goodness of fit, whiteness, and intervals that stay honest when coloured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import chdtrc

from haselab import _identify

__all__ = [
    "autoregression",
    "coloured_covariance",
    "fit_percent",
    "r_squared",
    "whiteness_p",
]

Floats = NDArray[np.float64]
_MAX_ORDER = 20
_SINGULAR = 1e-12


def fit_percent(measured: Sequence[Floats], modelled: Sequence[Floats]) -> float:
    r"""Normalised root-mean-square fit over all records, as `compare` of the field defines it.

    $100\,(1 - \lVert y - \hat y\rVert / \lVert y - \bar y\rVert)$, each record with its own mean

    Args:
        measured: outputs, one array a record. Shape `(M_r,)`.
        modelled: outputs of the model. Same shapes.
    Returns:
        100 for a perfect model, 0 for one no better than the mean, negative for worse.
    Source: goodnessOfFit of MATLAB's System Identification Toolbox, cost function NRMSE.
    Example:
        >>> fit_percent([np.array([0.0, 1.0, 2.0])], [np.array([0.0, 1.0, 2.0])])
        100.0
    """
    error = sum(float(((y - m) ** 2).sum()) for y, m in zip(measured, modelled, strict=True))
    spread = sum(float(((y - y.mean()) ** 2).sum()) for y in measured)
    return 100.0 * (1.0 - float(np.sqrt(error / spread))) if spread > 0.0 else float("nan")


def r_squared(measured: Floats, modelled: Floats) -> float:
    """Share of the variance that the model explains; 1 is all of it."""
    spread = float(((measured - measured.mean()) ** 2).sum())
    return 1.0 - float(((measured - modelled) ** 2).sum()) / spread if spread > 0.0 else 0.0


def _autocovariance(residuals: Sequence[Floats], lags: int) -> Floats:
    """Pooled autocovariance at lags 0 to `lags`, mean taken as zero."""
    return _identify.autocovariance([np.ascontiguousarray(e) for e in residuals], lags)


def whiteness_p(residuals: Sequence[Floats], lags: int = _MAX_ORDER) -> float:
    r"""Ljung-Box probability that residuals this coloured come from white noise.

    $Q = N(N + 2) \sum_k \hat\rho_k^2/(N - k)$, chi-square with as many degrees as lags

    Args:
        residuals: one array a record, in order of time. Shape `(M_r,)`.
        lags: number of lags; at most a fifth of the samples are used.
    Returns:
        Probability; below 0.05 the model leaves something unexplained.
    Source: Ljung and Box, Biometrika 65 (1978), 297.
    """
    count = sum(e.size for e in residuals)
    lags = max(1, min(lags, count // 5))
    covariance = _autocovariance(residuals, lags)
    if covariance[0] <= 0.0:
        return 1.0
    correlation = covariance[1:] / covariance[0]
    q = count * (count + 2) * float((correlation**2 / (count - np.arange(1, lags + 1))).sum())
    return float(chdtrc(lags, q))


def autoregression(residuals: Sequence[Floats]) -> tuple[Floats, float]:
    """Autoregressive noise model of the order that BIC chooses; order 0 is white noise.

    Args:
        residuals: one array a record. Shape `(M_r,)`.
    Returns:
        Polynomial `(1, a1, ..., ap)` and variance of its innovation.
    Source: Levinson's recursion on the pooled autocovariance; Schwarz, Ann. Stat. 6 (1978), 461.
    """
    count = sum(e.size for e in residuals)
    covariance = _autocovariance(residuals, max(0, min(_MAX_ORDER, count // 10)))
    return _identify.autoregression(covariance.tolist(), count)


def coloured_covariance(
    columns: Sequence[Floats], residuals: Sequence[Floats], parameters: int
) -> Floats:
    r"""Covariance of least-squares estimates when the noise may be coloured.

    $(Z'Z)^{-1} Z' \Sigma Z (Z'Z)^{-1}$, with the noise covariance $\Sigma$ of an autoregressive
    model of the residuals; white residuals give the classical formula.

    Args:
        columns: sensitivities of the output to the estimates, one array a record. `(M_r, P)`.
        residuals: one array a record. Shape `(M_r,)`.
        parameters: all fitted numbers, nuisances included.
    Returns:
        Covariance. Shape `(P, P)`; a variance is infinite where the data do not tell.
    Source: White, Econometrica 48 (1980), 817, with a parametric noise covariance.
    """
    count = sum(e.size for e in residuals)
    polynomial, variance = autoregression(residuals)
    variance *= count / max(count - parameters, 1)
    size = columns[0].shape[1]
    scale = np.sqrt(sum(((z**2).sum(axis=0) for z in columns), np.zeros(size)))
    if not (scale > 0.0).all():
        return np.full((size, size), np.inf)
    gram, middle = np.zeros((size, size)), np.zeros((size, size))
    for z in columns:
        z = z / scale
        gram += z.T @ z
        if polynomial.size == 1:
            filtered = z
        else:
            padded = np.vstack([z[::-1], np.zeros_like(z)])
            filtered = np.asarray(lfilter([1.0], polynomial, padded, axis=0))
        middle += filtered.T @ filtered
    inverse, blind = _inverse(gram)
    covariance = variance * inverse @ middle @ inverse / np.outer(scale, scale)
    covariance[blind, blind] = np.inf
    return np.asarray(covariance)


def _inverse(gram: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Inverse on the directions that the data tell; marks the estimates that have others."""
    values, vectors = np.linalg.eigh(gram)
    told = values > _SINGULAR * values[-1]
    inverse = (vectors[:, told] / values[told]) @ vectors[:, told].T
    return inverse, (np.abs(vectors[:, ~told]) > 1e-3).any(axis=1)
