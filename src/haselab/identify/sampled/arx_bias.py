"""Bias of a least-squares difference equation, measured with instrumental variables."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.models.filters import lfilter

__all__ = ["instrumental_coefficients", "regressors"]

Floats = NDArray[np.float64]
_ROUNDS = 3
_SINGULAR = 1e-10
_HIGH = 30  # order of the first equation


def regressors(u: Floats, y: Floats, orders: tuple[int, int, int], first: int) -> Floats:
    """Earlier outputs with their sign turned, then inputs, from sample `first` on.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
        orders: na, nb and nk.
        first: at least as many samples as the equation looks back.
    Returns:
        Shape `(N - first, na + nb)`.
    """
    na, nb, nk = orders
    k = np.arange(first, y.size)
    past = [-y[k - i] for i in range(1, na + 1)]
    return np.column_stack([*past, *(u[k - nk - j] for j in range(nb))])


def instrumental_coefficients(
    u: Floats, y: Floats, orders: tuple[int, int, int], first: int, *, constant: bool
) -> Floats | None:
    r"""Coefficients that noise of the output does not bias, if the input is independent of it.

    $\hat\theta = (Z'\Phi)^{-1} Z'y$, with the earlier outputs of $Z$ simulated from the input.

    Args:
        u: inputs. Shape `(N,)`.
        y: outputs. Shape `(N,)`.
        orders: na, nb and nk.
        first: sample of the first equation.
        constant: whether the equation has a constant.
    Returns:
        `a`, then `b`, and the constant if there is one; None if the equations are singular.
    Source: Ljung, System Identification (1999), section 7.6.
    """
    na, nb, nk = orders
    ones = np.ones((y.size - first, int(constant)))
    columns = np.hstack([regressors(u, y, orders, first), ones])
    # First outputs simulated by an equation of high order, which noise biases little, else earlier
    # inputs; then outputs simulated with the last coefficients.
    simulated = _simulated(u, y, nk)
    if simulated is None:
        simulated = np.concatenate([np.zeros(nb + nk - 1), u])[: u.size]
    for _ in range(_ROUNDS):
        instruments = np.hstack([regressors(u, simulated, orders, first), ones])
        scale = np.sqrt((instruments**2).sum(axis=0))
        if not np.isfinite(scale).all() or not (scale > 0.0).all():
            return None
        matrix = (instruments / scale).T @ columns
        sizes = np.linalg.svd(matrix / np.abs(matrix).max(axis=0), compute_uv=False)
        if not sizes[-1] > _SINGULAR * sizes[0]:
            return None
        coefficients = np.asarray(np.linalg.solve(matrix, (instruments / scale).T @ y[first:]))
        bottom = np.concatenate([[1.0], coefficients[:na]])
        if (np.abs(np.roots(bottom)) >= 1.0).any():
            return coefficients
        simulated = np.asarray(
            lfilter(np.concatenate([np.zeros(nk), coefficients[na : na + nb]]), bottom, u)
        )
    return coefficients


def _simulated(u: Floats, y: Floats, nk: int) -> Floats | None:
    """Output of an equation of high order, fitted by least squares; None if it is unstable."""
    order = min(_HIGH, y.size // 20)
    first = order + nk
    if order < 1:
        return None
    columns = np.hstack([regressors(u, y, (order, order, nk), first), np.ones((y.size - first, 1))])
    coefficients = np.linalg.lstsq(columns, y[first:], rcond=None)[0]
    bottom = np.concatenate([[1.0], coefficients[:order]])
    if (np.abs(np.roots(bottom)) >= 1.0).any():
        return None
    top = np.concatenate([np.zeros(nk), coefficients[order : 2 * order]])
    return np.asarray(lfilter(top, bottom, u))
