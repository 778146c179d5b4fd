"""Dots found in images with known centres."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from haselab.base import InputError, ResultError
from haselab.tracking import (
    DotProfile,
    detect_fiducials,
    detect_particles,
    find_profile,
    locate_particles,
)


def test_every_dot_is_found_once_at_its_centre(sheet):
    made = sheet(9, 8)
    found = detect_particles(made.frame(), margin_px=5)
    away, partner = cKDTree(made.rest_px).query(found)
    assert sorted(partner) == list(range(72))
    # one dot of depth 90 in noise of 1.7: sqrt(2 / pi) 1.7 / 90 = 0.015 px an axis, at best;
    # a paraboloid through 3 x 3 pixels is allowed twice that
    assert np.sqrt(np.mean(away**2) / 2) < 0.03


@pytest.mark.long
def test_stated_deviation_of_a_centre_matches_its_scatter(sheet):
    made = sheet()
    errors, stds = [], []
    for _ in range(40):
        found = locate_particles(made.frame(), DotProfile(2.0, "dark"))
        _, partner = cKDTree(made.rest_px).query(found.points_px)
        errors.append(found.points_px - made.rest_px[partner])
        stds.append(found.std_px)
    scatter = np.sqrt(np.mean(np.square(np.concatenate(errors))))
    # noise of the ground, where the median is, is some 12 % above that on a dot's flank
    assert np.sqrt(np.mean(np.square(np.concatenate(stds)))) == pytest.approx(scatter, rel=0.2)


@pytest.mark.parametrize("sigma", [1.4, 2.8])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_scale_and_sign_of_the_dots_are_found(sigma, sign):
    rng = np.random.default_rng(8)
    y, x = np.mgrid[:150, :150]
    image = np.full((150, 150), 120.0)
    for cx, cy in rng.uniform(15, 135, (25, 2)):
        image += sign * 60 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    profile = find_profile(rng.normal(image, 1.5))
    assert profile == DotProfile(sigma, "bright" if sign > 0 else "dark")


def test_a_limited_count_spreads_over_the_image(sheet):
    made = sheet(12, 12)
    chosen = detect_particles(made.frame(), count=36, margin_px=5)
    assert len(chosen) == 36
    quarters = (chosen > np.array([130, 120])) @ [1, 2]
    # 9 a quarter if even; binomial scatter alone would be 2.6
    assert np.bincount(quarters, minlength=4).min() >= 4


@pytest.mark.parametrize("sigma", [3.5, 5.0, 8.0])
def test_clamp_dots_are_found_among_particles_row_by_row(sheet, sigma):
    made = sheet(10, 5)
    made.rest_px = made.rest_px[(made.rest_px[:, 1] > 75) & (made.rest_px[:, 1] < 165)]
    truth = np.array([[x, y] for y in (38.4, 201.7) for x in (60.2, 130.0, 199.5)])
    ideal = made.ideal()
    y, x = np.mgrid[: made.shape[0], : made.shape[1]]
    for cx, cy in truth:
        ideal -= 110 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    found = detect_fiducials(made.noisy(ideal), 6)
    # single errors of 3 deviations, sqrt(2 / pi) 2 / 110, doubled for the 3 x 3 paraboloid on
    # a flat top, whose curvature falls with sigma squared
    np.testing.assert_allclose(found, truth, atol=3 * 0.0145 * 2 * max(1.0, sigma / 2.5))


def test_straight_edges_are_no_particles(sheet):
    made = sheet(6, 5)
    ideal = made.ideal()
    ideal[:22] += 70  # a bright clamp along the top
    found = detect_particles(made.noisy(ideal), margin_px=5)
    assert (cKDTree(made.rest_px).query(found)[0] < 0.5).all()
    assert len(found) == 30


def test_a_blank_image_and_wrong_requests_are_refused():
    noise = np.random.default_rng(1).normal(100, 2, (64, 64))
    with pytest.raises(ResultError, match=r"No .* dot exceeds the noise"):
        detect_particles(noise)
    with pytest.raises(ResultError, match="not 6 of similar size"):
        detect_fiducials(noise)
    with pytest.raises(InputError, match="7 dots do not form 2 equal rows"):
        detect_fiducials(noise, 7)
    with pytest.raises(InputError, match="polarity = 'grey' is unknown"):
        detect_particles(noise, polarity="grey")
    with pytest.raises(InputError, match=r"shape \(64,\)"):
        detect_particles(noise[0])


def test_dots_whose_subset_contains_an_edge_are_left_out_and_a_dense_pattern_is_none():
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(np.arange(20.0, 221.0, 20.0), np.arange(20.0, 221.0, 20.0))
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-2.0, 2.0, (121, 2))
    columns, rows = np.meshgrid(np.arange(240.0), np.arange(240.0))
    image = np.where(rows < 52, 210.0, 130.0)  # a clamp, and the sheet below it
    for cx, cy in dots:
        image -= 60 * np.exp(-((columns - cx) ** 2 + (rows - cy) ** 2) / 8)
    noisy = np.rint(rng.normal(image, 1.5))
    kept = detect_particles(noisy, polarity="dark", sigma_px=2.0, subset_px=15)
    away = np.abs(dots[:, 1] - 51.5)
    inside = np.all((dots > 14.0) & (dots < 225.0), axis=1)
    # Wholly beyond: half of the subset, two pixels that are compared, and rounding.
    missed, _ = cKDTree(kept).query(dots[inside & (away > 11.0)])
    assert missed.max() < 0.5
    assert np.abs(kept[:, 1] - 51.5).min() > 7.0
    crowd = rng.uniform(0.0, 240.0, (1400, 2))  # dots cover most of the ground
    dense = np.full((240, 240), 150.0)
    for cx, cy in crowd:
        dense -= 40 * np.exp(-((columns - cx) ** 2 + (rows - cy) ** 2) / 8)
    every = detect_particles(dense, polarity="dark", sigma_px=2.0)
    even = detect_particles(dense, polarity="dark", sigma_px=2.0, subset_px=15)
    assert len(even) > 0.9 * len(every)
