"""Subset templates that the native kernel compares each frame with."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter, spline_filter

from haselab.base import InputError
from haselab.tracking.camera.noise import NoiseLaw
from haselab.tracking.options import Floats, TrackOptions

__all__ = ["Subsets", "build_subsets", "descent_rows", "project_out"]

Singles = NDArray[np.float32]

_LANES = 16  # floats that the kernel processes at a time
_WORST_CONDITION = 1e4
_GAUSS_REACH = 4.0  # standard deviations at which the Gaussian is truncated
_LEAST_CURVATURE = 0.15  # of the mean; a round dot's rotation has 0.02 to 0.13 from noise alone


@dataclass(frozen=True)
class Subsets:
    """Templates of all points, with data for their uncertainty. N = side², S = N padded to 16.

    Args:
        shape: reference grey levels, mean removed, norm 1, padded with zeros. Shape `(P, S)`.
        gradient: their smoothed gradients along x and y, in 1/px. Shape `(P, 2, S)`.
        inverse: inverse of the Gauss-Newton matrix, in px. Shape `(P, M, M)`.
        place: distance of each sample from the centre along x and y, in px. Shape `(2, S)`.
        centres_px: integer centres of the subsets `[x, y]`, in px. Shape `(P, 2)`.
        offsets_px: the points minus their centres, in px. Shape `(P, 2)`.
        norm: root of the summed squared grey deviations. Shape `(P,)`.
        level: mean grey level. Shape `(P,)`.
        even: covariance of the displacement, times amplitude squared, from a pixel variance of 1.
            Shape `(P, 2, 2)`.
        shaped: the same from a pixel variance that follows `shape`. Shape `(P, 2, 2)`.
        residual_share: share of white noise in the weighted residual. Shape `(P,)`.
    """

    shape: Singles
    gradient: Singles
    inverse: Singles
    place: Singles
    centres_px: Floats
    offsets_px: Floats
    norm: Floats
    level: Floats
    even: Floats
    shaped: Floats
    residual_share: Floats

    @property
    def side(self) -> int:
        """Side of a subset, in px."""
        return math.isqrt(self.shape.shape[1])

    def covariance(self, amplitude: Floats, level: Floats, law: NoiseLaw) -> Floats:
        r"""Covariance of a displacement from the noise of one frame, in px². Shape `(P, 2, 2)`.

        $A^{-1}\,(\sum g g^T \sigma^2(w))\,A^{-T} / \alpha^2$ with $w = $ level $+\ \alpha f$.

        Args:
            amplitude: $\alpha$, the frame's gain times `norm`, in grey. Shape `(P,)`.
            level: mean grey level in the frame. Shape `(P,)`.
            law: the camera's noise law.
        """
        even = law.variance(level) / amplitude**2
        return np.asarray(
            even[:, None, None] * self.even + (law.slope / amplitude)[:, None, None] * self.shaped,
            float,
        )


def _windows(image: Floats, centres: Floats, side: int) -> Floats:
    """The square of `side` pixels around each centre, row by row. Shape `(P, side * side)`."""
    half = side // 2
    grid = np.arange(-half, half + 1)
    x, y = centres.astype(int).T
    rows = y[:, None, None] + grid[None, :, None]
    columns = x[:, None, None] + grid[None, None, :]
    return np.asarray(image[rows, columns].reshape(len(centres), -1), float)


def _derivatives(
    reference: Floats, centres: Floats, side: int, smoothing_px: float
) -> tuple[list[Floats], list[Floats]]:
    """Smoothed and exact spline derivatives of the reference along x and y, in the subsets.

    Computed in squares around the subsets, or over the whole frame if that has fewer pixels.
    """
    reach = 1 + int(_GAUSS_REACH * smoothing_px + 0.5)  # of both filters, px
    spline = np.pad(spline_filter(reference, order=3, mode="mirror"), reach, mode="reflect")
    wide = side + 2 * reach
    apart = len(centres) * wide**2 < spline.size
    inside = centres + reach
    planes = _windows(spline, inside, wide).reshape(-1, wide, wide) if apart else spline[None]
    smooth: list[Floats] = []
    sharp: list[Floats] = []
    for axis in (2, 1):
        exact = correlate1d(planes, [-0.5, 0.0, 0.5], axis=axis)
        exact = correlate1d(exact, [1 / 6, 4 / 6, 1 / 6], axis=3 - axis)
        soft = gaussian_filter(exact, (0.0, smoothing_px, smoothing_px), truncate=_GAUSS_REACH)
        for plane, parts in ((soft, smooth), (exact, sharp)):
            if apart:
                parts.append(plane[:, reach:-reach, reach:-reach].reshape(len(centres), -1))
            else:
                parts.append(_windows(plane[0], inside, side))
    return smooth, sharp


def descent_rows(gx: Floats, gy: Floats, side: int, unknowns: int) -> Floats:
    """Steepest-descent rows, (u, v) or (u, u_x, u_y, v, v_x, v_y). Shape `(P, M, N)`."""
    if unknowns == 2:
        return np.stack([gx, gy], axis=1)
    half = side // 2
    eta, xi = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1)
    return np.stack([gx, gx * xi, gx * eta, gy, gy * xi, gy * eta], axis=1)


def project_out(rows: Floats, shape: Floats) -> Floats:
    """Make rows orthogonal to 1 and to the shape (itself of mean 0 and norm 1)."""
    rows = rows - rows.mean(axis=2, keepdims=True)
    along = np.einsum("pmn,pn->pm", rows, shape)
    return np.asarray(rows - along[:, :, None] * shape[:, None, :])


def _without_tilt(rows: Floats, place: Floats, shape: Floats) -> Floats:
    """Make rows orthogonal to a brightness slope, as far as that differs from 1 and the shape."""
    tilts = project_out(np.broadcast_to(place, (len(rows), *place.shape)), shape)
    inner = tilts @ tilts.transpose(0, 2, 1)
    share = np.linalg.solve(inner, tilts @ rows.transpose(0, 2, 1))
    return np.asarray(rows - share.transpose(0, 2, 1) @ tilts)


def _check_inside(points: Floats, centres: Floats, side: int, shape: tuple[int, ...]) -> None:
    last = np.array([shape[1] - 1, shape[0] - 1]) - side // 2
    outside = ((centres < side // 2) | (centres > last)).any(axis=1)
    if outside.any():
        index = int(np.argmax(outside))
        x, y = points[index]
        raise InputError(
            f"Point {index} at ({x:.1f}, {y:.1f}) px is too close to the edge of the "
            f"{shape[1]} x {shape[0]} px frame for a subset of {side} px. It must be in "
            f"[{side // 2}, {last[0]}] x [{side // 2}, {last[1]}]. Move the point, or use a "
            "smaller subset."
        )


def _refuse_blank(points: Floats, condition: Floats) -> None:
    blank = ~(condition < _WORST_CONDITION)
    if blank.any():
        index = int(np.argmax(blank))
        x, y = points[index]
        raise InputError(
            f"{int(blank.sum())} of {len(points)} points cannot be tracked. The first, point "
            f"{index} at ({x:.1f}, {y:.1f}) px, has no texture in both directions (condition "
            f"{condition[index]:.1e}, at most {_WORST_CONDITION:.0e}). Move it onto a dot, or "
            "use a larger subset or fewer unknowns."
        )


def _translation_condition(hessian: Floats, norm: Floats) -> Floats:
    """Condition number of the two translations alone; infinite for a blank subset."""
    v = hessian.shape[1] // 2
    block = hessian[:, [[0, 0], [v, v]], [[0, v], [0, v]]]
    return np.where(norm > 0.0, np.linalg.cond(block), np.inf)


def _observable_inverse(gradient: Floats, hessian: Floats, side: int) -> Floats:
    """Inverse on the observable deformations of the subset, zero on the others.

    With two unknowns the plain inverse. With six, directions whose curvature (displacements in
    px, rms over the subset) is below 0.15 of the mean are not estimated: a round dot does not
    show its rotation, which would only follow the noise.
    """
    unknowns = hessian.shape[1]
    if unknowns == 2:
        return np.asarray(np.linalg.inv(hessian))
    reach = (side // 2) / np.sqrt(3.0)
    scale = np.array([1.0, 1.0 / reach, 1.0 / reach] * 2)
    curvature, axes = np.linalg.eigh(
        gradient @ gradient.transpose(0, 2, 1) * np.outer(scale, scale)
    )
    shown = curvature >= _LEAST_CURVATURE * curvature.mean(axis=1, keepdims=True)
    axes = scale[:, None] * axes
    inner = axes.transpose(0, 2, 1) @ hessian @ axes
    both = shown[:, :, None] & shown[:, None, :]
    inner = np.where(both, inner, np.eye(unknowns))
    partial = np.where(both, np.linalg.inv(inner), 0.0)
    return np.asarray(axes @ partial @ axes.transpose(0, 2, 1))


def _pad(rows: Floats) -> Singles:
    """Rows as single floats, padded with zeros to the kernel's lanes."""
    width = [(0, 0)] * (rows.ndim - 1) + [(0, -rows.shape[-1] % _LANES)]
    return np.ascontiguousarray(np.pad(rows, width), dtype=np.float32)


def build_subsets(reference: Floats, points_px: Floats, options: TrackOptions) -> Subsets:
    """Build templates around the points of a reference image.

    Args:
        reference: mean of the rest frames, in grey levels. Shape `(H, W)`.
        points_px: points `[x, y]` in the reference, in px. Shape `(P, 2)`.
        options: subset size, model, smoothing.

    Returns:
        The templates.

    Raises:
        InputError: a point is too close to the edge, or has no texture.

    Source: Baker and Matthews 2004 (inverse compositional), Bartoli 2008 (gain and offset
        projected out).

    Example:
        >>> image = np.random.default_rng(3).uniform(0, 200, (64, 64))
        >>> build_subsets(image, np.array([[30.2, 31.0]]), TrackOptions()).centres_px
        array([[30., 31.]])
    """
    side, unknowns = options.subset_px, 6 if options.model == "affine" else 2
    centres = np.rint(points_px)
    _check_inside(points_px, centres, side, reference.shape)
    grey = _windows(reference, centres, side)
    level = grey.mean(axis=1)
    norm = np.linalg.norm(grey - level[:, None], axis=1)
    scale = np.maximum(norm, 1e-12)[:, None]
    shape = (grey - level[:, None]) / scale
    smooth, exact = (
        [part / scale for part in parts]
        for parts in _derivatives(reference, centres, side, options.smoothing_px)
    )
    half = side // 2
    place = np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1).astype(float)
    slopes = np.stack(smooth, axis=1)
    if options.sloped_light:
        slopes = _without_tilt(slopes, place, shape)
    gx, gy = slopes[:, 0], slopes[:, 1]
    gradient = project_out(descent_rows(gx, gy, side, unknowns), shape)
    descent = descent_rows(exact[0], exact[1], side, unknowns)
    hessian = gradient @ descent.transpose(0, 2, 1)
    _refuse_blank(points_px, _translation_condition(hessian, norm))
    inverse = _observable_inverse(gradient, hessian, side)
    weight = gx**2 + gy**2
    weight /= weight.sum(axis=1, keepdims=True)
    leverage = np.einsum("pmn,pmk,pkn->pn", gradient, inverse, gradient) + shape**2
    offsets = points_px - centres
    solve = _point_rows(offsets, unknowns) @ inverse
    return Subsets(
        shape=_pad(shape),
        gradient=_pad(slopes),
        inverse=np.ascontiguousarray(inverse, dtype=np.float32),
        place=_pad(place),
        centres_px=centres,
        offsets_px=offsets,
        norm=norm,
        level=level,
        even=_sandwich(solve, gradient @ gradient.transpose(0, 2, 1)),
        shaped=_sandwich(solve, (gradient * shape[:, None, :]) @ gradient.transpose(0, 2, 1)),
        residual_share=1.0 - 1.0 / side**2 - (weight * leverage).sum(axis=1),
    )


def _sandwich(outer: Floats, inner: Floats) -> Floats:
    return np.asarray(outer @ inner @ outer.transpose(0, 2, 1))


def _point_rows(offsets: Floats, unknowns: int) -> Floats:
    """Matrix from the unknowns to the displacement of the point. `(P, 2, M)`."""
    count = len(offsets)
    if unknowns == 2:
        return np.broadcast_to(np.eye(2), (count, 2, 2))
    rows = np.zeros((count, 2, 6))
    rows[:, 0, 0] = rows[:, 1, 3] = 1.0
    rows[:, 0, 1:3] = rows[:, 1, 4:6] = offsets
    return rows
