"""Choice between models of one record: BIC with the effective number of samples."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["APART", "bic", "effective_count", "is_decisive"]

Floats = NDArray[np.float64]
APART = 6.0  # of BIC: odds of 20 to 1


def effective_count(residuals: Sequence[Floats]) -> float:
    r"""Effective number of independent samples of coloured residuals.

    $N / (1 + 2 \sum_k \hat\rho_k)$, summed over the lags before the first one whose correlation
    is not positive: each swing of an unexplained part, noise or misfit, counts once.

    Args:
        residuals: one array per record. Shape `(M_r,)`.
    Returns:
        At most N, which is that of white residuals; at least 8.
    Source: Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8 (1946), 184; truncation by Geyer,
        Stat. Sci. 7 (1992), 473.
    """
    count = sum(e.size for e in residuals)
    longest = max(e.size for e in residuals)
    covariance = np.zeros(longest)
    for e in residuals:
        spectrum = np.fft.rfft(e, 2 * e.size)
        covariance[: e.size] += np.fft.irfft(np.abs(spectrum) ** 2)[: e.size]
    if covariance[0] <= 0.0:
        return float(count)
    correlation = covariance[1:] / covariance[0]
    stop = int(np.argmax(correlation <= 0.0)) if (correlation <= 0.0).any() else longest - 1
    worth = count / (1.0 + 2.0 * float(correlation[:stop].sum()))
    return min(max(worth, 8.0), float(count))


def bic(cost: float, count: int, effective: float, parameters: int, floor: float = 0.0) -> float:
    """Bayesian information criterion of a least-squares fit.

    Args:
        cost: sum of the squared residuals.
        count: number of residuals.
        effective: from `effective_count`, the same for all candidate models.
        parameters: fitted parameters.
        floor: mean square below which residuals are rounding errors.
    Returns:
        The criterion; only differences of it are meaningful.
    Source: Schwarz, Ann. Stat. 6 (1978), 461.
    """
    mean = max(cost / count, floor) or 1e-300
    return effective * math.log(mean) + parameters * math.log(effective)


def is_decisive(scores: Mapping[str, float]) -> bool:
    """Whether the best score leads the second by 6 or more; True for a single model."""
    ordered = sorted(scores.values())
    return len(ordered) < 2 or ordered[1] - ordered[0] >= APART
