r"""Sum of two exponentials by separable least squares, well-conditioned where the two rates meet.

$V = e^{\mu x}(c \cosh \delta x + s \sinh(\delta x)/\delta)$ over $x$ from -1 to 1: the searched
parameters are the mean rate $\mu$ and $\delta^2$, the factors are $c$ and $s$.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.identify.projection import Basis, Solution, minimise, project

__all__ = [
    "coefficients",
    "is_steep",
    "least_split_reached",
    "search_free",
    "search_monotone",
    "shapes_at",
]

Floats = NDArray[np.float64]
_MOST_RATE = 10.0  # of either exponential: e-folds per half span
_LEAST_SPLIT = 0.05  # half the difference of the two rates: below it the rates count as equal
_LEAST_SLOPE = 1e-3  # of a monotone curve, relative to the mean slope of the record
_GROUPS = 300
_STARTS, _APART = 6, 1.5
_LOW = np.array([-_MOST_RATE, _LEAST_SPLIT**2])
_HIGH = np.array([_MOST_RATE, _MOST_RATE**2])


def shapes_at(search: Floats, x: Floats) -> tuple[Floats, Floats]:
    """The two functions and their derivatives with respect to the searched parameters.

    Args:
        search: mean rate and square of the split. Shape `(2,)`.
        x: abscissa. Shape `(M,)`.
    Returns:
        Functions `(M, 2)` and derivatives `(2, M, 2)`.
    """
    mean, square = search
    split = math.sqrt(square)
    growth = np.exp(mean * x)
    even, odd = growth * np.cosh(split * x), growth * np.sinh(split * x) / split
    shapes = np.column_stack([even, odd])
    by_square = np.column_stack([0.5 * x * odd, (x * even - odd) / (2.0 * square)])
    return shapes, np.stack([x[:, None] * shapes, by_square])


def coefficients(numbers: Floats, middle: float, half: float) -> tuple[Floats, Floats]:
    """Amplitudes and rates as functions of strain, `a1, b1, a2, b2` with `b1 > b2`.

    Args:
        numbers: mean rate, square of the split, both factors. Shape `(4,)`.
        middle: strain at `x = 0`.
        half: strain per unit of `x`.
    Returns:
        Coefficients `(4,)` and their derivatives with respect to `numbers` `(4, 4)`.
    """
    mean, square, c, s = numbers
    split = math.sqrt(square)
    shift = middle / half
    values, rows = [], []
    for sign in (1.0, -1.0):
        rate = mean + sign * split
        by_rate = np.array([1.0, sign / (2.0 * split), 0.0, 0.0])
        size = 0.5 * (c + sign * s / split)
        by_size = np.array([0.0, -sign * s / (4.0 * split**3), 0.5, 0.5 * sign / split])
        factor = math.exp(-rate * shift)
        values += [size * factor, rate / half]
        rows += [factor * (by_size - size * shift * by_rate), by_rate / half]
    return np.array(values), np.array(rows)


def least_split_reached(search: Floats) -> bool:
    """Whether the two rates came as close as the search allows."""
    return bool(search[1] <= 1.05 * _LEAST_SPLIT**2)


def search_free(x: Floats, v: Floats) -> Solution:
    """Least squares without a monotonicity limit, started from a grid of both rates.

    Args:
        x: abscissa from -1 to 1. Shape `(N,)`.
        v: ordinate. Shape `(N,)`.
    Returns:
        The best solution found from several different starts.
    """
    few = _grouped(x, v)
    starts = sorted((project(at, _bases(*few, at)) for at in _grid()), key=lambda s: s.cost)
    apart: list[Solution] = []
    for start in starts:
        if all(_distance(start, other) > _APART for other in apart):
            apart.append(start)
        if len(apart) == _STARTS:
            break
    polished = [_polished(start.search, *few) for start in apart]
    return _polished(min(polished, key=lambda s: s.cost).search, x, v)


def _distance(one: Solution, other: Solution) -> float:
    """The larger of two differences: of the mean rates and of the splits."""
    by_mean = abs(one.search[0] - other.search[0])
    return float(max(by_mean, abs(math.sqrt(one.search[1]) - math.sqrt(other.search[1]))))


def _polished(start: Floats, x: Floats, v: Floats) -> Solution:
    """Local minimum; on the bound of the smallest split when it lies there."""
    found = minimise(lambda at: _bases(x, v, at), start, (_LOW, _HIGH), iterations=200)[0]
    if not least_split_reached(found.search):
        return found
    edge = (np.array([_LOW[0], _LOW[1]]), np.array([_HIGH[0], _LOW[1]]))
    begun = np.array([found.search[0], _LOW[1]])

    def along(at: Floats) -> list[Basis]:
        basis = _bases(x, v, at)[0]
        fixed = basis.by_search.copy()
        fixed[1] = 0.0
        return [Basis(v, basis.shared, basis.own, fixed, basis.known, basis.known_by_search)]

    rested = minimise(along, begun, edge, iterations=200)[0]
    return project(rested.search, _bases(x, v, rested.search))


def _bases(x: Floats, v: Floats, search: Floats) -> list[Basis]:
    shapes, slopes = shapes_at(search, x)
    none = np.zeros((x.size, 0))
    return [Basis(v, shapes, none, slopes, np.zeros(x.size), np.zeros((2, x.size)))]


def _grid() -> list[Floats]:
    """Starting mean rates and splits for which both rates are within the range."""
    splits = (_LEAST_SPLIT, 0.5, 1.0, 2.0, 3.0, 4.5, 6.5)
    pairs = [(m, s) for m in np.linspace(-8.0, 8.0, 33) for s in splits]
    return [np.array([m, s**2]) for m, s in pairs if abs(m) + s <= _MOST_RATE]


def _grouped(x: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Means of neighbours in `x`, few enough to try many starting points."""
    groups = np.array_split(np.argsort(x, kind="stable"), min(_GROUPS, x.size))
    return np.array([x[g].mean() for g in groups]), np.array([v[g].mean() for g in groups])


def _end_slopes(search: Floats, sign: int, reach: float) -> Floats:
    """Slopes of the functions at both ends of the range, times `sign`. Shape `(2, 2)`."""
    mean, square = search
    even, odd = shapes_at(search, np.array([-reach, reach]))[0].T
    return sign * np.column_stack([mean * even + square * odd, mean * odd + even])


def _least_slope(v: Floats) -> float:
    return _LEAST_SLOPE * 0.5 * float(np.ptp(v))


def is_steep(solution: Solution, v: Floats, sign: int, reach: float) -> bool:
    """Whether the curve has at least the minimum slope within `reach`; checked at both ends."""
    slopes = _end_slopes(solution.search, sign, reach) @ solution.shared
    return bool((slopes >= _least_slope(v)).all())


def search_monotone(x: Floats, v: Floats, sign: int, reach: float) -> Solution:
    """Least squares among the curves with at least the minimum slope for all `x` within `reach`.

    Args:
        x: abscissa from -1 to 1. Shape `(N,)`.
        v: ordinate. Shape `(N,)`.
        sign: 1 for a curve that rises, -1 for one that falls.
        reach: end of the range, on both sides.
    Returns:
        The solution; its `columns` are those of the unconstrained problem.
    Source: Nelder and Mead, Comput. J. 7 (1965), 308, for the two rates.
    """

    def cost(at: Floats, px: Floats, pv: Floats) -> float:
        if not ((at >= _LOW) & (at <= _HIGH)).all():
            return math.inf
        error = pv - shapes_at(at, px)[0] @ _held_factors(at, px, pv, sign, reach)
        return float(error @ error)

    few = _grouped(x, v)
    start = min(_grid(), key=lambda at: cost(at, *few))
    for points in (few, (x, v)):
        options = {"xatol": 1e-5, "fatol": 1e-10 * float(v @ v), "maxfev": 400}
        start = minimize(cost, start, args=points, method="Nelder-Mead", options=options).x
    shapes, slopes = shapes_at(start, x)
    factors = _held_factors(start, x, v, sign, reach)
    error = v - shapes @ factors
    columns = np.hstack([(slopes @ factors).T, shapes])
    return Solution(start, factors, (np.zeros(0),), (error,), (columns,), float(error @ error))


def _held_factors(at: Floats, x: Floats, v: Floats, sign: int, reach: float) -> Floats:
    """Best factors whose curve has at least the minimum slope at both ends.

    The problem is convex: at the optimum neither limit, one of them or both are active.
    """
    shapes = shapes_at(at, x)[0]
    ends, least = _end_slopes(at, sign, reach), _least_slope(v)
    candidates = [np.asarray(np.linalg.lstsq(shapes, v, rcond=None)[0], dtype=np.float64)]
    for row in ends:
        size = float(row @ row)
        given, along = row * least / size, np.array([-row[1], row[0]]) / math.sqrt(size)
        column = shapes @ along
        candidates.append(given + along * (column @ (v - shapes @ given)) / (column @ column))
    corner = np.linalg.lstsq(ends, np.full(2, least), rcond=None)[0]
    candidates.append(np.asarray(corner, dtype=np.float64))
    kept = [f for f in candidates if (ends @ f >= (1.0 - 1e-6) * least).all()]
    return min(kept or candidates[-1:], key=lambda f: float(((v - shapes @ f) ** 2).sum()))
