"""The part of a record in which strain is a polynomial of the capacitance."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["fitted_range"]

Floats = NDArray[np.float64]
_CELLS = 24  # of equal capacitance
_FEWEST_CELLS = 6
_LEFT = 0.05  # of the strain's span, that the curve may be away from the mean of a cell
_NOISE = 4.0  # standard deviations of that mean


def fitted_range(
    c: Floats,
    e: Floats,
    branch: NDArray[np.intp],
    fit: Callable[[Floats, Floats], Floats | None],
) -> tuple[float, float] | None:
    """Find the range of capacitances, with the largest change of strain, that a curve follows.

    A hydraulic actuator that is slack changes its capacitance but not its length; beyond a limit it
    may turn. One polynomial cannot follow such a part and the rest. A curve follows a range if it
    is within 5 % of its own span of the mean strain of each of 24 cells, hysteresis averaged.

    Args:
        c: capacitances, in F. Shape `(N,)`.
        e: strains. Shape `(N,)`.
        branch: 1 where the capacitance rises, -1 where it falls. Shape `(N,)`.
        fit: curve through points, as its values there; None if it is not monotonic.
    Returns:
        Lowest and highest capacitance, in F; None if no range of 6 cells has such a curve.
    """
    low_f, width_f = float(c.min()), float(np.ptp(c)) / _CELLS
    cell = np.minimum(((c - low_f) / width_f).astype(np.intp), _CELLS - 1)
    group = 2 * cell + (branch > 0)
    count = np.bincount(group, minlength=2 * _CELLS).reshape(_CELLS, 2)
    c_mean, e_mean, e_square = (
        np.divide(np.bincount(group, values, 2 * _CELLS).reshape(_CELLS, 2), count,
                  out=np.full((_CELLS, 2), np.nan), where=count > 0)
        for values in (c, e, e**2)
    )  # fmt: skip
    filled = np.flatnonzero((count > 0).any(axis=1))
    x, y = np.nanmean(c_mean[filled], axis=1), np.nanmean(e_mean[filled], axis=1)
    variance = np.maximum(e_square - e_mean**2, 0.0) / np.maximum(count, 1)
    noise = np.sqrt(np.nanmean(variance[filled], axis=1))
    best, span = None, 0.0
    for first, last in itertools.combinations(range(filled.size), 2):
        part = slice(first, last + 1)
        if last - first + 1 < min(_FEWEST_CELLS, filled.size) or np.ptp(y[part]) <= span:
            continue
        curve = fit(x[part], y[part])
        if curve is None:
            continue
        own = abs(float(curve[-1] - curve[0]))
        if (np.abs(y[part] - curve) <= _LEFT * own + _NOISE * noise[part]).all() and own > span:
            best, span = (first, last), own
    if best is None:
        return None
    ends = low_f + width_f * filled[best[0]], low_f + width_f * (filled[best[1]] + 1)
    return float(ends[0]), float(ends[1])
