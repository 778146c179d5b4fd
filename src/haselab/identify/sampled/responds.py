"""Whether an output depends on the input at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

__all__ = ["responds"]

Floats = NDArray[np.float64]
_SIGNIFICANT = 0.01  # probability without a response, above which no response is shown


def responds(coefficients: Floats, covariance: Floats, trials: int = 1) -> bool:
    r"""Whether the coefficients of the input are larger than noise explains (Wald test).

    $b' P^{-1} b$ is distributed as $\chi^2$ if there is no response. The probability is multiplied
    by the number of trials (Bonferroni).

    Args:
        coefficients: $b$, of the input. Shape `(B,)`.
        covariance: $P$, valid for the noise of the record. Shape `(B, B)`.
        trials: number of models from which the one with the largest coefficients was chosen.
    Returns:
        Whether coefficients of this size have a probability of at most 0.01 without a response;
        also true if a variance is infinite, because the fit reports this itself.
    Source: Wald, Transactions of the American Mathematical Society 54 (1943), 426.
    Example:
        >>> responds(np.array([0.5]), np.array([[0.01]]))
        True
    """
    if not np.isfinite(covariance).all():
        return True
    size = coefficients @ np.linalg.pinv(covariance, hermitian=True) @ coefficients
    rank = int(np.linalg.matrix_rank(covariance, hermitian=True))
    return bool(trials * chdtrc(rank, float(size)) <= _SIGNIFICANT)
