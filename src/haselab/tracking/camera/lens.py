"""Lens distortion: calibrated by OpenCV on checkerboard pictures, taken out of positions."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.tracking.options import Floats

__all__ = ["Lens", "calibrate_lens", "find_checkerboard"]

_ITERATIONS = 30
_CONVERGED, _DIVERGED = 1e-12, 1e2  # in normalised units
_FEWEST_PICTURES = 3
_MOST_RMS_PX = 1.5


@dataclass(frozen=True)
class Lens:
    r"""A pinhole with radial and tangential distortion (Brown and Conrady, five coefficients).

    With $x = (u - c_x)/f_x$, $y = (v - c_y)/f_y$ undistorted and $r^2 = x^2 + y^2$:
    $x_d = x\,(1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2)$ and likewise y.

    Args:
        focal_px: $f_x, f_y$, in px. Shape `(2,)`.
        centre_px: $c_x, c_y$, in px. Shape `(2,)`.
        coefficients: $k_1, k_2, p_1, p_2, k_3$. Shape `(5,)`.
        size_px: width and height of the pictures that it holds for, in px.
        rms_px: scatter of the corners about the calibration, in px.

    Source: Brown 1966; the coefficients are in OpenCV's order.
    """

    focal_px: Floats
    centre_px: Floats
    coefficients: Floats
    size_px: tuple[int, int]
    rms_px: float

    def _distorted(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        k1, k2, p1, p2, k3 = self.coefficients
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def distort(self, x_px: Floats, y_px: Floats) -> tuple[Floats, Floats]:
        """Where the lens puts points of an ideal picture, in px. Any shape."""
        x, y = self._distorted(
            (x_px - self.centre_px[0]) / self.focal_px[0],
            (y_px - self.centre_px[1]) / self.focal_px[1],
        )
        return (
            self.focal_px[0] * x + self.centre_px[0],
            self.focal_px[1] * y + self.centre_px[1],
        )

    def undistort(self, x_px: Floats, y_px: Floats) -> tuple[Floats, Floats]:
        """Points as an ideal lens of the same focal length would show them.

        Args:
            x_px, y_px: positions in the picture, in px; NaN stays NaN. Any shape.

        Returns:
            Both, corrected.

        Raises:
            ResultError: the distortion cannot be undone at a point (too far outside).
        """
        xd = (x_px - self.centre_px[0]) / self.focal_px[0]
        yd = (y_px - self.centre_px[1]) / self.focal_px[1]
        x, y = xd.copy(), yd.copy()
        error = 0.0
        for _ in range(_ITERATIONS):
            there_x, there_y = self._distorted(x, y)
            step_x, step_y = xd - there_x, yd - there_y
            x, y = x + step_x, y + step_y
            error = float(np.nanmax(np.hypot(step_x, step_y), initial=0.0))
            if error < _CONVERGED or error > _DIVERGED:
                break
        if not error < 1e-7:
            raise ResultError(
                "the lens distortion cannot be undone at a point far from the picture's middle. "
                "Calibrate with boards that reach into the corners."
            )
        return self.focal_px[0] * x + self.centre_px[0], self.focal_px[1] * y + self.centre_px[1]

    def magnification(self, x_px: Floats, y_px: Floats) -> tuple[Floats, Floats]:
        """By how much deviations along x and y grow in `undistort`. The positions' shape."""
        step = 0.5
        right, left = (self.undistort(x_px + d, y_px)[0] for d in (step, -step))
        down, up = (self.undistort(x_px, y_px + d)[1] for d in (step, -step))
        return np.abs(right - left) / (2 * step), np.abs(down - up) / (2 * step)


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise InputError(
            "checkerboards need OpenCV, which is not installed. Type: pip install 'haselab[camera]'"
        ) from None


def find_checkerboard(image: NDArray[np.generic], columns: int, rows: int) -> Floats:
    """Inner corners of a checkerboard, to a part of a pixel, by OpenCV.

    Args:
        image: grey levels. Shape `(H, W)`.
        columns, rows: inner corners along either side (one fewer than squares).

    Returns:
        Corners `[x, y]`, row by row, in px. Shape `(rows, columns, 2)`.

    Raises:
        InputError: OpenCV is not installed, or fewer than 3 x 3 corners asked for.
        ResultError: no such board in the picture.

    Source: OpenCV, findChessboardCornersSB (Duda and Frese 2018).
    """
    cv = _opencv()
    if min(columns, rows) < 3:
        raise InputError(
            f"a board of {columns} x {rows} inner corners is too small; at least 3 x 3 are needed."
        )
    grey = np.asarray(image)
    if grey.dtype != np.uint8:
        top = max(float(grey.max()), 1.0)
        grey = np.rint(grey * (255.0 / top)).astype(np.uint8)
    flags = cv.CALIB_CB_NORMALIZE_IMAGE | cv.CALIB_CB_ACCURACY | cv.CALIB_CB_EXHAUSTIVE
    found, corners = cv.findChessboardCornersSB(np.ascontiguousarray(grey), (columns, rows), flags)
    if not found:
        raise ResultError(
            f"no checkerboard with {columns} x {rows} inner corners in the picture. Count the "
            "inner corners (one fewer than squares); show the whole board, sharp and evenly lit."
        )
    return np.asarray(corners, float).reshape(rows, columns, 2)


def calibrate_lens(boards_px: Sequence[Floats], size_px: tuple[int, int]) -> Lens:
    """A lens from pictures of one checkerboard in several places and tilts, by OpenCV.

    Args:
        boards_px: inner corners of each picture, each of shape `(R, C, 2)`, in px.
        size_px: width and height of the pictures, in px.

    Returns:
        The lens.

    Raises:
        InputError: OpenCV is not installed, or fewer than three pictures.
        ResultError: the corners do not fit a lens.

    Source: Zhang 2000, as OpenCV's calibrateCamera has it.
    """
    cv = _opencv()
    if len(boards_px) < _FEWEST_PICTURES:
        raise InputError(
            f"a lens needs at least {_FEWEST_PICTURES} pictures of the board, tilted differently; "
            f"got {len(boards_px)}. Ten are better."
        )
    rows, columns = boards_px[0].shape[:2]
    v, u = np.mgrid[:rows, :columns].astype(np.float32)
    board = np.stack([u.ravel(), v.ravel(), np.zeros(u.size, np.float32)], axis=1)
    corners = [np.asarray(b, np.float32).reshape(-1, 1, 2) for b in boards_px]
    rms, matrix, coefficients, *_ = cv.calibrateCamera(
        [board] * len(corners), corners, size_px, None, None
    )
    if not rms < _MOST_RMS_PX:
        raise ResultError(
            f"the corners lie {rms:.2f} px about the calibrated lens, allowed are {_MOST_RMS_PX} "
            "px. Take sharp pictures of a flat board."
        )
    return Lens(
        focal_px=np.array([matrix[0, 0], matrix[1, 1]]),
        centre_px=np.array([matrix[0, 2], matrix[1, 2]]),
        coefficients=np.asarray(coefficients, float).reshape(-1)[:5],
        size_px=size_px,
        rms_px=float(rms),
    )
