"""Test whether residuals are still correlated with the input."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from haselab.identify.noise import autoregression
from haselab.identify.record import Record
from haselab.models.filters import lfilter

__all__ = ["input_correlation_p", "lags_of", "means_before"]

Floats = NDArray[np.float64]
_LAGS = 32
_REACH = 0.1  # of the record: longest lag
_DEPENDENT = 1e-8


def input_correlation_p(records: Sequence[Record], residuals: Sequence[Floats]) -> float:
    r"""Probability of such a correlation if the residuals are independent of the input.

    The residuals are regressed on the mean input over 31 past intervals, which grow from one
    output to a tenth of the record, both whitened by an autoregressive model of the part that the
    input does not explain.
    $\lVert Q'e\rVert^2/\sigma^2$, chi-square with as many degrees of freedom as independent
    intervals

    Args:
        records: experiments.
        residuals: measured minus modelled. Shape `(M_r,)` each.
    Returns:
        Probability; below 0.05 part of the dynamics is missing from the model.
    Source: Ljung, System Identification (1999), section 16.6, whitened.
    """
    lags_s = lags_of(records)
    lagged = [means_before(record, lags_s) for record in records]
    left = _explained(lagged, residuals)[1]
    polynomial, variance = autoregression(left)
    if not variance > 0.0:
        return 1.0
    white = [lfilter(polynomial, [1.0], columns, axis=0) for columns in lagged]
    along, _ = _explained(white, [lfilter(polynomial, [1.0], e) for e in residuals])
    return float(chdtrc(along.size, float(along @ along) / variance))


def lags_of(records: Sequence[Record]) -> Floats:
    """Edges of past intervals that grow from one output to a tenth of the record, in s."""
    step_s = min(record.output_step_s for record in records)
    most = max(2.0, _REACH * max(record.duration_s for record in records) / step_s)
    return np.asarray(step_s * np.unique(np.rint(np.geomspace(1.0, most + 1.0, _LAGS)) - 1.0))


def _explained(columns: Sequence[Floats], targets: Sequence[Floats]) -> tuple[Floats, list[Floats]]:
    """Coordinates of the targets in the span of the columns, and the remainder."""
    stacked, target = np.vstack(columns), np.concatenate(targets)
    # The triangle of a QR decomposition is as accurate as all rows, and far smaller.
    triangle = np.asarray(np.linalg.qr(np.column_stack([stacked, target]), mode="r"))
    vectors, sizes, turned = np.linalg.svd(triangle[:, :-1], full_matrices=False)
    inside = sizes > _DEPENDENT * sizes[0]
    along = vectors[:, inside].T @ triangle[:, -1]
    ends = np.cumsum([t.size for t in targets])[:-1]
    left = target - stacked @ (turned[inside].T @ (along / sizes[inside]))
    return along, np.split(left, ends)


def means_before(record: Record, lags_s: Floats) -> Floats:
    """Mean input between successive lags before each output, centred. `(M, K - 1)`."""
    before = record.input_before or 0.0
    edges_s = np.arange(record.u.size + 1) / record.input_rate_hz
    summed = np.concatenate([[0.0], np.cumsum(record.u - before)]) / record.input_rate_hz
    integral = np.empty((record.y.size, lags_s.size))
    for k, lag_s in enumerate(lags_s.tolist()):  # rising times are found fast
        late_s = record.output_time_s - lag_s
        beyond_s = np.maximum(late_s - edges_s[-1], 0.0)
        integral[:, k] = np.interp(late_s, edges_s, summed) + (record.u[-1] - before) * beyond_s
    means = -np.diff(integral, axis=1) / np.diff(lags_s)
    return np.asarray(means - means.mean(axis=0))
