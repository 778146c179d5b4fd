r"""How far a model error may have moved the parameters.

What a law lacks is a signal $e$, in units of the standard deviations. The part of it that no
parameter can imitate appears in the residuals; its energy is $E = r^\top r - N\sigma^2$. The
other part is hidden and moves the parameters. If it has the energy $E$ as well, it moves a
parameter by at most

$\sqrt{E\,(J^\top J)^{-1}_{kk}}$

This counts as one standard deviation: at 1.96 standard deviations, the hidden energy would be
almost four times the visible one.

A prediction depends on many directions. For it, the hidden part has no particular one of the $P$
directions, which gives the parameters the further covariance

$(E/P)\,(J^\top J)^{-1}$
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.identify.physical.information import covariance_of

__all__ = ["excess_energy", "hidden_std", "widen_std"]

Floats = NDArray[np.float64]
_SINGULAR = 1e-12


def hidden_std(jacobian: Floats, excess: float, prior: Floats | None = None) -> Floats:
    """Standard deviation of what varies, if a fit hides as much of a model error as it shows.

    Args:
        jacobian: of the model over the standard deviations. Shape `(N, P)`.
        excess: sum of the squares of the residuals, without that of their noise.
        prior: information on what varies before the records. Positive, shape `(P,)`; None: none.
    Returns:
        Standard deviations. Shape `(P,)`; without a prior, infinite for what has no
            effect on the records.
    Example:
        >>> hidden_std(np.ones((100, 1)), 25.0).round(6).tolist()
        [0.5]
    """
    if prior is not None:
        factors = [jacobian, np.diag(np.sqrt(prior))]
        return np.asarray(np.sqrt(max(excess, 0.0) * np.diag(covariance_of(factors))))
    scale = np.linalg.norm(jacobian, axis=0)
    acts = scale > 0.0
    columns = jacobian[:, acts] / scale[acts]
    inverse = np.linalg.pinv(columns.T @ columns, rcond=_SINGULAR, hermitian=True)
    std = np.full(scale.size, np.inf)
    std[acts] = np.sqrt(max(excess, 0.0) * np.diag(inverse)) / scale[acts]
    return std


def widen_std(covariance: Floats, std: Floats) -> Floats:
    """Raise standard deviations to at least other ones.

    Args:
        covariance: Shape `(P, P)`.
        std: smallest standard deviations. Shape `(P,)`.
    Returns:
        Covariance with the same correlations. Shape `(P, P)`.
    """
    own = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        factor = np.where(np.isfinite(own) & (std > own), std / own, 1.0)
    return np.asarray(covariance * np.outer(factor, factor))


def excess_energy(channels: Sequence[tuple[Sequence[Floats], float]]) -> float:
    """Sum of squares of residuals beyond their noise.

    Args:
        channels: residuals of each, experiment by experiment, and the rms of their noise.
    """
    found = 0.0
    for parts, noise in channels:
        for part in parts:
            found += float(part @ part) - part.size * noise**2
    return max(found, 0.0)
