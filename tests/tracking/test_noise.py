"""The noise law from rest frames."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.tracking import measure_noise


def camera(floor, slope, count, rng, top=255, kind=np.uint8):
    scene = np.tile(np.linspace(0.08 * top, 0.9 * top, 400), (300, 1))
    spread = np.sqrt(floor + slope * scene)
    return [np.rint(rng.normal(scene, spread)).astype(kind) for _ in range(count)]


@pytest.mark.parametrize(
    ("floor", "slope", "top", "kind"),
    [(1.0, 0.02, 255, np.uint8), (0.5, 0.05, 255, np.uint8), (50.0, 0.4, 4095, np.uint16)],
)
def test_a_known_noise_law_is_recovered(floor, slope, top, kind):
    law = measure_noise(camera(floor, slope, 5, np.random.default_rng(3), top, kind))
    grey = np.array([0.2, 0.5, 0.8]) * top
    # 200,000 squared differences in all: the variance is known to sqrt(2 / 2e5) = 0.3 % in the
    # middle, to about three times that at the ends; cutting at 4 sigma takes 0.1 % off
    expected = floor + slope * grey + 1.0 / 12.0
    np.testing.assert_allclose(law.variance(grey), expected, rtol=0.04)


def test_something_that_moves_in_the_rest_frames_does_not_raise_the_noise():
    frames = camera(1.0, 0.02, 6, np.random.default_rng(4))
    static = measure_noise(frames).variance(128.0)
    for k, frame in enumerate(frames):
        frame[20:40, 30 * k : 30 * k + 30] = 5  # 0.5 % of the pixels
    assert measure_noise(frames).variance(128.0) == pytest.approx(float(static), rel=0.05)


def test_one_frame_or_an_overexposed_scene_is_refused():
    frames = camera(1.0, 0.02, 2, np.random.default_rng(5))
    with pytest.raises(InputError, match="at least 2 rest frames, not 1"):
        measure_noise(frames[:1])
    with pytest.raises(InputError, match=r"Only 0 sampled pixels.*exposure"):
        measure_noise([np.full((90, 90), 255, np.uint8)] * 2)


def test_a_flickering_lamp_is_not_taken_for_noise():
    rng = np.random.default_rng(6)
    scene = np.tile(np.linspace(20, 150, 400), (300, 1))
    lamp = (1.0, 1.2, 0.8, 1.1, 0.9)
    spread = np.sqrt(2.0)
    frames = [np.rint(rng.normal(g * scene, spread)).astype(np.uint8) for g in lamp]
    # bringing the frames to one brightness scales their noise: mean of 1 / gain² is 1.06
    scale = np.mean(1.0 / np.square(lamp))
    expected = scale * (2.0 + 1.0 / 12.0)
    assert float(measure_noise(frames).variance(85.0)) == pytest.approx(expected, rel=0.05)
