"""Cyclic records: rising and falling edges, cells of equal strain, trend and width of the loop."""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from scipy.special import ndtri

from haselab.identify.noise import coloured_covariance

__all__ = ["loop_cells", "loop_width", "rising_edges", "trend"]

Floats = NDArray[np.float64]
_REVERSAL = 0.2  # of the span: a smaller move back does not end an edge
_MOST_CELLS = 40
_UNRELATED_P = 1e-6
_BENDS = 5


def rising_edges(values: Floats) -> NDArray[np.int_]:
    """1 on the edges that rise, -1 on those that fall; an edge ends at a large reversal.

    Args:
        values: in order of time. Shape `(N,)`.
    Returns:
        Direction of each sample. All 0 when the samples are not in order of time, that is, when
        more than an eighth of the samples are turning points.
    Example:
        >>> rising_edges(np.array([0.0, 1.0, 2.0, 1.9, 3.0, 2.0, 1.0])).tolist()
        [1, 1, 1, 1, 1, -1, -1]
    """
    back = _REVERSAL * float(np.ptp(values))
    # The first edge has no direction yet: it begins at the extreme that is left first.
    turns, direction, lowest, highest = [0], 0, 0, 0
    for i, value in enumerate(values):
        lowest = i if value < values[lowest] else lowest
        highest = i if value > values[highest] else highest
        if direction >= 0 and values[highest] - value > back:
            turns += [highest + 1] if direction or highest else []
            direction, lowest = -1, i
        elif direction <= 0 and value - values[lowest] > back:
            turns += [lowest + 1] if direction or lowest else []
            direction, highest = 1, i
    if len(turns) > max(3, values.size // 8):
        return np.zeros(values.size, dtype=np.int_)
    marks = np.full(values.size, direction, dtype=np.int_)
    for k, (begin, end) in enumerate(zip(turns[-2::-1], turns[:0:-1], strict=True), start=1):
        marks[begin:end] = direction * (-1) ** k
    return marks


def loop_cells(strain: Floats, edges: NDArray[np.int_]) -> NDArray[np.intp]:
    """Cell of equal strain of each sample, with at least 8 samples of an edge in each cell.

    Args:
        strain: strains. Shape `(N,)`.
        edges: from `rising_edges`. Shape `(N,)`.
    Returns:
        Number of the cell, from 0. Shape `(N,)`.
    """
    scarcer = min(int((edges > 0).sum()), int((edges < 0).sum())) or strain.size
    count = min(max(scarcer // 8, 3), _MOST_CELLS)
    borders = np.linspace(strain.min(), strain.max(), count + 1)[1:-1]
    return np.searchsorted(borders, strain, side="right")


def loop_width(strain: Floats, voltage_v: Floats, residuals: Floats) -> float:
    """Mean distance of the two branches at equal strain; 0 for a single branch.

    Args:
        strain: strains in order of time. Shape `(N,)`.
        voltage_v: gives the direction. Shape `(N,)`.
        residuals: distance of each sample from a common curve. Shape `(N,)`.
    Returns:
        Width, in the unit of `residuals`.
    """
    edges = rising_edges(voltage_v)
    cells = loop_cells(strain, edges)
    widths = []
    for cell in range(int(cells.max()) + 1):
        up, down = (residuals[(cells == cell) & (edges == way)] for way in (1, -1))
        if up.size and down.size:
            widths.append(abs(float(up.mean() - down.mean())))
    return float(np.mean(widths)) if widths else 0.0


def trend(x: Floats, y: Floats) -> int:
    """1 when `y` rises with `x`, -1 when it falls, 0 when the trend is not significant.

    Args:
        x: abscissa, in order of time. Shape `(N,)`.
        y: ordinate. Shape `(N,)`.
    Returns:
        Sign of the regression line, tested with the noise model of the residuals of a quadratic
        curve.
    """
    scaled = 2.0 * (x - x.min()) / np.ptp(x) - 1.0
    columns = legvander(scaled, min(_BENDS, x.size // 4))
    residuals = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    line = np.column_stack([scaled - scaled.mean(), np.ones_like(scaled)])
    slope = float(np.linalg.lstsq(line, y, rcond=None)[0][0])
    variance = float(coloured_covariance([line], [residuals], columns.shape[1])[0, 0])
    significant = slope**2 > ndtri(_UNRELATED_P / 2.0) ** 2 * variance
    return int(np.sign(slope)) if significant else 0
