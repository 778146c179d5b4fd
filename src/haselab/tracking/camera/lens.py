"""Lens distortion: calibration with OpenCV from checkerboard images, and correction."""

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
        size_px: width and height of the images that it is valid for, in px.
        rms_px: rms residual of the corners, in px.

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
        """Distorted positions of points of an ideal image, in px. Any shape."""
        x, y = self._distorted(
            (x_px - self.centre_px[0]) / self.focal_px[0],
            (y_px - self.centre_px[1]) / self.focal_px[1],
        )
        return (
            self.focal_px[0] * x + self.centre_px[0],
            self.focal_px[1] * y + self.centre_px[1],
        )

    def undistort(self, x_px: Floats, y_px: Floats) -> tuple[Floats, Floats]:
        """Correct positions to those of an ideal lens of the same focal length.

        Args:
            x_px, y_px: positions in the image, in px; NaN stays NaN. Any shape.

        Returns:
            Both coordinates, corrected.

        Raises:
            ResultError: the distortion cannot be inverted at a point (too far outside).
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
                "The lens distortion cannot be inverted at a point far from the image centre. "
                "Calibrate with boards that reach into the corners."
            )
        return self.focal_px[0] * x + self.centre_px[0], self.focal_px[1] * y + self.centre_px[1]

    def magnification(self, x_px: Floats, y_px: Floats) -> tuple[Floats, Floats]:
        """Factors of `undistort` on standard deviations along x and y. Shape of the positions."""
        step = 0.5
        right, left = (self.undistort(x_px + d, y_px)[0] for d in (step, -step))
        down, up = (self.undistort(x_px, y_px + d)[1] for d in (step, -step))
        return np.abs(right - left) / (2 * step), np.abs(down - up) / (2 * step)


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise InputError(
            "Checkerboards need OpenCV, which is not installed. Run: pip install 'haselab[camera]'"
        ) from None


def find_checkerboard(image: NDArray[np.generic], columns: int, rows: int) -> Floats:
    """Find the inner corners of a checkerboard with sub-pixel accuracy, by OpenCV.

    Args:
        image: grey levels. Shape `(H, W)`.
        columns, rows: inner corners along either side (one fewer than squares).

    Returns:
        Corners `[x, y]`, row by row, in px. Shape `(rows, columns, 2)`.

    Raises:
        InputError: OpenCV is not installed, or fewer than 3 x 3 corners requested.
        ResultError: no such board in the image.

    Source: OpenCV, findChessboardCornersSB (Duda and Frese 2018).
    """
    cv = _opencv()
    if min(columns, rows) < 3:
        raise InputError(
            f"A board of {columns} x {rows} inner corners is too small; at least 3 x 3 are "
            "required."
        )
    grey = np.asarray(image)
    if grey.dtype != np.uint8:
        top = max(float(grey.max()), 1.0)
        grey = np.rint(grey * (255.0 / top)).astype(np.uint8)
    flags = cv.CALIB_CB_NORMALIZE_IMAGE | cv.CALIB_CB_ACCURACY | cv.CALIB_CB_EXHAUSTIVE
    found, corners = cv.findChessboardCornersSB(np.ascontiguousarray(grey), (columns, rows), flags)
    if not found:
        raise ResultError(
            f"No checkerboard with {columns} x {rows} inner corners was found in the image. Count "
            "the inner corners (one fewer than squares); show the whole board, sharp and evenly "
            "lit."
        )
    return np.asarray(corners, float).reshape(rows, columns, 2)


def calibrate_lens(boards_px: Sequence[Floats], size_px: tuple[int, int]) -> Lens:
    """Calibrate a lens from images of a checkerboard at several positions and tilts (OpenCV).

    Args:
        boards_px: inner corners of each image, each of shape `(R, C, 2)`, in px.
        size_px: width and height of the images, in px.

    Returns:
        The lens.

    Raises:
        InputError: OpenCV is not installed, or fewer than three images.
        ResultError: the corners do not fit the lens model.

    Source: Zhang 2000, as implemented in OpenCV's calibrateCamera.
    """
    cv = _opencv()
    if len(boards_px) < _FEWEST_PICTURES:
        raise InputError(
            f"A lens calibration needs at least {_FEWEST_PICTURES} images of the board at "
            f"different tilts, not {len(boards_px)}. Ten are better."
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
            f"The corners have an rms residual of {rms:.2f} px; it must be at most {_MOST_RMS_PX} "
            "px. Take sharp images of a flat board."
        )
    return Lens(
        focal_px=np.array([matrix[0, 0], matrix[1, 1]]),
        centre_px=np.array([matrix[0, 2], matrix[1, 2]]),
        coefficients=np.asarray(coefficients, float).reshape(-1)[:5],
        size_px=size_px,
        rms_px=float(rms),
    )
