"""Rival models of one record: BIC with the number of samples that coloured residuals are worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.identify.noise import autoregression

__all__ = ["APART", "bic", "effective_count", "told_apart"]

Floats = NDArray[np.float64]
APART = 6.0  # of BIC: odds of 20 to 1


def effective_count(residuals: Sequence[Floats]) -> float:
    r"""How many independent samples residuals this coloured are worth for a slow model.

    $N\,\gamma_0 / S(0)$ with the autoregressive model of the residuals: the variance of a sample
    against the noise density at low frequency; never above N.

    Args:
        residuals: one array a record. Shape `(M_r,)`.
    Returns:
        Between 8 and N; N for white residuals.
    Source: Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8 (1946), 184.
    """
    count = sum(e.size for e in residuals)
    power = sum(float(e @ e) for e in residuals) / count
    polynomial, variance = autoregression(residuals)
    if power <= 0.0 or variance <= 0.0:
        return float(count)
    worth = count * power * float(polynomial.sum()) ** 2 / variance
    return min(max(worth, 8.0), float(count))


def bic(cost: float, count: int, effective: float, parameters: int, floor: float = 0.0) -> float:
    """Bayesian information criterion of a least-squares fit.

    Args:
        cost: sum of the squared residuals.
        count: number of residuals.
        effective: from `effective_count`, the same for all rivals.
        parameters: fitted numbers.
        floor: mean square below which residuals are rounding.
    Returns:
        The criterion; differences of it matter.
    Source: Schwarz, Ann. Stat. 6 (1978), 461.
    """
    mean = max(cost / count, floor) or 1e-300
    return effective * math.log(mean) + parameters * math.log(effective)


def told_apart(scores: Mapping[str, float]) -> bool:
    """Whether the best score leads the second by 6 or more; one model alone is always told."""
    ordered = sorted(scores.values())
    return len(ordered) < 2 or ordered[1] - ordered[0] >= APART
