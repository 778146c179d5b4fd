"""From displacements to strain: gauge, field and homogeneity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from haselab.base import InputError, ResultError
from haselab.tracking.options import Floats
from haselab.tracking.tracks import Tracks

__all__ = [
    "GaugeStrain",
    "Homogeneity",
    "StrainField",
    "gauge_strain",
    "homogeneity",
    "strain_field",
]

_WORST_CONDITION = 30.0
_MOST_WEIGHT = 2.0  # largest weight of a mark in its group's mean
_MOST_TILT = 0.02  # largest tilt of the line between the valid marks relative to the gauge


@dataclass(frozen=True)
class GaugeStrain:
    """Strain of the length between two groups of points.

    Args:
        strain: engineering strain, positive in elongation; NaN where the valid marks are not
            along the gauge. Shape `(F,)`.
        std: its standard deviation. Shape `(F,)`.
        length_px: gauge length, in px. Shape `(F,)`.
        rest_length_px: gauge length of all marks at rest, in px.
        upper_marks, lower_marks: number of valid marks of each group. Shape `(F,)`.
    """

    strain: Floats
    std: Floats
    length_px: Floats
    rest_length_px: float
    upper_marks: NDArray[np.intp]
    lower_marks: NDArray[np.intp]


def _mark_weights(across: Floats, is_lower: NDArray[np.bool_]) -> Floats:
    """Weights of the valid marks; they add up to 1 in each group.

    These are the smallest weights that align the weighted means of both groups across the
    gauge, so that narrowing or shear does not count as strain. Plain means are used if no such
    weights exist, or where they would extrapolate far.
    """
    plain = np.where(is_lower, 1.0 / is_lower.sum(), 1.0 / (~is_lower).sum())
    conditions = np.stack([~is_lower, is_lower, np.where(is_lower, across, -across)])
    scale = max(float(np.abs(across).max()), 1.0)
    conditions[2] /= scale
    weights = np.linalg.lstsq(conditions.astype(float), np.array([1.0, 1.0, 0.0]), rcond=None)[0]
    met = abs(conditions[2] @ weights) * scale < 1e-6
    return np.asarray(weights if met and np.abs(weights).max() <= _MOST_WEIGHT else plain)


def gauge_strain(
    tracks: Tracks, rest_px: Floats, upper: NDArray[np.intp], lower: NDArray[np.intp]
) -> GaugeStrain:
    r"""Compute the engineering strain between the means of two groups of points.

    $\varepsilon = |\bar c_l - \bar c_u| / L_0 - 1$. Where marks are not valid, both lengths are
    those of the remaining marks, weighted so that the line between the groups keeps its direction
    at rest. If no weights do that and the line is tilted by more than 0.02, the strain is NaN.

    Args:
        tracks: points through the clip.
        rest_px: their positions at rest `[x, y]`, in px (the points given to the tracker).
            Shape `(P, 2)`.
        upper, lower: indices of the points of each group.

    Returns:
        Strain with its standard deviation in every frame. The part of the std that comes
        from the reference is common to all frames.

    Raises:
        InputError: a group is empty, or both have the same mean position.
        ResultError: in some frame no point of a group is valid.

    Source: reference study, section on strain from video (three points at the clamp).

    Example:
        >>> rest = np.array([[10.0, 0.0], [10.0, 100.0]])
        >>> one = np.ones((1, 2))
        >>> moved = Tracks(10 * one, np.array([[0.0, 104.0]]), 0.02 * one, 0.02 * one, one, one > 0)
        >>> gauge_strain(moved, rest, np.array([0]), np.array([1])).strain
        array([0.04])
    """
    upper, lower = np.atleast_1d(upper), np.atleast_1d(lower)
    if not upper.size or not lower.size:
        raise InputError("A gauge needs at least one point in each group, but one is empty.")
    between = rest_px[lower].mean(axis=0) - rest_px[upper].mean(axis=0)
    rest_length = float(np.hypot(*between))
    if rest_length == 0.0:
        raise InputError("Both groups of the gauge have the same mean position. Choose two rows.")
    axis = between / rest_length
    marks = np.concatenate([upper, lower])
    is_lower = np.arange(len(marks)) >= upper.size
    seen = tracks.valid[:, marks]
    counts = np.stack([seen[:, ~is_lower].sum(axis=1), seen[:, is_lower].sum(axis=1)])
    if not counts.all():
        frame = int(np.argmin(counts.all(axis=0)))
        raise ResultError(
            f"No point of a gauge group is valid in frame {frame}. Add points, or raise search_px."
        )
    across = (rest_px[marks] - rest_px[upper].mean(axis=0)) @ [-axis[1], axis[0]]
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    weights = np.zeros(patterns.shape)
    for row, pattern in zip(weights, patterns, strict=True):
        row[pattern] = _mark_weights(across[pattern], is_lower[pattern])
    signed = np.where(is_lower, weights, -weights)
    rest = signed @ rest_px[marks]  # (patterns, 2)
    own = np.hypot(*rest.T)
    tilt = np.abs(rest @ [-axis[1], axis[0]]) > _MOST_TILT * np.abs(rest @ axis)
    signed, own, tilted = signed[which.ravel()], own[which.ravel()], tilt[which.ravel()]
    where = np.stack([tracks.x_px[:, marks], tracks.y_px[:, marks]], axis=2)
    now = np.einsum("fp,fpk->fk", signed, np.where(seen[:, :, None], where, 0.0))
    spread = np.stack([tracks.std_x_px[:, marks], tracks.std_y_px[:, marks]], axis=2)
    variance = np.where(seen, ((axis * spread) ** 2).sum(axis=2), 0.0)
    std = np.sqrt((signed**2 * variance).sum(axis=1)) / np.where(tilted, np.nan, own)
    strain = np.linalg.norm(now, axis=1) / np.where(tilted, np.nan, own) - 1.0
    return GaugeStrain(strain, std, (1.0 + strain) * rest_length, rest_length, counts[0], counts[1])


@dataclass(frozen=True)
class StrainField:
    """Strain at points, by local least squares.

    Args:
        gradient: displacement gradient $H$, row = component, column = direction. `(P, 2, 2)`.
        engineering: small strain $(H + H^T)/2$. Shape `(P, 2, 2)`.
        green_lagrange: $(H + H^T + H^T H)/2$. Shape `(P, 2, 2)`.
        std: standard deviation of `gradient`. Shape `(P, 2, 2)`.
        valid: points with enough valid neighbours around them. Shape `(P,)`.
    """

    gradient: Floats
    engineering: Floats
    green_lagrange: Floats
    std: Floats
    valid: NDArray[np.bool_]


def _local_fit(lever: Floats, moved: Floats, std: Floats) -> tuple[Floats, Floats] | None:
    """Displacement gradient and its std from one neighbourhood; `None` if it is a line."""
    design = np.column_stack([np.ones(len(lever)), lever])
    spread = np.linalg.svd(lever - lever.mean(axis=0), compute_uv=False)
    if len(lever) < 3 or spread[1] * _WORST_CONDITION < spread[0]:
        return None
    inverse = np.linalg.pinv(design)[1:]
    return (inverse @ moved).T, np.sqrt((inverse**2) @ std**2).T


def strain_field(
    rest_px: Floats, displacement_px: Floats, std_px: Floats, *, neighbours: int = 12
) -> StrainField:
    """Compute the strain at each point from an affine fit to it and its nearest valid neighbours.

    Args:
        rest_px: positions at rest `[x, y]`, in px. Shape `(P, 2)`.
        displacement_px: displacements in one frame, NaN where lost. Shape `(P, 2)`.
        std_px: their standard deviations. Shape `(P, 2)`.
        neighbours: number of neighbours; more smooth the field and reduce its std.

    Returns:
        The field; NaN where the neighbours are collinear or too few.

    Raises:
        InputError: fewer than 3 valid points, or `neighbours` below 2.

    Source: Pan, Xie, Guo and Hua 2007 (point-wise least squares).

    Example:
        >>> grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
        >>> field = strain_field(grid, grid * [-0.02, 0.05], np.full(grid.shape, 0.001))
        >>> field.engineering[12].round(6)
        array([[-0.02,  0.  ],
               [ 0.  ,  0.05]])
    """
    good = np.isfinite(displacement_px).all(axis=1)
    if good.sum() < 3 or neighbours < 2:
        raise InputError(
            f"A strain field needs 3 valid points and 2 neighbours, not {int(good.sum())} and "
            f"{neighbours}. Track more points."
        )
    found = np.flatnonzero(good)
    kept = min(neighbours + 1, len(found))
    near = found[cKDTree(rest_px[good]).query(rest_px, kept)[1]]
    gradient = np.full((len(rest_px), 2, 2), np.nan)
    std = gradient.copy()
    for point, around in enumerate(near):
        fit = _local_fit(rest_px[around] - rest_px[point], displacement_px[around], std_px[around])
        if fit is not None:
            gradient[point], std[point] = fit
    turned = gradient.transpose(0, 2, 1)
    small = 0.5 * (gradient + turned)
    return StrainField(
        gradient=gradient,
        engineering=small,
        green_lagrange=small + 0.5 * turned @ gradient,
        std=std,
        valid=np.isfinite(gradient).all(axis=(1, 2)),
    )


@dataclass(frozen=True)
class Homogeneity:
    r"""Homogeneity of the stretch along the length, and lateral motion.

    Args:
        height_px: middle of each band along the length, in px. Shape `(B,)`.
        strain: longitudinal strain of each band. Shape `(B,)`.
        strain_std: standard deviation of it. Shape `(B,)`.
        mean_strain: strain of the whole length (slope of displacement against position).
        unevenness: scatter of the bands' strain beyond their standard deviations, over the mean
            strain.
        offset_px: distance of each band of points from the mid-line, in px. Shape `(B,)`.
        lateral_px: mean motion away from the mid-line of each band, in px. Shape `(B,)`.
        lateral_slope: motion away from the mid-line for each px of distance; negative where the
            sheet narrows.
    """

    height_px: Floats
    strain: Floats
    strain_std: Floats
    mean_strain: float
    unevenness: float
    offset_px: Floats
    lateral_px: Floats
    lateral_slope: float


def _line(x: Floats, y: Floats, std: Floats) -> tuple[float, float]:
    """Slope of a weighted straight line, and its standard deviation."""
    weight = 1.0 / np.maximum(std, 1e-9) ** 2
    centred = x - np.average(x, weights=weight)
    power = float(np.sum(weight * centred**2))
    return float(np.sum(weight * centred * y) / power), power**-0.5


def homogeneity(
    rest_px: Floats, displacement_px: Floats, std_px: Floats, *, bands: int = 6
) -> Homogeneity:
    """Compute the stretch in bands along the length (y), and the motion from the mid-line (x).

    Args:
        rest_px: positions at rest `[x, y]`, in px. Shape `(P, 2)`.
        displacement_px: displacements in one frame, NaN where lost. Shape `(P, 2)`.
        std_px: their standard deviations. Shape `(P, 2)`.
        bands: bands of equal numbers of points.

    Returns:
        Both profiles.

    Raises:
        InputError: fewer than 4 valid points for each band.

    Source: reference study, fig. 2.

    Example:
        >>> grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(12.0)), -1).reshape(-1, 2)
        >>> even = homogeneity(grid, grid * [0.0, 0.05], np.full(grid.shape, 0.001), bands=3)
        >>> round(even.mean_strain, 6), round(even.unevenness, 6)
        (0.05, 0.0)
    """
    good = np.isfinite(displacement_px).all(axis=1)
    place, moved, std = rest_px[good], displacement_px[good], std_px[good]
    if bands < 1 or len(place) < 4 * bands:
        raise InputError(
            f"{bands} bands need at least {4 * bands} valid points, not {len(place)}. Use fewer "
            "bands or more points."
        )
    mean_strain, _ = _line(place[:, 1], moved[:, 1], std[:, 1])
    parts = np.array_split(np.argsort(place[:, 1], kind="stable"), bands)
    slope, slope_std = np.array([_line(place[p, 1], moved[p, 1], std[p, 1]) for p in parts]).T
    excess = float(np.var(slope) - np.mean(slope_std**2))
    distance = place[:, 0] - 0.5 * (place[:, 0].min() + place[:, 0].max())
    outward = np.sign(distance) * (moved[:, 0] - np.median(moved[:, 0]))
    sides = np.array_split(np.argsort(np.abs(distance), kind="stable"), bands)
    return Homogeneity(
        height_px=np.array([place[p, 1].mean() for p in parts]),
        strain=slope,
        strain_std=slope_std,
        mean_strain=mean_strain,
        unevenness=float(np.sqrt(max(excess, 0.0)) / max(abs(mean_strain), 1e-12)),
        offset_px=np.array([np.abs(distance[p]).mean() for p in sides]),
        lateral_px=np.array([outward[p].mean() for p in sides]),
        lateral_slope=_line(distance, moved[:, 0], std[:, 0])[0],
    )
