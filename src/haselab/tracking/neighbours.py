"""Who a point's neighbours are, and how their displacements tell its own and its deformation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from haselab.base import InputError
from haselab.tracking.options import Floats

__all__ = ["Neighbourhood", "build_neighbourhood"]

_NEIGHBOURS = 12
_FEWEST_POINTS = 6
_WORST_CONDITION = 30.0


@dataclass(frozen=True)
class Neighbourhood:
    """Fixed neighbours of each point in the reference; `native/track_step.h` says what they do.

    Args:
        index: neighbours of each point, itself left out. Shape `(P, K)`.
        lever_px: point less neighbour in the reference, in px. Shape `(P, K, 2)`.
        weights: displacement gradient from the neighbours' displacements relative to the
            point's own, in 1/px. Shape `(P, 2, K)`.
        smooth: value at the point of an affine least-squares fit through its own value and those
            of the neighbours, in this order. Shape `(P, K + 1)`.
    """

    index: NDArray[np.int32]
    lever_px: Floats
    weights: Floats
    smooth: Floats

    @classmethod
    def none(cls, count: int) -> Neighbourhood:
        """Each of `count` points for itself."""
        index = np.zeros((count, 0), np.int32)
        return cls(index, np.zeros((count, 0, 2)), np.zeros((count, 2, 0)), np.zeros((count, 1)))


def build_neighbourhood(points_px: Floats) -> Neighbourhood:
    """The nearest neighbours of each point and the weights of a local affine fit.

    Args:
        points_px: points `[x, y]` in the reference, in px. Shape `(P, 2)`.

    Returns:
        Up to 12 neighbours a point.

    Raises:
        InputError: fewer than 6 points, or some lie on a line with all their neighbours.

    Example:
        >>> grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), -1).reshape(-1, 2)
        >>> stretched = grid * [0.0, 0.1]
        >>> near = build_neighbourhood(grid)
        >>> float((near.weights[5] @ (stretched[near.index[5]] - stretched[5]))[1, 1].round(6))
        0.1
    """
    count = len(points_px)
    if count < _FEWEST_POINTS:
        raise InputError(
            f"the model 'neighbours' needs at least {_FEWEST_POINTS} points, got {count}. "
            "Take 'translation' or 'affine', or more points."
        )
    kept = min(_NEIGHBOURS, count - 1)
    index = cKDTree(points_px).query(points_px, kept + 1)[1][:, 1:]
    lever = points_px[:, None, :] - points_px[index]
    spread = np.linalg.svd(lever, compute_uv=False)
    thin = ~(spread[:, 1] * _WORST_CONDITION > spread[:, 0])
    if thin.any():
        x, y = points_px[int(np.argmax(thin))]
        raise InputError(
            f"{int(thin.sum())} points lie on a line with all their neighbours, the first at "
            f"({x:.1f}, {y:.1f}) px. Add points beside the line, or take 'translation'."
        )
    around = np.concatenate([np.zeros((count, 1, 2)), -lever], axis=1)
    design = np.concatenate([np.ones((count, kept + 1, 1)), around], axis=2)
    smooth = np.ascontiguousarray(np.linalg.pinv(design)[:, 0])
    weights = np.ascontiguousarray(np.linalg.pinv(-lever))
    return Neighbourhood(index.astype(np.int32), lever, weights, smooth)
