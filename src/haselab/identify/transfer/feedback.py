"""Detect a closed loop in a record: an input that follows the residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from haselab.identify.record import Record
from haselab.identify.residual_tests import lags_of, means_before

__all__ = ["feedback_p"]

Floats = NDArray[np.float64]
_LAGS = 12
_PREDICTED = 1e-8  # share of the input that its own past does not predict: too small for a test
_DEPENDENT = 1e-8


def feedback_p(records: Sequence[Record], residuals: Sequence[Floats]) -> float:
    """Probability of an input that follows the residuals so closely, if no loop was closed.

    Past residuals must not predict the input better than its own past does. The part of the
    residuals that follows from earlier inputs, as of a pole that is missing, is removed first.

    Args:
        records: experiments.
        residuals: measured minus modelled. Shape `(M_r,)` each.
    Returns:
        The least probability of all records; 1 where outputs are not sampled with the input.
    Source: Granger, Econometrica 37 (1969), 424.
    """
    found, lags_s = [1.0], lags_of(records)
    for record, e in zip(records, residuals, strict=True):
        u = record.u - record.u.mean()
        if u.size != e.size or u.size < 20 * _LAGS:
            continue
        k = np.arange(_LAGS, u.size)
        past = np.column_stack([*(u[k - i] for i in range(1, _LAGS + 1)), np.ones(k.size)])
        basis, _ = np.linalg.qr(past)
        left = u[k] - basis @ (basis.T @ u[k])
        driven = means_before(record, lags_s)
        e = e - driven @ np.linalg.lstsq(driven, e, rcond=None)[0]
        lagged = np.column_stack([e[k - i] for i in range(_LAGS)])
        lagged -= basis @ (basis.T @ lagged)
        vectors, sizes, _ = np.linalg.svd(lagged, full_matrices=False)
        vectors = vectors[:, sizes > _DEPENDENT * sizes[0]]
        if not left @ left > _PREDICTED * float(u @ u) or not vectors.size:
            continue
        along = vectors.T @ left
        freedom = k.size - past.shape[1] - vectors.shape[1]
        variance = float(left @ left - along @ along) / freedom
        statistic = float(along @ along) / variance if variance > 0.0 else np.inf
        found.append(float(chdtrc(vectors.shape[1], statistic)))
    return min(found)
