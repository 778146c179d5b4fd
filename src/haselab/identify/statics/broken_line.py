"""Best broken line on a grid of break points: exact, by dynamic programming over its value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["BreakGrid", "best_breaks"]

Floats = NDArray[np.float64]
_MOST_CANDIDATES = 64
_LEVELS = 48
_KEPT = 3


@dataclass(frozen=True)
class BreakGrid:
    """Places where the line may break, and the sums of squares between each two of them.

    Args:
        places: rising candidates; the first and the last are the ends of the record. Shape `(G,)`.
        counts: samples before each place; the last counts all. Shape `(G,)`.
        quadratics: cost of the straight segment from place i with value u to place j with value v,
            as `(uu, uv, vv, u, v, 1)` coefficients. Shape `(G, G, 6)`.
        levels: values between which the line may choose, for pruning. Shape `(V,)`.
    """

    places: Floats
    counts: NDArray[np.int_]
    quadratics: Floats
    levels: Floats

    @classmethod
    def of(cls, x: Floats, y: Floats) -> BreakGrid:
        """Grid for samples sorted by `x`. Shape `(N,)` each."""
        distinct = np.unique(x)
        parts = max(1, -(-_MOST_CANDIDATES // distinct.size))
        at = np.linspace(0.0, distinct.size - 1.0, min(_MOST_CANDIDATES, parts * distinct.size))
        places = np.interp(at, np.arange(distinct.size), distinct)
        counts = np.searchsorted(x, places, side="left")
        counts[-1] = x.size
        spread = float(np.ptp(y))
        levels = np.linspace(y.min() - 0.1 * spread, y.max() + 0.1 * spread, _LEVELS)
        return cls(places, counts, _quadratics(x, y, places, counts), levels)


def _quadratics(x: Floats, y: Floats, places: Floats, counts: NDArray[np.int_]) -> Floats:
    """Coefficients of all segments from running sums; the value goes linearly from u to v."""
    x, shift = x - places.mean(), places.mean()
    rows = np.stack([np.ones_like(x), x, x * x, y, x * y, y * y])
    running = np.concatenate([np.zeros((6, 1)), np.cumsum(rows, axis=1)], axis=1)[:, counts]
    n, sx, sxx, sy, sxy, syy = running[:, None, :] - running[:, :, None]
    start, end = (places - shift)[:, None], (places - shift)[None, :]
    length = np.where(end > start, end - start, 1.0)
    # Weights of u and v at a sample: (end - x)/length and (x - start)/length.
    uu = (end**2 * n - 2.0 * end * sx + sxx) / length**2
    vv = (sxx - 2.0 * start * sx + start**2 * n) / length**2
    uv = 2.0 * ((end + start) * sx - sxx - end * start * n) / length**2
    u = -2.0 * (end * sy - sxy) / length
    v = -2.0 * (sxy - start * sy) / length
    return np.stack([uu, uv, vv, u, v, syy], axis=-1)


def best_breaks(grid: BreakGrid, most: int, least: int) -> dict[int, list[Floats]]:
    """Inner break points of the best broken lines on the grid, for each number of segments.

    For each way to reach a place, the cost up to it is a quadratic function of the value there.
    Only functions that are lowest at some level are kept.

    Args:
        grid: candidates.
        most: largest number of straight segments.
        least: fewest samples in a segment.
    Returns:
        By number of segments, up to 3 sets of break points, the best first; a number is missing
        when no set leaves enough samples.
    Source: after Fearnhead, Maidstone and Letchford, J. Comput. Graph. Stat. 28 (2019), 265.
    """
    last = grid.places.size - 1
    reached = {0: (np.zeros((1, 3)), np.zeros((1, 0), dtype=np.int_))}
    answers = {}
    for pieces in range(1, most + 1):
        arrived = _extended(grid, reached, last, least)
        if arrived is not None:
            functions, paths = arrived
            kept = np.argsort(_lowest(functions), kind="stable")[:_KEPT]
            answers[pieces] = [grid.places[path[1:]] for path in paths[kept]]
        following = {}
        for end in range(1, last) if pieces < most else ():
            found = _extended(grid, reached, end, least)
            if found is not None:
                following[end] = _pruned(grid, *found)
        reached = following
    return answers


def _extended(
    grid: BreakGrid, reached: dict[int, tuple[Floats, NDArray[np.int_]]], end: int, least: int
) -> tuple[Floats, NDArray[np.int_]] | None:
    """Quadratic functions `(a, b, c)` of the value at `end`, and their break points so far."""
    functions, paths = [], []
    for start, (before, path) in reached.items():
        if start >= end or grid.counts[end] - grid.counts[start] < least:
            continue
        uu, uv, vv, u, v, one = grid.quadratics[start, end]
        square, linear, constant = before.T
        a, b = square + uu, linear + u
        safe = np.where(a > 0.0, a, 1.0)
        functions.append(
            np.column_stack(
                [vv - uv**2 / (4.0 * safe), v - uv * b / (2.0 * safe),
                 one + constant - b**2 / (4.0 * safe)]
            )
        )  # fmt: skip
        paths.append(np.column_stack([path, np.full(len(path), start)]))
    if not functions:
        return None
    return np.vstack(functions), np.vstack(paths)


def _lowest(functions: Floats) -> Floats:
    """Minimum of each quadratic function."""
    a, b, c = functions.T
    return np.asarray(c - np.where(a > 0.0, b**2 / (4.0 * np.where(a > 0.0, a, 1.0)), 0.0))


def _pruned(
    grid: BreakGrid, functions: Floats, paths: NDArray[np.int_]
) -> tuple[Floats, NDArray[np.int_]]:
    """Keep the functions that are lowest at some level."""
    powers = np.stack([grid.levels**2, grid.levels, np.ones(grid.levels.size)])
    kept = np.unique(np.argmin(functions @ powers, axis=0))
    return functions[kept], paths[kept]
