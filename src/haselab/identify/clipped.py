"""Detect values that a converter or sensor has clipped: noise everywhere, but not at an end."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["clipping_of"]

Floats = NDArray[np.float64]
_FEWEST, _SHARE = 10, 0.02  # least number and share of values at an end of the range
_RUN = 3  # equal values in a row
_REPEATS = 0.02  # share of the other values that repeat the one before; above it: quantised
_VISIBLE = 1e-5  # noise over the range of the values; below it, a simulation with an exact limit
_ORDERS = range(1, 9)  # of differences, which suppress the signal and leave the noise
_MEDIAN = 0.6745  # of the size of a normal variable, over its standard deviation


def clipping_of(values: ArrayLike, what: str) -> str:
    """Say that values are clipped: many are exactly at an end, and the others are noisy.

    Args:
        values: measured, in order of time. Shape `(N,)`.
        what: plural name of the values, for the message.
    Returns:
        The reason and what to do, without a full stop; empty if they are not clipped.
    Example:
        >>> y = np.sin(np.arange(500) / 9.0) + 0.01 * np.random.default_rng(1).normal(size=500)
        >>> clipping_of(y, "outputs"), clipping_of(np.minimum(y, 0.5), "outputs")[:26]
        ('', '170 of the 500 outputs are')
    """
    found = np.asarray(values, dtype=np.float64)
    if found.size < 2:
        return ""
    for end in (float(found.min()), float(found.max())):
        at_end = found == end
        count = _in_runs(at_end)
        if count < max(_FEWEST, _SHARE * found.size):
            continue
        others = found[(found != found.min()) & (found != found.max())]
        if others.size > _FEWEST and _is_noisy(others):
            return (
                f"{count} of the {found.size} {what} are exactly {end:.6g}, the end of their "
                "range, although the others are noisy: they are clipped or filled in. Leave "
                "them out, or record with a larger range"
            )
    return ""


def _in_runs(at_end: NDArray[np.bool_]) -> int:
    """Number of values at an end in runs of several."""
    edges = np.flatnonzero(np.diff(at_end, prepend=False, append=False))
    length = edges[1::2] - edges[::2]
    return int(length[length >= _RUN].sum())


def _is_noisy(values: Floats) -> bool:
    if np.mean(np.diff(values) == 0.0) > _REPEATS:
        return False
    noise = min(
        float(np.median(np.abs(np.diff(values, order)))) / math.sqrt(math.comb(2 * order, order))
        for order in _ORDERS
        if values.size > order
    )
    return noise / _MEDIAN > _VISIBLE * float(np.ptp(values))
