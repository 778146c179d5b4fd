"""Effective number of independent samples of coloured residuals, and intervals based on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from haselab.base import Estimate
from haselab.identify.noise import autoregression, coloured_covariance

__all__ = ["independent_share", "spread_of", "student_estimate"]

Floats = NDArray[np.float64]
_LEAST = 8.0  # smallest effective number of samples


def independent_share(residuals: Sequence[Floats]) -> float:
    r"""Effective share of independent samples: the same variance of the mean as the residuals.

    $\sigma^2 / S(0)$, variance over spectral density at zero frequency of the autoregressive model

    Args:
        residuals: one array per record, in order of time or of the abscissa. Shape `(M_r,)`.
    Returns:
        Share in (0, 1]; 1 for white residuals.
    Source: Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8 (1946), 184.
    Example:
        >>> independent_share([np.random.default_rng(1).normal(size=500)])
        1.0
    """
    polynomial, innovation = autoregression(residuals)
    count = sum(e.size for e in residuals)
    variance = sum(float(e @ e) for e in residuals) / count
    if polynomial.size == 1 or not innovation > 0.0 or not variance > 0.0:
        return 1.0
    share = variance * float(polynomial.sum()) ** 2 / innovation
    return min(1.0, max(share, _LEAST / count))


def spread_of(
    columns: Sequence[Floats], residuals: Sequence[Floats], parameters: int
) -> tuple[Floats, float]:
    """Covariance for coloured noise whose variance is estimated from few independent samples.

    Args:
        columns: sensitivities of the output to the estimates, one array per record. `(M_r, P)`.
        residuals: one array per record. Shape `(M_r,)`.
        parameters: all fitted parameters, nuisances included.
    Returns:
        Covariance `(P, P)`, and Student's quantile for 95 %.
    Source: `coloured_covariance`; degrees of freedom after Bayley and Hammersley (1946).
    """
    count = sum(e.size for e in residuals)
    worth = independent_share(residuals) * count
    freedom = max(worth - parameters, 1.0)
    # The covariance uses the degrees of freedom of all samples; the independent ones have fewer.
    factor = worth / freedom * max(count - parameters, 1) / count
    covariance = coloured_covariance(columns, residuals, parameters) * factor
    return np.asarray(covariance), float(stdtrit(freedom, 0.975))


def student_estimate(value: float, std: float, quantile: float, unit: str) -> Estimate:
    """Estimate whose interval uses a quantile of Student's distribution."""
    half = quantile * float(std)
    return Estimate(float(value), float(std), (float(value) - half, float(value) + half), unit)
