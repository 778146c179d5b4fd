"""Neighbours of each point, and weights to predict its displacement and deformation."""

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
_LEAST_LEFT = 0.3  # smallest share of a point's own error left by a quadratic fit for an audit


@dataclass(frozen=True)
class Neighbourhood:
    """Fixed neighbours of each point in the reference; see `native/tracking/track_step.h`.

    Args:
        index: neighbours of each point, itself left out. Shape `(P, K)`.
        lever_px: point minus neighbour in the reference, in px. Shape `(P, K, 2)`.
        weights: displacement gradient from the neighbours' displacements relative to the
            point's own, in 1/px. Shape `(P, 2, K)`.
        smooth: value at the point of an affine least-squares fit through its own value and those
            of the neighbours, in this order. Shape `(P, K + 1)`.
        rough: residual weights of a quadratic and of an affine least-squares fit at the point, in
            the same order; zeros where there are too few neighbours. Shape `(P, 2, K + 1)`.
    """

    index: NDArray[np.int32]
    lever_px: Floats
    weights: Floats
    smooth: Floats
    rough: Floats

    @classmethod
    def none(cls, count: int) -> Neighbourhood:
        """Neighbourhood of `count` independent points."""
        index = np.zeros((count, 0), np.int32)
        alone = np.zeros((count, 1))
        nothing = np.zeros((count, 2, 1))
        return cls(index, np.zeros((count, 0, 2)), np.zeros((count, 2, 0)), alone, nothing)


def build_neighbourhood(points_px: Floats, exact_px: Floats | None = None) -> Neighbourhood:
    """Find the nearest neighbours of each point and the weights of a local affine fit.

    Args:
        points_px: middles of the subsets `[x, y]` in the reference, in px. Shape `(P, 2)`.
        exact_px: the points themselves, if they differ from the centres, in px. Shape `(P, 2)`.

    Returns:
        Up to 12 neighbours per point.

    Raises:
        InputError: fewer than 6 points, or some are collinear with all their neighbours.

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
            f"The model 'neighbours' needs at least {_FEWEST_POINTS} points, not {count}. "
            "Use 'translation' or 'affine', or more points."
        )
    kept = min(_NEIGHBOURS, count - 1)
    index = cKDTree(points_px).query(points_px, kept + 1)[1][:, 1:]
    lever = points_px[:, None, :] - points_px[index]
    spread = np.linalg.svd(lever, compute_uv=False)
    thin = ~(spread[:, 1] * _WORST_CONDITION > spread[:, 0])
    if thin.any():
        x, y = points_px[int(np.argmax(thin))]
        raise InputError(
            f"{int(thin.sum())} points are collinear with all their neighbours, the first at "
            f"({x:.1f}, {y:.1f}) px. Add points beside the line, or use 'translation'."
        )
    around = np.concatenate([np.zeros((count, 1, 2)), -lever], axis=1)
    design = np.concatenate([np.ones((count, kept + 1, 1)), around], axis=2)
    smooth = np.ascontiguousarray(np.linalg.pinv(design)[:, 0])
    weights = np.ascontiguousarray(np.linalg.pinv(-lever))
    exact = points_px if exact_px is None else exact_px
    rough = _roughness(exact[np.hstack([np.arange(count)[:, None], index])] - exact[:, None])
    return Neighbourhood(index.astype(np.int32), lever, weights, smooth, rough)


def _roughness(around: Floats) -> Floats:
    """Residual weights of a quadratic and an affine fit at the first of K + 1 points."""
    x, y = np.moveaxis(around / np.abs(around).max(), 2, 0)
    affine = np.stack([np.ones_like(x), x, y], axis=2)
    quadratic = np.concatenate([affine, np.stack([x * x, x * y, y * y], axis=2)], axis=2)
    left = np.stack([-np.linalg.pinv(design)[:, 0] for design in (quadratic, affine)], axis=1)
    left[:, :, 0] += 1.0
    left[left[:, 0, 0] < _LEAST_LEFT] = 0.0
    return np.ascontiguousarray(left)
