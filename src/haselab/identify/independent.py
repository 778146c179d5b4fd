"""How many independent samples coloured residuals are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.identify.noise import autoregression

__all__ = ["independent_share"]


def independent_share(residuals: NDArray[np.float64], least: float = 8.0) -> float:
    r"""Share of the samples that would spread a mean as much if they were independent.

    $\sigma^2 / S(0)$, variance over spectral density at zero frequency of the autoregressive model

    Args:
        residuals: in order of time. Shape `(N,)`.
        least: fewest samples that are left.
    Returns:
        Share in (0, 1]; 1 for white residuals.
    Source: Bayley and Hammersley, J. R. Stat. Soc. Suppl. 8 (1946), 184.
    Example:
        >>> independent_share(np.random.default_rng(1).normal(size=500))
        1.0
    """
    polynomial, innovation = autoregression([residuals])
    variance = float(residuals @ residuals) / residuals.size
    if polynomial.size == 1 or not innovation > 0.0 or not variance > 0.0:
        return 1.0
    share = variance * float(polynomial.sum()) ** 2 / innovation
    return min(1.0, max(share, least / residuals.size))
