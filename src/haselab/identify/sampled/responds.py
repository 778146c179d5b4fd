"""Whether an output depends on the input at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

__all__ = ["responds"]

Floats = NDArray[np.float64]
_CHANCE = 0.01  # probability above which coefficients may be those of noise


def responds(coefficients: Floats, covariance: Floats, trials: int = 1) -> bool:
    """Whether coefficients of the input are larger than noise explains.

    Args:
        coefficients: of the input. Shape `(B,)`.
        covariance: of them, valid for the noise of the record. Shape `(B, B)`.
        trials: models of which the one with the largest coefficients was chosen.
    Returns:
        Whether the probability of such coefficients without a response is at most 0.01.
    Source: Wald, Transactions of the American Mathematical Society 54 (1943), 426.
    Example:
        >>> responds(np.array([0.5]), np.array([[0.01]]))
        True
    """
    if not np.isfinite(covariance).all():
        return True  # a coefficient is not identifiable, which the fit reports
    size = coefficients @ np.linalg.pinv(covariance, hermitian=True) @ coefficients
    return bool(trials * chdtrc(coefficients.size, float(size)) <= _CHANCE)
