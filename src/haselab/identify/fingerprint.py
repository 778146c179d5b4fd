"""Recognise samples that a fit has used, in whatever file and of whatever part of a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Fingerprint", "fingerprint", "share_used"]

Floats = NDArray[np.float64]
Hashes = NDArray[np.uint64]
_WINDOW = 16  # samples
_LEAST_CHANGES = 8  # of a window: a constant output looks the same in every record
_MOST = 256  # hashes that are kept
_BITS = 32
_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd, so no bit is lost
_ORDERS = range(1, 9)  # of differences, which suppress the signal and leave the noise
_FINEST, _COARSEST = 2.0**-14, 0.02  # of the standard deviation of the outputs
_MARGIN = 2.0**-8  # of a cell: windows with a sample nearer to its border are left out


@dataclass(frozen=True)
class Fingerprint:
    """What is kept of the outputs of a fit, to recognise them.

    Args:
        step: width of the cells in which samples count as equal, in the unit of the output.
        hashes: below 2^32, in rising order.
    """

    step: float
    hashes: Hashes

    def to_dict(self) -> dict[str, float | list[int]]:
        """As model files keep it.

        Returns:
            `step` and `hashes`.
        """
        return {"step": self.step, "hashes": self.hashes.tolist()}


def fingerprint(outputs: Sequence[ArrayLike], residuals: Sequence[ArrayLike] = ()) -> Fingerprint:
    """The smallest hashes of windows of 16 samples, at most 256 of them.

    Where a window begins in its record does not change its hash, so a part of the record has a
    proportional share of these hashes. Samples are compared in cells as wide as the noise, so that
    a copy is recognised in another format and with fewer digits: all of it where the copy's last
    digit is below 1/128 of the noise, a third where it is 1/4. A repetition of the experiment has
    other noise: two windows of independent noise agree with a probability of about 1e-9.

    Args:
        outputs: measured outputs of the records of a fit. Shape `(M_r,)` each.
        residuals: of the fit, which show the noise of outputs that change in every sample.
    Returns:
        The fingerprint; fewer hashes for short records and coarse ones.
    Source: Broder, On the resemblance and containment of documents (1997), for smallest hashes.
    """
    arrays = [np.asarray(y, dtype=np.float64) for y in outputs]
    step = _step(arrays, [np.asarray(e, dtype=np.float64) for e in residuals])
    found = [_hashes(y, step, _MARGIN) for y in arrays] if step > 0.0 else []
    kept = np.unique(np.concatenate(found))[:_MOST] if found else np.zeros(0, np.uint64)
    return Fingerprint(step, kept)


def share_used(outputs: Sequence[ArrayLike], known: Fingerprint) -> float:
    """Share of some records that a fit has used.

    Args:
        outputs: of the records in question. Shape `(M_r,)` each.
        known: fingerprint of those of the fit.
    Returns:
        Between 0 and 1; of long records an estimate, from the windows with the smallest hashes.
    Example:
        >>> y = np.random.default_rng(1).normal(size=1000)
        >>> known = fingerprint([y])
        >>> share_used([np.round(y[137:600], 4)], known), share_used([-y], known)
        (1.0, 0.0)
    """
    if not (known.hashes.size and len(outputs)):
        return 0.0
    # Twice the margin: rounding up to one margin leaves these windows in the fingerprint.
    mine = [_hashes(np.asarray(y, dtype=np.float64), known.step, 2.0 * _MARGIN) for y in outputs]
    hashes = np.concatenate(mine)
    if known.hashes.size >= _MOST:  # larger hashes of the fit were not kept
        hashes = hashes[hashes <= known.hashes.max()]
    return float(np.isin(hashes, known.hashes).mean()) if hashes.size else 0.0


def _step(outputs: Sequence[Floats], residuals: Sequence[Floats]) -> float:
    """Standard deviation of the noise, within limits; 0 for constant outputs."""
    centred = [y - y.mean() for y in outputs if y.size]
    spread = float(np.std(np.concatenate(centred))) if centred else 0.0
    noise = min(_noise(outputs), _noise(residuals))
    return min(max(noise, _FINEST * spread), _COARSEST * spread)


def _noise(signals: Sequence[Floats]) -> float:
    """Standard deviation of the noise, from the differences of the order that shows the least."""
    found = math.inf
    for order in _ORDERS:
        parts = [np.abs(np.diff(y, order)) for y in signals if y.size > order]
        if parts:
            mean = float(np.mean(np.concatenate(parts)))
            found = min(found, mean * math.sqrt(0.5 * math.pi / math.comb(2 * order, order)))
    return found


def _hashes(y: Floats, step: float, margin: float) -> Hashes:
    """Hash of each window with enough changes and no sample near the border of its cell."""
    count = y.size - _WINDOW + 1
    if count < 1:
        return np.zeros(0, np.uint64)
    place = y / step + 0.5
    cells = np.floor(place) + 0.0  # no negative zero
    inside = np.abs(place - cells - 0.5) <= 0.5 - margin
    changes = np.concatenate([[0], np.cumsum(cells[1:] != cells[:-1])])
    doubtful = np.concatenate([[0], np.cumsum(~inside)])
    lively = changes[_WINDOW - 1 :] - changes[:count] >= _LEAST_CHANGES
    lively &= doubtful[_WINDOW:] == doubtful[:count]
    words = _mixed(cells.view(np.uint64))
    total = np.zeros(count, np.uint64)
    for k in range(_WINDOW):
        total = total * _FACTOR + words[k : k + count]
    return np.asarray(_mixed(total)[lively] >> np.uint64(64 - _BITS))


def _mixed(words: Hashes) -> Hashes:
    """The finaliser of splitmix64, modulo 2^64."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        words = (words ^ (words >> np.uint64(shift))) * np.uint64(factor)
    return words ^ (words >> np.uint64(31))
