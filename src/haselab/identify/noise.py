"""Residual analysis: fit percentage, whiteness, and intervals valid for coloured noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc

from haselab import _identify
from haselab.models.filters import lfilter

__all__ = [
    "autoregression",
    "coloured_covariance",
    "fit_percent",
    "noise_behind",
    "r_squared",
    "whiteness_p",
]

Floats = NDArray[np.float64]
_MAX_ORDER = 20
_SINGULAR = 1e-12
_CORRECTIONS = 3


def fit_percent(measured: Sequence[Floats], modelled: Sequence[Floats]) -> float:
    r"""Normalised root-mean-square fit over all records, as defined by MATLAB's `compare`.

    $100\,(1 - \lVert y - \hat y\rVert / \lVert y - \bar y\rVert)$, each record with its own mean

    Args:
        measured: outputs, one array per record. Shape `(M_r,)`.
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
    r"""Ljung-Box probability of such residuals under white noise.

    $Q = N(N + 2) \sum_k \hat\rho_k^2/(N - k)$, chi-square with as many degrees of freedom as lags

    Args:
        residuals: one array per record, in order of time. Shape `(M_r,)`.
        lags: number of lags; at most a fifth of the samples are used.
    Returns:
        Probability; below 0.05 the model does not explain everything.
    Source: Ljung and Box, Biometrika 65 (1978), 297.
    """
    count = sum(e.size for e in residuals)
    if count < 2:
        return 1.0
    lags = max(1, min(lags, count // 5))
    covariance = _autocovariance(residuals, lags)
    if covariance[0] <= 0.0:
        return 1.0
    if not np.isfinite(covariance).all():
        return 0.0
    correlation = covariance[1:] / covariance[0]
    q = count * (count + 2) * float((correlation**2 / (count - np.arange(1, lags + 1))).sum())
    return float(chdtrc(lags, q))


def autoregression(residuals: Sequence[Floats]) -> tuple[Floats, float]:
    """Autoregressive noise model of the order that BIC chooses; order 0 is white noise.

    Args:
        residuals: one array per record. Shape `(M_r,)`.
    Returns:
        Polynomial `(1, a1, ..., ap)` and variance of its innovation.
    Source: Levinson's recursion on the pooled autocovariance; Schwarz, Ann. Stat. 6 (1978), 461.
    """
    count = sum(e.size for e in residuals)
    covariance = _autocovariance(residuals, max(0, min(_MAX_ORDER, count // 10)))
    return _identify.autoregression(covariance.tolist(), count)


def noise_behind(
    residuals: Sequence[Floats], columns: Sequence[Floats], own: Sequence[Floats] | None = None
) -> tuple[Floats, float]:
    r"""Autoregressive model of the noise, corrected for the part that the fit removed.

    $\mathrm{E}\,ee' = (I - H)\,\Sigma\,(I - H)$, with $H$ the projection on the fitted functions;
    the autocovariance of $\Sigma$ is adjusted until that of $ee'$ matches the observed one.

    Args:
        residuals: one array per record. Shape `(M_r,)`.
        columns: fitted functions common to all records. Shape `(M_r, P)`.
        own: orthonormal functions of one record, to which its columns are orthogonal. `(M_r, Q)`.
    Returns:
        Polynomial `(1, a1, ..., ap)` and variance of the innovation.
    Source: method of moments; the trace formulas follow from the line above.
    """
    count = sum(e.size for e in residuals)
    lags = max(0, min(_MAX_ORDER, count // 10))
    observed = _autocovariance(residuals, lags)
    bases = _orthonormal(columns, own)
    covariance = observed
    for _ in range(_CORRECTIONS):
        polynomial, variance = _identify.autoregression(covariance.tolist(), count)
        spread, taken = _taken(bases, polynomial, variance, lags)
        kept = sum(np.maximum(e.size - np.arange(lags + 1), 0) for e in residuals) / count
        moved = spread + observed - (kept * spread - taken / count)
        if not moved[0] > 0.0:
            break
        covariance = moved
    return _identify.autoregression(covariance.tolist(), count)


def coloured_covariance(
    columns: Sequence[Floats],
    residuals: Sequence[Floats],
    parameters: int,
    own: Sequence[Floats] | None = None,
    *,
    prior: Floats | None = None,
) -> Floats:
    r"""Covariance of least-squares estimates when the noise may be coloured.

    $(Z'Z)^{-1} Z' \Sigma Z (Z'Z)^{-1}$, with the noise covariance $\Sigma$ of an autoregressive
    model of the residuals; white residuals give the classical formula. Coloured residuals are
    first corrected for the noise that the fit removed.

    Args:
        columns: sensitivities of the output to the estimates, one array per record. `(M_r, P)`.
        residuals: one array per record. Shape `(M_r,)`.
        parameters: all fitted parameters, nuisances included.
        own: orthonormal functions of one record only, to which its columns are orthogonal.
            Shape `(M_r, Q)`. None: none.
        prior: information on each estimate before the records, whose residuals then have a
            variance of about 1. Positive, shape `(P,)`; None: none.
    Returns:
        Covariance. Shape `(P, P)`; without a prior, a variance is infinite where a parameter
            is not identifiable.
    Source: White, Econometrica 48 (1980), 817, with a parametric noise covariance.
    """
    count = sum(e.size for e in residuals)
    polynomial, variance = autoregression(residuals)
    size = columns[0].shape[1]
    before = np.zeros(size) if prior is None else prior
    scale = np.sqrt(sum(((z**2).sum(axis=0) for z in columns), before))
    if not (scale > 0.0).all():
        return np.full((size, size), np.inf)
    if polynomial.size > 1:
        polynomial, variance = noise_behind(residuals, columns, own)
    else:
        variance *= count / max(count - parameters, 1)
    gram, middle = np.diag(before / scale**2), np.zeros((size, size))
    for z in columns:
        z = z / scale
        gram += z.T @ z
        if polynomial.size == 1:
            filtered = z
        else:
            padded = np.vstack([z[::-1], np.zeros_like(z)])
            filtered = np.asarray(lfilter([1.0], polynomial, padded, axis=0))
        middle += filtered.T @ filtered
    middle = variance * middle + np.diag(before / scale**2)
    if prior is None:
        inverse, blind = _inverse(gram)
    else:
        # of the factor, not of the sum, which would lose the weak directions
        factor = np.vstack([*columns, np.diag(np.sqrt(prior))]) / scale
        upper = np.linalg.inv(np.linalg.qr(factor, mode="r"))
        inverse, blind = upper @ upper.T, np.zeros(size, dtype=bool)
    covariance = inverse @ middle @ inverse / np.outer(scale, scale)
    covariance[blind, blind] = np.inf
    return np.asarray(covariance)


@dataclass(frozen=True)
class _Basis:
    """Orthonormal fitted functions of one record: `own` ones first, then the common ones.

    Args:
        values: Shape `(M, own + P)`.
        own: number that belong to this record alone.
    """

    values: Floats
    own: int


def _orthonormal(columns: Sequence[Floats], own: Sequence[Floats] | None) -> list[_Basis]:
    """Bases of all records; the common functions are orthonormal over all records together."""
    ends = np.cumsum([z.shape[0] for z in columns])[:-1]
    stacked = np.vstack(columns)
    stacked = stacked / np.maximum(np.sqrt((stacked**2).sum(axis=0)), 1e-300)
    vectors, sizes, _ = np.linalg.svd(stacked, full_matrices=False)
    common = np.split(vectors[:, sizes > 1e-9 * sizes[0]], ends)
    alone = [np.zeros((z.shape[0], 0)) for z in columns] if own is None else own
    return [_Basis(np.hstack([a, c]), a.shape[1]) for a, c in zip(alone, common, strict=True)]


def _taken(
    bases: Sequence[_Basis], polynomial: Floats, variance: float, lags: int
) -> tuple[Floats, Floats]:
    """Autocovariance of a noise model, and what a fit removes from its sums at each lag."""
    covered = [_times_covariance(polynomial, variance, basis.values) for basis in bases]
    spread = covered[0][0][: lags + 1]
    inner = [b.values.T @ covering for b, (_, covering) in zip(bases, covered, strict=True)]
    common = sum(part[b.own :, b.own :] for b, part in zip(bases, inner, strict=True))
    taken = np.zeros(lags + 1)
    for basis, part, (_, covering) in zip(bases, inner, covered, strict=True):
        part[basis.own :, basis.own :] = common
        q = basis.values
        for lag in range(min(lags, q.shape[0] - 1) + 1):
            head, tail = q[: q.shape[0] - lag], q[lag:]
            taken[lag] += np.sum(tail * covering[: q.shape[0] - lag])
            taken[lag] += np.sum(head * covering[lag:])
            taken[lag] -= np.sum((head.T @ tail) * part)
    return spread, taken


def _times_covariance(
    polynomial: Floats, variance: float, columns: Floats
) -> tuple[Floats, Floats]:
    """Autocovariance of an autoregressive process, and its covariance matrix times columns."""
    count = columns.shape[0]
    size = next_fast_len(2 * max(count, 64), real=True)
    spectrum = variance / np.abs(rfft(polynomial, 2 * size)) ** 2
    correlation = irfft(spectrum, 2 * size)[:count]
    circle = np.zeros(size)
    circle[:count] = correlation
    circle[size - count + 1 :] = correlation[:0:-1]
    product = irfft(rfft(circle)[:, None] * rfft(columns, size, axis=0), size, axis=0)
    return correlation, product[:count]


def _inverse(gram: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Inverse on the identifiable directions; marks estimates with other directions."""
    values, vectors = np.linalg.eigh(gram)
    regular = values > _SINGULAR * values[-1]
    inverse = (vectors[:, regular] / values[regular]) @ vectors[:, regular].T
    return inverse, (np.abs(vectors[:, ~regular]) > 1e-3).any(axis=1)
