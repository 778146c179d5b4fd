"""Recognise samples that a fit has used, in whatever file and of whatever part of a record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["TrainingOutput", "find_copy", "grid_step", "hash_output", "is_comparable", "share_used"]

Floats = NDArray[np.float64]
Hashes = NDArray[np.uint64]
_WINDOW = 16  # differences of samples
_LEAST_CHANGES = 8  # of a window: a constant output looks the same in every record
_MOST = 256  # hashes that are kept
_BITS = 32
_FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd, so no bit is lost
_ORDERS = range(1, 9)  # of differences, which suppress the signal and leave the noise
_FINEST, _COARSEST = 2.0**-14, 0.02  # of the standard deviation of the outputs
_MARGIN = 2.0**-8  # of a cell: windows with a difference nearer to its border are left out
# Standard deviation of the noise, in steps of the converter, below which the noise of a repetition
# often leaves all values of a window as they were: 0.3 % of the windows at this limit.
_HIDDEN_NOISE = 0.4
_OFF_GRID = 0.15  # steps, from the nearest multiple; values were printed with few digits
_FEW_OFF_GRID = 0.05  # share of the levels
_ROUNDING = 1e-9  # of the span of the levels: closer ones are the same
_FEW_LEVELS, _MANY_SAME = 0.25, 0.1  # share of the samples, and of their differences
_MOST_BY_CHANCE = 0.05  # share of quantised windows; below it the records are new
_COPIED = 0.05  # share of the samples of a record, above which it is a copy
_LEAST_ALIKE, _LEAST_WINDOWS = 0.99, 100  # share and number of windows that show a copy of them


@dataclass(frozen=True)
class TrainingOutput:
    """What is kept of the outputs that a model was fitted to, to recognise them.

    Args:
        cell: width of the cells in which differences of successive samples count as equal, in the
            unit of the output.
        hashes: of windows of 16 differences; below 2^32, in rising order.
        quantised: the steps of the converter are larger than the noise, so a repetition of the
            experiment has many windows in common with these outputs.
    """

    cell: float
    hashes: Hashes
    quantised: bool = False

    def to_dict(self) -> dict[str, float | bool | list[int]]:
        """As model files keep it.

        Returns:
            `cell`, `quantised` and `hashes`.
        """
        return {
            "cell": self.cell,
            "quantised": self.quantised,
            "hashes": self.hashes.tolist(),
        }


def hash_output(
    outputs: Sequence[ArrayLike], residuals: Sequence[ArrayLike] = ()
) -> TrainingOutput:
    """The smallest hashes of windows of 16 differences of samples, at most 256 of them.

    Where a window begins in its record does not change its hash, so a part of the record has a
    proportional share of these hashes; nor does a constant that was added to the record.
    Differences are compared in cells as wide as their noise, so that a copy is recognised in
    another format and with fewer digits: all of it where the copy's last digit is below 1/128 of
    the noise, a third where it is 1/4. A repetition of the experiment has other noise: two windows
    of independent noise agree with a probability of about 1e-9. The steps of a converter may hide
    the noise. Then only windows that occur once in their record are kept.

    Args:
        outputs: measured outputs of the records of a fit. Shape `(M_r,)` each.
        residuals: of the fit, which show the noise of outputs that change in every sample.
    Returns:
        The hashes; fewer for short records and constant ones.
    Source: Broder, On the resemblance and containment of documents (1997), for smallest hashes.
    """
    arrays = [np.asarray(y, dtype=np.float64) for y in outputs]
    noise = _noise_std(arrays, [np.asarray(e, dtype=np.float64) for e in residuals])
    level = max((_level_step(y) for y in arrays), default=0.0)
    quantised = noise < _HIDDEN_NOISE * level
    cell = 0.5 * level if quantised else math.sqrt(2.0) * noise
    known = TrainingOutput(cell, np.zeros(0, np.uint64), quantised)
    found = _all_hashes(arrays, known, _MARGIN) if cell > 0.0 else known.hashes
    return replace(known, hashes=np.unique(found)[:_MOST])


def share_used(outputs: Sequence[ArrayLike], known: TrainingOutput) -> float:
    """Share of some records that a fit has used.

    Args:
        outputs: of the records in question. Shape `(M_r,)` each.
        known: outputs of the fit.
    Returns:
        Between 0 and 1; of long records an estimate, from the windows with the smallest hashes.
        NaN where the steps of the converter hide whether the records are a repetition or in part a
        copy, and where no window can be compared.
    Example:
        >>> y = np.random.default_rng(1).normal(size=1000)
        >>> known = hash_output([y])
        >>> share_used([np.round(y[137:600], 4)], known), share_used([-y], known)
        (1.0, 0.0)
    """
    hashes = _compared(outputs, known)
    if not hashes.size:
        return math.nan
    share = float(np.isin(hashes, known.hashes).mean())
    copied = share >= _LEAST_ALIKE and hashes.size >= _LEAST_WINDOWS
    return math.nan if known.quantised and share > _MOST_BY_CHANCE and not copied else share


def find_copy(outputs: Sequence[ArrayLike]) -> tuple[int, int, float] | None:
    """Find the two records that have the largest share of samples in common.

    Args:
        outputs: of the records, all of one quantity. Shape `(M_r,)` each.
    Returns:
        Places of both records, and the share of the samples of one that are in the other; None if
        no two records share more than 5 %.
    Example:
        >>> y = np.random.default_rng(1).normal(size=(2, 1000))
        >>> find_copy(y), find_copy([y[0], y[1], np.round(y[0, 100:600], 4)])
        (None, (0, 2, 1.0))
    """
    known = [hash_output([each]) for each in outputs]
    found: tuple[int, int, float] | None = None
    for one, other in combinations(range(len(outputs)), 2):
        # Few windows of a long record are kept, so a short part of it may have none of them.
        both = share_used([outputs[other]], known[one]), share_used([outputs[one]], known[other])
        share = max((share for share in both if math.isfinite(share)), default=0.0)
        if share > (_COPIED if found is None else found[2]):
            found = one, other, share
    return found


def is_comparable(outputs: Sequence[ArrayLike], known: TrainingOutput) -> bool:
    """Whether some records have windows that can be compared with the outputs of a fit.

    Args:
        outputs: of the records. Shape `(M_r,)` each.
        known: outputs of the fit.
    Returns:
        False for constant records, and for many short ones.
    """
    return bool(_compared(outputs, known).size)


def _compared(outputs: Sequence[ArrayLike], known: TrainingOutput) -> Hashes:
    """Hashes of windows that the outputs of the fit would have kept, too."""
    if not (known.hashes.size and len(outputs)):
        return np.zeros(0, np.uint64)
    # Twice the margin: rounding up to one margin leaves these windows among those of the fit.
    arrays = [np.asarray(y, dtype=np.float64) for y in outputs]
    hashes = _all_hashes(arrays, known, 2.0 * _MARGIN)
    if known.hashes.size >= _MOST:  # larger hashes of the fit were not kept
        hashes = hashes[hashes <= known.hashes.max()]
    return hashes


def _level_step(y: Floats) -> float:
    """Step between the levels of a quantised output; 0 for any other.

    A slope that was subtracted leaves the differences in steps, a curved map leaves repeated
    values.
    """
    return max(grid_step(y), grid_step(np.diff(y)), _repeated_step(y))


def grid_step(values: Floats) -> float:
    """Return the step of the grid on which values lie, such as the unit of their last digit.

    Args:
        values: shape `(N,)`.
    Returns:
        The step; 0 if there is none.
    Example:
        >>> round(grid_step(np.round(np.sin(np.arange(100.0)), 2)), 6)
        0.01
    """
    levels = np.unique(values)
    gaps = np.diff(levels)
    gaps = gaps[gaps > _ROUNDING * np.ptp(levels)] if levels.size else gaps
    if gaps.size < 2:
        return 0.0
    step = float(np.quantile(gaps, _FEW_OFF_GRID))
    steps = gaps / step
    on_grid = np.abs(steps - np.round(steps)) < _OFF_GRID
    return step if np.mean(on_grid) > 1.0 - _FEW_OFF_GRID else 0.0


def _repeated_step(y: Floats) -> float:
    """Typical step where few values recur, also in successive samples; 0 elsewhere."""
    levels, counts = np.unique(y, return_counts=True)
    if not 3 <= levels.size <= _FEW_LEVELS * y.size or np.mean(np.diff(y) == 0.0) < _MANY_SAME:
        return 0.0
    gaps = np.concatenate([[math.inf], np.diff(levels), [math.inf]])
    return float(np.quantile(np.repeat(np.minimum(gaps[1:], gaps[:-1]), counts), 0.75))


def _all_hashes(outputs: Sequence[Floats], known: TrainingOutput, margin: float) -> Hashes:
    """Hashes of all outputs; of quantised ones those that occur once in their record.

    Without noise each period of a periodic output has the same windows, in every repetition.
    """
    found = [_hashes(y, known.cell, margin) for y in outputs]
    if known.quantised:
        counted = [np.unique(hashes, return_counts=True) for hashes in found]
        found = [hashes[counts == 1] for hashes, counts in counted]
    return np.concatenate(found) if found else known.hashes


def _noise_std(outputs: Sequence[Floats], residuals: Sequence[Floats]) -> float:
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


def _hashes(y: Floats, cell: float, margin: float) -> Hashes:
    """Hash of each window with enough changes and no difference near the border of its cell."""
    count = y.size - _WINDOW
    if count < 1:
        return np.zeros(0, np.uint64)
    place = np.diff(y) / cell + 0.5
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
