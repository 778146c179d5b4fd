"""Rigid motion measured by fixed points."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.tracking.camera.rigid import fit_rigid_motion

REST = np.array([[20.0, 30.0], [400.0, 35.0], [390.0, 300.0], [15.0, 310.0]])


def moved(points, angle, shift, centre):
    c, s = np.cos(angle), np.sin(angle)
    return (points - centre) @ np.array([[c, -s], [s, c]]).T + centre + shift


def flat(points, noise=None):
    """As one frame: x, y of shape (1, P)."""
    points = points if noise is None else points + noise
    return points[None, :, 0], points[None, :, 1]


def test_an_exact_rigid_motion_is_undone_to_rounding():
    sheet = np.random.default_rng(1).uniform(0, 400, (50, 2))
    centre, shift = REST.mean(axis=0), np.array([3.0, -7.0])
    x, y = flat(moved(REST, 0.02, shift, centre))
    std = np.full((1, 4), 0.02)
    motion = fit_rigid_motion(REST, x, y, std, std)
    assert motion.angle_rad[0] == pytest.approx(0.02, abs=1e-13)
    np.testing.assert_allclose(motion.shift_px[0], shift, atol=1e-11)
    x, y = flat(moved(sheet, 0.02, shift, centre))
    back = motion.undo(x, y, np.zeros_like(x), np.zeros_like(x))
    np.testing.assert_allclose(np.stack(back[:2], axis=-1)[0], sheet, atol=1e-10)


def test_a_fixed_point_that_is_lost_leaves_the_others_to_measure_the_motion():
    now = moved(REST, -0.01, [1.0, 2.0], REST.mean(axis=0))
    now[2] = np.nan
    x, y = flat(now)
    std = np.where(np.isnan(x), np.nan, 0.02)
    motion = fit_rigid_motion(REST, x, y, std, std)
    assert motion.angle_rad[0] == pytest.approx(-0.01, abs=1e-13)
    np.testing.assert_allclose(motion.shift_px[0], [1.0, 2.0], atol=1e-11)


def test_stated_deviations_are_those_of_many_noisy_frames():
    rng, sigma, count = np.random.default_rng(2), 0.05, 4000
    noise = rng.normal(0, sigma, (count, 4, 2))
    std = np.full((count, 4), sigma)
    motion = fit_rigid_motion(REST, *np.moveaxis(REST + noise, 2, 0), std, std)
    # a standard deviation of 4000 draws is itself known to 1 / sqrt(8000) = 1.1 %: four of those
    assert motion.angle_rad.std() == pytest.approx(motion.angle_std_rad[0], rel=0.045)
    assert motion.shift_px.std(axis=0) == pytest.approx(motion.shift_std_px[0], rel=0.045)
    far = np.tile([[600.0, 100.0]], (count, 1))
    still = [far[:, :1], far[:, 1:], np.zeros((count, 1)), np.zeros((count, 1))]
    x, y, std_x, std_y = motion.undo(*still)
    assert x.std() == pytest.approx(std_x.mean(), rel=0.045)
    assert y.std() == pytest.approx(std_y.mean(), rel=0.045)


def test_one_fixed_point_gives_the_shift_and_none_gives_no_motion():
    x, y = np.array([[22.0], [np.nan]]), np.array([[29.0], [np.nan]])
    std = np.full((2, 1), 0.1)
    motion = fit_rigid_motion(REST[:1], x, y, std, std)
    np.testing.assert_allclose(motion.shift_px[0], [2.0, -1.0])
    assert (motion.angle_rad[0], motion.angle_std_rad[0]) == (0.0, 0.0)
    assert np.isnan(motion.angle_rad[1])
    assert np.isnan(motion.undo(*(np.ones((2, 3)) for _ in range(4)))[0][1]).all()


def test_columns_that_do_not_fit_the_fixed_points_are_refused():
    with pytest.raises(InputError, match=r"expected \(F, 4\)"):
        fit_rigid_motion(REST, *(np.zeros((1, 3)) for _ in range(4)))
    with pytest.raises(InputError, match="expected \\(K, 2\\)"):
        fit_rigid_motion(np.zeros((0, 2)), *(np.zeros((1, 0)) for _ in range(4)))
