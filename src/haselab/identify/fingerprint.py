"""Recognise samples that a fit has used, in whatever file and of whatever part of a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["fingerprint", "share_used"]

Floats = NDArray[np.float64]
Hashes = NDArray[np.uint64]
_WINDOW = 16  # samples
_LEAST_CHANGES = 8  # of a window: a constant output looks the same in every record
_MOST = 256  # hashes that are kept
_BITS = 32
_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd, so no bit is lost


def fingerprint(outputs: Sequence[ArrayLike]) -> Hashes:
    """The smallest hashes of all windows of 16 samples, at most 256 of them.

    Where a window begins in its record does not change its hash, so a part of the record has a
    proportional share of these hashes. Samples are compared in single precision: the format of
    the file, the rate and the other columns do not matter.

    Args:
        outputs: measured outputs of the records of a fit. Shape `(M_r,)` each.
    Returns:
        Hashes below 2^32, in rising order; fewer for short records and coarse ones.
    """
    found = [_hashes(np.asarray(y, dtype=np.float64)) for y in outputs]
    return np.unique(np.concatenate(found))[:_MOST] if found else np.zeros(0, np.uint64)


def share_used(outputs: Sequence[ArrayLike], known: ArrayLike) -> float:
    """Share of some records that a fit has used.

    Args:
        outputs: of the records in question. Shape `(M_r,)` each.
        known: fingerprint of those of the fit.
    Returns:
        Between 0 and 1; of long records an estimate, from the windows with the smallest hashes.
    Example:
        >>> y = np.random.default_rng(1).normal(size=1000)
        >>> share_used([y[137:600]], fingerprint([y])), share_used([-y], fingerprint([y]))
        (1.0, 0.0)
    """
    used = np.asarray(known, dtype=np.uint64)
    mine = [_hashes(np.asarray(y, dtype=np.float64)) for y in outputs]
    if not (used.size and mine):
        return 0.0
    hashes = np.concatenate(mine)
    if used.size >= _MOST:  # larger hashes of the fit were not kept
        hashes = hashes[hashes <= used.max()]
    return float(np.isin(hashes, used).mean()) if hashes.size else 0.0


def _hashes(y: Floats) -> Hashes:
    """Hash of each window with enough changes."""
    single = y.astype(np.float32) + np.float32(0.0)  # no negative zero
    count = single.size - _WINDOW + 1
    if count < 1:
        return np.zeros(0, np.uint64)
    changes = np.concatenate([[0], np.cumsum(single[1:] != single[:-1])])
    lively = changes[_WINDOW - 1 :] - changes[:count] >= _LEAST_CHANGES
    words = _mixed(single.view(np.uint32).astype(np.uint64))
    total = np.zeros(count, np.uint64)
    for k in range(_WINDOW):
        total = total * _FACTOR + words[k : k + count]
    return np.asarray(_mixed(total)[lively] >> np.uint64(64 - _BITS))


def _mixed(words: Hashes) -> Hashes:
    """The finaliser of splitmix64, modulo 2^64."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        words = (words ^ (words >> np.uint64(shift))) * np.uint64(factor)
    return words ^ (words >> np.uint64(31))
