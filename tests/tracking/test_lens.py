"""Lens distortion; OpenCV is the oracle where it is installed."""

import sys

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.tracking.camera.lens import Lens, calibrate_lens, find_checkerboard
from haselab.tracking.camera.scale import scale_from_checkerboard

FOCAL, CENTRE = np.array([800.0, 810.0]), np.array([320.0, 235.0])
LENS = Lens(FOCAL, CENTRE, np.array([-0.2, 0.05, 1e-3, -5e-4, 0.01]), (640, 480), 0.0)


def grid():
    return np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7))


def test_distorting_what_was_undistorted_gives_the_picture_back():
    x, y = grid()
    again = LENS.distort(*LENS.undistort(x, y))
    # converged to 1e-12 of the focal length
    np.testing.assert_allclose(again, (x, y), atol=1e-8)


def test_positions_that_are_lost_stay_lost():
    x, y = LENS.undistort(np.array([10.0, np.nan]), np.array([10.0, np.nan]))
    assert np.isfinite([x[0], y[0]]).all()
    assert np.isnan([x[1], y[1]]).all()


def test_deviations_grow_as_positions_do():
    x, y = grid()
    grow_x, grow_y = LENS.magnification(x, y)
    tiny = 1e-3
    numeric = (LENS.undistort(x + tiny, y)[0] - LENS.undistort(x - tiny, y)[0]) / (2 * tiny)
    # central difference over 1 px: the third derivative of a distortion below 30 px is tiny
    np.testing.assert_allclose(grow_x, numeric, rtol=1e-4)
    assert (grow_y[[0, -1]] > 1.0).all()  # a barrel is pulled apart


def test_undistorted_positions_equal_those_of_opencv():
    cv2 = pytest.importorskip("cv2")
    x, y = grid()
    matrix = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1.0]])
    points = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    oracle = cv2.undistortPoints(points, matrix, LENS.coefficients, P=matrix, criteria=stop)
    mine = np.stack(LENS.undistort(x, y), axis=-1)
    np.testing.assert_allclose(mine.reshape(-1, 2), oracle.reshape(-1, 2), atol=1e-7)


def test_a_lens_is_found_again_from_exact_corners():
    cv2 = pytest.importorskip("cv2")
    rng, boards = np.random.default_rng(1), []
    u, v = np.meshgrid(np.arange(9.0), np.arange(6.0))
    flat = np.stack([u.ravel(), v.ravel(), np.zeros(54)], axis=1)
    for _ in range(10):
        turn = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        place = flat @ turn.T + [rng.uniform(-6, -2), rng.uniform(-4.5, -1.5), rng.uniform(12, 16)]
        ideal = place[:, :2] / place[:, 2:] * FOCAL + CENTRE
        boards.append(np.stack(LENS.distort(*ideal.T), axis=-1).reshape(6, 9, 2))
    found = calibrate_lens(boards, (640, 480))
    # single-precision corners: 3e-5 px
    np.testing.assert_allclose(found.focal_px, FOCAL, atol=1e-2)
    np.testing.assert_allclose(found.coefficients, LENS.coefficients, atol=1e-4)
    assert found.rms_px < 1e-3


def drawn_board(side, angle):
    """9 x 6 inner corners, each pixel the mean of 25 samples."""
    total, steps = np.zeros((480, 640)), (np.arange(5) + 0.5) / 5 - 0.5
    y, x = np.mgrid[:480, :640].astype(float)
    c, s = np.cos(angle), np.sin(angle)
    for dy in steps:
        for dx in steps:
            u = (c * (x + dx - 320) + s * (y + dy - 240)) / side + 5.0
            v = (c * (y + dy - 240) - s * (x + dx - 320)) / side + 3.5
            off = (u < 0) | (v < 0) | (u >= 10) | (v >= 7)
            total += np.where(off | ((np.floor(u) + np.floor(v)) % 2 == 0), 220, 40)
    return np.rint(total / 25).astype(np.uint8)


@pytest.mark.parametrize(("side", "angle"), [(30.0, 0.1), (24.3, -0.2)])
def test_the_scale_of_a_drawn_board_is_within_its_deviation(side, angle):
    pytest.importorskip("cv2")
    corners = find_checkerboard(drawn_board(side, angle), 9, 6)
    scale = scale_from_checkerboard(corners, 1e-3)
    assert abs(scale.value - 1e-3 / side) < 3 * scale.std


def test_a_picture_without_a_board_and_too_few_pictures_are_refused():
    pytest.importorskip("cv2")
    with pytest.raises(ResultError, match="No checkerboard with 9 x 6"):
        find_checkerboard(np.zeros((100, 100), np.uint8), 9, 6)
    with pytest.raises(InputError, match="at least 3 images"):
        calibrate_lens([np.zeros((6, 9, 2))], (640, 480))


def test_without_opencv_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)  # importing it fails from now on
    with pytest.raises(InputError, match=r"pip install 'haselab\[camera\]'"):
        find_checkerboard(np.zeros((100, 100), np.uint8), 9, 6)


def test_a_distortion_that_folds_the_picture_is_refused():
    folded = Lens(FOCAL, CENTRE, np.array([-3.0, 0.0, 0.0, 0.0, 0.0]), (640, 480), 0.0)
    with pytest.raises(ResultError, match="cannot be inverted"):
        folded.undistort(np.array([639.0]), np.array([479.0]))
