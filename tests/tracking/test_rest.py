"""Motion among the frames that should be at rest."""

import numpy as np
import pytest

from haselab.tracking import TrackOptions, frames_at_rest

PLACES = np.stack(np.meshgrid(np.arange(20.0, 141, 24), np.arange(20.0, 141, 24)), -1).reshape(
    -1, 2
)
PLACES = PLACES + np.random.default_rng(4).uniform(-4, 4, PLACES.shape)


def picture(places, rng):
    y, x = np.mgrid[0:160, 0:160]
    image = np.full((160, 160), 180.0)
    for px, py in places:
        image -= 90.0 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * 2.0**2))
    return np.rint(rng.normal(image, 2.0)).clip(0, 255).astype(np.uint8)


def rest_of(moved, points=PLACES):
    rng = np.random.default_rng(7)
    frames = [picture(PLACES + move, rng) for move in moved]
    return frames_at_rest(frames, points, TrackOptions())


def stretch(strain):
    return (PLACES - 80.0) * [-0.4 * strain, strain]


@pytest.mark.parametrize("start", [1, 3, 6, 9])
def test_the_frames_before_a_motion_are_at_rest(start):
    ramp = np.maximum(np.arange(10) - start + 1, 0)
    assert rest_of([[0.3 * step, 0.0] for step in ramp]) == start
    assert rest_of([stretch(0.006 * step) for step in ramp]) == start
    assert rest_of([[0.3 * step, 0.0] for step in ramp], PLACES[:2]) == start


def test_noise_and_a_shaking_picture_are_at_rest():
    assert rest_of([[0.0, 0.0]] * 10) == 10
    assert rest_of([[0.0, 0.0]]) == 1
    for seed in range(5):
        shakes = np.random.default_rng(seed).normal(0.0, 0.1, (10, 2))
        assert rest_of(list(shakes)) == 10
