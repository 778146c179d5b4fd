"""Metres per pixel from what is in the picture."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.tracking.camera.scale import (
    scale_from_checkerboard,
    scale_from_points,
    scale_from_ruler,
)


def ruler(period, angle, noise, seed=1, shape=(300, 400), duty=0.3):
    """Dark ticks of part of a period, seen by square pixels (box-averaged along x), with noise."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    place = x * np.cos(angle) + y * np.sin(angle)
    # integral of the comb, so that a pixel's mean along the line is exact for angle 0
    whole = lambda s: np.floor(s / period) * duty * period + np.minimum(s % period, duty * period)  # noqa: E731
    dark = whole(place + 0.5 + 1e4 * period) - whole(place - 0.5 + 1e4 * period)
    clean = 200.0 - 120.0 * dark
    grey = clean + noise * np.random.default_rng(seed).standard_normal(shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def test_two_points_give_the_scale_with_the_error_of_whole_pixels():
    rng, true = np.random.default_rng(3), np.array([[12.3, 40.8], [352.7, 210.4]])
    length = 0.08
    draws = np.rint(true + rng.uniform(-0.5, 0.5, (4000, 2, 2)))  # the cursor lands anywhere near
    spread = np.hypot(*(draws[:, 1] - draws[:, 0]).T).std()
    scale = scale_from_points(true[0], true[1], length)
    exact = length / np.hypot(*(true[1] - true[0]))
    assert scale.value == pytest.approx(exact, rel=1e-12)
    # rounding a place that is itself uniform over a pixel has twice the variance of rounding
    assert scale.std / scale.value * length / exact == pytest.approx(spread / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize(("period", "angle"), [(8.37, 0.0), (20.0, 0.0), (12.9, 0.3)])
def test_the_ticks_of_a_ruler_give_the_scale_within_its_deviation(period, angle):
    image = ruler(period, angle, 2.0)
    a, b = np.array([20.0, 60.0]), np.array([20 + 340 * np.cos(angle), 60 + 340 * np.sin(angle)])
    scale = scale_from_ruler(image, a, b, 1e-3)
    assert abs(scale.value - 1e-3 / period) < 5 * scale.std
    assert scale.std < 1e-3 * scale.value


def test_a_picture_without_ticks_gives_no_scale():
    noise = np.random.default_rng(1).integers(0, 255, (100, 300), dtype=np.uint8)
    with pytest.raises(ResultError, match="No regular ticks"):
        scale_from_ruler(noise, np.array([10.0, 50.0]), np.array([290.0, 50.0]), 1e-3)


def test_corners_of_a_turned_board_give_the_scale_within_its_deviation():
    rng = np.random.default_rng(4)
    v, u = np.mgrid[:6, :9].astype(float)
    side, angle, sigma = 31.7, 0.4, 0.1
    x = side * (u * np.cos(angle) - v * np.sin(angle)) + 200
    y = side * (u * np.sin(angle) + v * np.cos(angle)) + 100
    corners = np.stack([x, y], axis=-1) + rng.normal(0, sigma, (6, 9, 2))
    scale = scale_from_checkerboard(corners, 0.005)
    assert abs(scale.value - 0.005 / side) < 4 * scale.std


def test_a_tilted_board_is_refused():
    board = np.stack(np.meshgrid(np.arange(7) * 20.0, np.arange(5) * 17.0), axis=-1)
    with pytest.raises(ResultError, match="tilted"):
        scale_from_checkerboard(board, 0.005)


@pytest.mark.parametrize("length", [0.0, -0.01, float("nan")])
def test_lengths_that_are_not_positive_are_refused(length):
    a, b = np.zeros(2), np.array([100.0, 0.0])
    with pytest.raises(InputError, match="not a positive length"):
        scale_from_points(a, b, length)
    with pytest.raises(InputError, match="not a positive length"):
        scale_from_checkerboard(np.zeros((3, 3, 2)), length)


def test_points_that_coincide_and_rulers_off_the_picture_are_refused():
    with pytest.raises(InputError, match="0 px apart"):
        scale_from_points(np.ones(2), np.ones(2), 0.1)
    with pytest.raises(InputError, match="is not inside the 300 x 100 px"):
        scale_from_ruler(np.zeros((100, 300)), np.zeros(2), np.array([300.0, 5.0]), 1e-3)
