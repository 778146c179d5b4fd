"""Strain from displacements whose answer is known by arithmetic."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.tracking import Tracks, gauge_strain, homogeneity, strain_field

ROWS = np.array([[x, y] for y in (20.0, 220.0) for x in (40.0, 80.0, 120.0)])
UPPER, LOWER = np.arange(3), np.arange(3, 6)


def tracks_of(places, std=0.02, valid=None):
    valid = np.ones(places.shape[:2], bool) if valid is None else valid
    spread = np.full(places.shape[:2], std)
    x, y = (np.where(valid, places[..., k], np.nan) for k in (0, 1))
    return Tracks(x, y, spread, spread, np.ones(places.shape[:2]), valid)


def stretched(strains):
    return np.stack([ROWS * [1.0, 1.0 + s] for s in strains])


def test_gauge_strain_is_exact_and_blind_to_travel_and_turning():
    strains = np.array([0.0, 0.05, 0.15, -0.02])
    c, s = np.cos(0.3), np.sin(0.3)
    moved = stretched(strains) @ np.array([[c, s], [-s, c]]) + [13.0, -4.0]
    for places in (stretched(strains), moved):
        gauge = gauge_strain(tracks_of(places), ROWS, UPPER, LOWER)
        np.testing.assert_allclose(gauge.strain, strains, atol=1e-12)
    assert gauge.rest_length_px == 200.0


def test_gauge_deviation_matches_the_scatter_of_many_trials():
    rng = np.random.default_rng(9)
    places = np.broadcast_to(stretched([0.1])[0], (4000, 6, 2)) + rng.normal(0, 0.02, (4000, 6, 2))
    gauge = gauge_strain(tracks_of(places), ROWS, UPPER, LOWER)
    assert gauge.std[0] == pytest.approx(0.02 * np.sqrt(2 / 3) / 200.0, rel=1e-9)
    # the scatter of 4000 trials is known to 1 / sqrt(8000) = 1.1 %; 4 deviations
    assert gauge.strain.std() == pytest.approx(gauge.std[0], rel=0.045)


def test_a_lost_point_leaves_the_gauge_strain_unchanged():
    valid = np.ones((2, 6), bool)
    valid[1, 4] = False
    gauge = gauge_strain(tracks_of(stretched([0.0, 0.08]), valid=valid), ROWS, UPPER, LOWER)
    np.testing.assert_allclose(gauge.strain, [0.0, 0.08], atol=1e-12)
    assert gauge.std[1] == pytest.approx(0.02 * np.sqrt(1 / 3 + 1 / 2) / 200.0)
    valid[1, 3:] = False
    with pytest.raises(ResultError, match="No point of a gauge group is valid in frame 1"):
        gauge_strain(tracks_of(stretched([0.0, 0.08]), valid=valid), ROWS, UPPER, LOWER)


SCATTERED = np.array(
    [[50.0, 18.0], [90.0, 26.0], [130.0, 21.0], [47.0, 215.0], [95.0, 222.0], [128.0, 208.0]]
)


@pytest.mark.parametrize("lost", [[0], [4], [0, 1], [1, 5], [0, 1, 4], [0, 5], [1, 2, 4]])
def test_strain_of_a_sheet_holds_whichever_marks_are_lost(lost):
    # marks of a sheet lie at heights of their own; it narrows by 0.4 of the strain and turns
    shape = np.diag([1.0 - 0.4 * 0.08, 1.08])
    c, s = np.cos(0.2), np.sin(0.2)
    axis = SCATTERED[3:].mean(axis=0) - SCATTERED[:3].mean(axis=0)
    truth = np.linalg.norm(shape @ axis) / np.linalg.norm(axis) - 1.0
    valid = np.ones((2, 6), bool)
    valid[1, lost] = False
    moved = np.stack([SCATTERED, SCATTERED @ shape @ [[c, s], [-s, c]]])
    gauge = gauge_strain(tracks_of(moved, valid=valid), SCATTERED, UPPER, LOWER)
    np.testing.assert_allclose(gauge.strain, [0.0, truth], atol=1e-12)
    assert gauge.std[1] > gauge.std[0]
    assert gauge.upper_marks[1] + gauge.lower_marks[1] == 6 - len(lost)
    noisy = moved[1] + np.random.default_rng(3).normal(0, 0.02, (4000, 6, 2))
    seen = np.broadcast_to(valid[1], (4000, 6))
    trials = gauge_strain(tracks_of(noisy, valid=seen), SCATTERED, UPPER, LOWER)
    # the gauge has turned by 0.2, at equal deviations along x and y; 4 deviations of 1.1 %
    assert trials.strain.std() == pytest.approx(gauge.std[1], rel=0.045)


def test_a_single_line_that_does_not_run_along_the_gauge_has_no_strain():
    valid = np.ones((2, 6), bool)
    valid[1, [1, 2, 3, 4]] = False  # left above, right below
    gauge = gauge_strain(tracks_of(stretched([0.0, 0.08]), valid=valid), ROWS, UPPER, LOWER)
    assert np.isfinite(gauge.strain).tolist() == [True, False]
    assert np.isfinite(gauge.std).tolist() == [True, False]


def test_gauges_without_length_are_refused():
    with pytest.raises(InputError, match="one is empty"):
        gauge_strain(tracks_of(stretched([0.0])), ROWS, UPPER, np.zeros(0, int))
    with pytest.raises(InputError, match="same mean position"):
        gauge_strain(tracks_of(stretched([0.0])), ROWS, UPPER, UPPER)


@pytest.fixture
def cloud():
    return np.random.default_rng(3).uniform(0, 300, (200, 2))


def test_field_of_an_affine_map_is_exact_everywhere(cloud):
    gradient = np.array([[-0.03, 0.01], [0.02, 0.12]])
    field = strain_field(cloud, cloud @ gradient.T, np.full(cloud.shape, 0.02))
    assert field.valid.all()
    np.testing.assert_allclose(field.gradient, np.broadcast_to(gradient, (200, 2, 2)), atol=1e-10)
    deformation = np.eye(2) + gradient
    lagrange = 0.5 * (deformation.T @ deformation - np.eye(2))
    np.testing.assert_allclose(field.green_lagrange[7], lagrange, atol=1e-10)


def test_a_rigid_turn_has_no_green_lagrange_strain(cloud):
    c, s = np.cos(0.5), np.sin(0.5)
    turn = np.array([[c, -s], [s, c]])
    field = strain_field(cloud, cloud @ turn.T - cloud, np.full(cloud.shape, 0.02))
    np.testing.assert_allclose(field.green_lagrange, 0.0, atol=1e-10)
    assert field.engineering[0, 0, 0] == pytest.approx(c - 1.0)  # the small strain is not blind


@pytest.mark.long
def test_field_deviation_matches_scatter_and_lost_points_are_left_out(cloud):
    rng = np.random.default_rng(1)
    ratio = []
    for _ in range(30):
        moved = rng.normal(0, 0.02, cloud.shape)
        moved[::9] = np.nan
        field = strain_field(cloud, moved, np.full(cloud.shape, 0.02))
        ratio.append(field.gradient[field.valid] / field.std[field.valid])
    # 30 x 200 x 4 values, of which a 13-point neighbourhood leaves about 1 / 13 independent
    assert np.concatenate(ratio).std() == pytest.approx(1.0, rel=0.07)


def test_too_few_points_are_refused(cloud):
    with pytest.raises(InputError, match="needs 3 valid points"):
        strain_field(cloud[:2], cloud[:2], cloud[:2])
    with pytest.raises(InputError, match="6 bands need at least 24 valid points, not 20"):
        homogeneity(cloud[:20], cloud[:20], np.ones((20, 2)))


def test_an_even_stretch_is_even_and_its_sides_draw_in(cloud):
    moved = cloud * [-0.04, 0.10] + np.random.default_rng(2).normal(0, 0.02, cloud.shape)
    even = homogeneity(cloud, moved, np.full(cloud.shape, 0.02))
    # slope of 200 points of 0.02 px over 300 px: 1.6e-5; of a sixth of them in a band: 2.4e-4
    assert even.mean_strain == pytest.approx(0.10, abs=4 * 1.7e-5)
    assert even.lateral_slope == pytest.approx(-0.04, abs=4 * 1.7e-5)
    assert even.unevenness < 4 * 2.5e-4 / 0.10
    assert np.abs(even.strain - 0.10).max() < 5 * even.strain_std.max()
    assert np.all(np.diff(even.lateral_px) < 0)  # the farther from the mid-line, the more


def test_an_uneven_stretch_is_measured_band_by_band(cloud):
    y = cloud[:, 1]
    moved = np.stack([0 * y, 0.05 * y + 1e-4 * y**2], axis=1)  # local strain 0.05 + 2e-4 y
    uneven = homogeneity(cloud, moved, np.full(cloud.shape, 0.001))
    np.testing.assert_allclose(uneven.strain, 0.05 + 2e-4 * uneven.height_px, atol=1e-3)
    # six bands of an even spread of strain over 0.05 to 0.11: 0.06 / sqrt(12) x sqrt(35/36)
    assert uneven.unevenness == pytest.approx(0.0171 / 0.08, rel=0.1)
