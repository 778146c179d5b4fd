"""What the neighbours' displacements say about a point: deformation, and where it must be."""

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
    """Fixed neighbours of each point in the reference.

    Args:
        index: neighbours of each point, itself left out. Shape `(P, K)`.
        lever_px: point less neighbour in the reference, in px. Shape `(P, K, 2)`.
        weights: displacement gradient from the neighbours' displacements relative to the
            point's own, in 1/px. Shape `(P, 2, K)`.
    """

    index: NDArray[np.intp]
    lever_px: Floats
    weights: Floats

    def gradient(
        self, displacement_px: Floats, good: NDArray[np.bool_], otherwise: Floats
    ) -> Floats:
        """Displacement gradient $\\partial u_i / \\partial x_j$ at each point, least squares.

        Args:
            displacement_px: displacement of each point, in px. Shape `(P, 2)`.
            good: which points may be believed. Shape `(P,)`.
            otherwise: gradients where too few neighbours are good. Shape `(P, 2, 2)`.

        Returns:
            Dimensionless. Shape `(P, 2, 2)`, row = component, column = direction.
        """
        relative = displacement_px[self.index] - displacement_px[:, None, :]
        full = np.asarray((self.weights @ relative).transpose(0, 2, 1))
        partial = np.flatnonzero(~(good & good[self.index].all(axis=1)))
        if partial.size:
            full[partial] = self._partial_gradient(
                partial, displacement_px, good, otherwise[partial]
            )
        return full

    def _partial_gradient(
        self,
        points: NDArray[np.intp],
        displacement_px: Floats,
        good: NDArray[np.bool_],
        otherwise: Floats,
    ) -> Floats:
        """The same of some points, from their good neighbours alone."""
        index, weight = self.index[points], good[self.index[points]][:, :, None].astype(float)
        count = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
        lever = -self.lever_px[points]
        lever = weight * (lever - (weight * lever).sum(axis=1, keepdims=True) / count)
        moved = np.where(weight > 0.0, displacement_px[index], 0.0)
        spread = np.linalg.svd(lever, compute_uv=False)
        enough = (count[:, 0, 0] >= 3) & (spread[:, 1] * _WORST_CONDITION > spread[:, 0])
        out = otherwise.copy()
        out[enough] = (np.linalg.pinv(lever[enough]) @ moved[enough]).transpose(0, 2, 1)
        return out

    def predict(self, displacement_px: Floats, gradient: Floats, good: NDArray[np.bool_]) -> Floats:
        """Displacement of each point by the median of its good neighbours' extrapolations.

        The median does not follow a few neighbours that jumped to a wrong dot.

        Args:
            displacement_px: displacement of each point, in px. Shape `(P, 2)`.
            gradient: displacement gradient at each point. Shape `(P, 2, 2)`.
            good: which points may be believed. Shape `(P,)`.

        Returns:
            In px; NaN where fewer than 3 neighbours are good. Shape `(P, 2)`.
        """
        shift = self.lever_px @ gradient.transpose(0, 2, 1)
        guesses = displacement_px[self.index] + shift
        if good.all():
            return np.asarray(np.median(guesses, axis=1))
        counts = good[self.index]
        enough = counts.sum(axis=1) >= 3
        guesses[~counts] = np.nan
        out = np.full_like(displacement_px, np.nan)
        out[enough] = np.nanmedian(guesses[enough], axis=1)
        return out


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
        >>> near, everyone = build_neighbourhood(grid), np.ones(16, bool)
        >>> gradient = near.gradient(stretched, everyone, np.zeros((16, 2, 2)))
        >>> float(gradient[5, 1, 1].round(6))
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
    return Neighbourhood(index, lever, np.linalg.pinv(-lever))
