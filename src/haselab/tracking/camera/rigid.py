"""Correction for rigid motion of camera or stand, measured by fixed points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from haselab.base import InputError
from haselab.tracking.options import Floats

__all__ = ["RigidMotion", "fit_rigid_motion"]


@dataclass(frozen=True)
class RigidMotion:
    """Rotation about a centre, then translation, in each of F frames.

    Args:
        centre_px: centre of the fixed points at rest `[x, y]`, in px. Shape `(2,)`.
        angle_rad: from x (right) to y (down), in rad. Shape `(F,)`.
        shift_px: of the centre, in px. Shape `(F, 2)`.
        angle_std_rad: standard deviation of the angle, in rad; 0 with one fixed point. `(F,)`.
        shift_std_px: of the shift along x and y, in px. Shape `(F, 2)`.
    """

    centre_px: Floats
    angle_rad: Floats
    shift_px: Floats
    angle_std_rad: Floats
    shift_std_px: Floats

    def undo(
        self, x_px: Floats, y_px: Floats, std_x_px: Floats, std_y_px: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Remove the rigid motion from positions, and add its uncertainty to their std.

        The uncertainty is added in full for the fixed points too, whose own noise the fit has
        partly absorbed; for them it is an upper bound.

        Args:
            x_px, y_px: positions, in px. Shape `(F, P)`.
            std_x_px, std_y_px: their standard deviations, in px.

        Returns:
            All four, corrected.
        """
        c, s = np.cos(self.angle_rad)[:, None], np.sin(self.angle_rad)[:, None]
        dx = x_px - self.centre_px[0] - self.shift_px[:, :1]
        dy = y_px - self.centre_px[1] - self.shift_px[:, 1:]
        back_x, back_y = c * dx + s * dy, c * dy - s * dx
        var_x = std_x_px**2 + self.shift_std_px[:, :1] ** 2
        var_y = std_y_px**2 + self.shift_std_px[:, 1:] ** 2
        turned = self.angle_std_rad[:, None] ** 2
        return (
            self.centre_px[0] + back_x,
            self.centre_px[1] + back_y,
            np.sqrt(c**2 * var_x + s**2 * var_y + turned * back_y**2),
            np.sqrt(s**2 * var_x + c**2 * var_y + turned * back_x**2),
        )


def _check(rest: Floats, x: Floats, y: Floats) -> None:
    if rest.ndim != 2 or rest.shape[1] != 2 or not len(rest):
        raise InputError(f"rest_px has shape {rest.shape}, expected (K, 2) with K >= 1.")
    if x.ndim != 2 or x.shape != y.shape or x.shape[1] != len(rest):
        raise InputError(
            f"The positions have shapes {x.shape} and {y.shape}, expected (F, {len(rest)}): one "
            "column for each fixed point."
        )


def fit_rigid_motion(
    rest_px: Floats, x_px: Floats, y_px: Floats, std_x_px: Floats, std_y_px: Floats
) -> RigidMotion:
    r"""Fit the rotation and translation of the fixed points from their rest positions.

    Least squares with the weight $w_k = 2/(\sigma_{x,k}^2 + \sigma_{y,k}^2)$ of each point:
    $\tan\theta = \sum w\,(a \times b) / \sum w\,(a \cdot b)$ of the centred positions at rest and
    in the frame, $\sigma_\theta^2 = 1/\sum w\,|a|^2$. One point gives the shift alone. A frame in
    which no point is found gives NaN.

    Args:
        rest_px: fixed points at rest `[x, y]`, in px. Shape `(K, 2)`.
        x_px, y_px: positions, in px; NaN where lost. Shape `(F, K)`.
        std_x_px, std_y_px: their standard deviations, in px. Shape `(F, K)`.

    Returns:
        The motion of each frame.

    Raises:
        InputError: inconsistent shapes.

    Source: Schönemann 1966 (orthogonal Procrustes), in the plane.

    Example:
        >>> rest = np.array([[0.0, 0.0], [100.0, 0.0]])
        >>> small = np.full((1, 2), 0.01)
        >>> motion = fit_rigid_motion(rest, rest[:, :1].T, rest[:, 1:].T + 2.0, small, small)
        >>> motion.shift_px.round(3).tolist(), motion.angle_rad.round(6).tolist()
        ([[0.0, 2.0]], [0.0])
    """
    rest = np.asarray(rest_px, float)
    x, y = np.asarray(x_px, float), np.asarray(y_px, float)
    _check(rest, x, y)
    found = np.isfinite(x) & np.isfinite(y)
    variance = 0.5 * (std_x_px**2 + std_y_px**2)
    weight = np.where(found, 1.0 / np.maximum(variance, 1e-12), 0.0)
    total = weight.sum(axis=1)
    share = weight / np.where(total > 0.0, total, np.nan)[:, None]
    x, y = np.where(found, x, 0.0), np.where(found, y, 0.0)
    place = share @ rest  # rest position of the found points' centre
    now = np.stack([(share * x).sum(axis=1), (share * y).sum(axis=1)], axis=1)
    ax, ay = rest[:, 0] - place[:, :1], rest[:, 1] - place[:, 1:]
    bx, by = x - now[:, :1], y - now[:, 1:]
    across = (weight * (ax * by - ay * bx)).sum(axis=1)
    along = (weight * (ax * bx + ay * by)).sum(axis=1)
    power = (weight * (ax**2 + ay**2)).sum(axis=1)
    has_angle = (found.sum(axis=1) > 1) & (power > 0.0)
    angle = np.where(has_angle, np.arctan2(across, along), 0.0)
    angle_std = np.where(has_angle, 1.0 / np.sqrt(np.where(has_angle, power, 1.0)), 0.0)
    centre = rest.mean(axis=0)
    lever = centre - place
    c, s = np.cos(angle), np.sin(angle)
    turned = np.stack([c * lever[:, 0] - s * lever[:, 1], s * lever[:, 0] + c * lever[:, 1]], 1)
    shift_var = (share**2 * np.where(found, variance, 0.0)).sum(axis=1)[:, None]
    shift_var = shift_var + (angle_std[:, None] * turned[:, ::-1]) ** 2
    return RigidMotion(
        centre_px=centre,
        angle_rad=np.where(total > 0.0, angle, np.nan),
        shift_px=now + turned - centre,
        angle_std_rad=angle_std,
        shift_std_px=np.sqrt(shift_var),
    )
