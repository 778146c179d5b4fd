"""Templates of the points: what is filtered around them is what the whole frame would give."""

from dataclasses import fields

import numpy as np
import pytest

from haselab.tracking import TrackOptions
from haselab.tracking.subsets import build_subsets

IMAGE = np.random.default_rng(6).uniform(0, 255, (120, 140))


@pytest.mark.parametrize("smoothing_px", [0.0, 0.6, 2.3])
@pytest.mark.parametrize("model", ["translation", "affine"])
def test_a_subset_is_the_same_alone_and_among_many_that_cover_the_frame(model, smoothing_px):
    options = TrackOptions(model=model, smoothing_px=smoothing_px)
    x, y = np.meshgrid(np.arange(7.0, 133.0, 3.0), np.arange(7.0, 113.0, 3.0))  # edge to edge
    many = np.stack([x.ravel(), y.ravel()], axis=1)
    together = build_subsets(IMAGE, many, options)
    for index in (0, 41, 700, len(many) - 1):
        alone = build_subsets(IMAGE, many[[index]], options)
        for part in fields(alone):
            if part.name != "place":
                # the same sums in the same order; inverses may be taken by other routines
                expected = getattr(together, part.name)[[index]]
                np.testing.assert_allclose(
                    getattr(alone, part.name), expected, rtol=1e-5, atol=1e-9, err_msg=part.name
                )


def test_the_slope_of_a_wave_is_that_of_calculus():
    y, x = np.mgrid[:60, :60].astype(float)
    kx, ky = 0.20, 0.13  # rad/px
    image = 100.0 + 50.0 * np.sin(kx * x + ky * y) + 20.0 * np.cos(0.3 * x)
    found = build_subsets(image, np.array([[30.0, 30.0]]), TrackOptions(smoothing_px=0.0))
    v, u = np.mgrid[23:38, 23:38].astype(float)
    wave = 50.0 * np.cos(kx * u + ky * v)
    slopes = np.stack([kx * wave - 6.0 * np.sin(0.3 * u), ky * wave]).reshape(2, -1)
    # the slope of a cubic spline is wrong by k^5 / 180 of the amplitude
    bound = (50.0 * max(kx, ky) ** 5 + 20.0 * 0.3**5) / 180.0
    error = found.gradient[0, :, :225] * found.norm[0] - slopes
    assert np.abs(error).max() < bound + 1e-6 * np.abs(slopes).max()
