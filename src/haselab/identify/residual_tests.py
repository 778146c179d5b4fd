"""Whether residuals still hold something of the input."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import chdtrc

from haselab.identify.noise import autoregression
from haselab.identify.record import Record

__all__ = ["input_correlation_p"]

Floats = NDArray[np.float64]
_LAGS = 12
_REACH = 0.1  # of the record: the longest lag
_DEPENDENT = 1e-8


def input_correlation_p(records: Sequence[Record], residuals: Sequence[Floats]) -> float:
    r"""Probability that residuals which have nothing to do with the input are this like it.

    The residuals, whitened by their autoregressive model, are regressed on the input, filtered
    alike, of 12 times ago up to a tenth of the record.
    $\lVert Q'e\rVert^2/\sigma^2$, chi-square with as many degrees as independent lags

    Args:
        records: experiments.
        residuals: measured minus modelled. Shape `(M_r,)` each.
    Returns:
        Probability; below 0.05 the model leaves some of the dynamics unexplained.
    Source: Ljung, System Identification (1999), section 16.6, whitened.
    """
    polynomial, variance = autoregression(residuals)
    if not variance > 0.0:
        return 1.0
    columns, targets = [], []
    for record, e in zip(records, residuals, strict=True):
        lag_s = _REACH * record.duration_s / _LAGS
        lagged = [_input_before(record, k * lag_s) for k in range(_LAGS)]
        columns.append(lfilter(polynomial, [1.0], np.stack(lagged, axis=1), axis=0))
        targets.append(lfilter(polynomial, [1.0], e))
    matrix, target = np.vstack(columns), np.concatenate(targets)
    vectors, sizes, _ = np.linalg.svd(matrix, full_matrices=False)
    told = sizes > _DEPENDENT * sizes[0]
    along = vectors[:, told].T @ target
    return float(chdtrc(int(told.sum()), float(along @ along) / variance))


def _input_before(record: Record, lag_s: float) -> Floats:
    """Input of a time ago at each output, less its mean."""
    index = np.floor((record.output_time_s - lag_s) * record.input_rate_hz + 1e-9).astype(np.intp)
    before = record.input_before or 0.0
    values = np.where(index < 0, before, record.u[np.clip(index, 0, record.u.size - 1)])
    return np.asarray(values - values.mean())
