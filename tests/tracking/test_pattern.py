"""A fixed pattern of the sensor: found at rest, removed, and distinguished from texture."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from haselab.tracking import PointTracker, TrackOptions
from haselab.tracking.camera.fixed_pattern import find_pattern

OFFSET = 8.0  # grey, standard deviation


def seen(ideal, pattern, rng):
    noisy = ideal + pattern + rng.normal(0.0, 2.0, ideal.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.fixture
def pattern():
    return np.random.default_rng(4).normal(0.0, OFFSET, (240, 260))


def test_pattern_is_found_with_its_variance(sheet, pattern):
    scene = sheet()
    found = find_pattern([seen(scene.ideal(), pattern, scene.rng) for _ in range(10)])
    assert found is not None
    counted = pattern.size / 16  # a quarter of the frequencies along each axis
    assert found.variance == pytest.approx(OFFSET**2, rel=4.0 * np.sqrt(2.0 / counted))
    # a flat background shows all of it but the mean, and the camera's noise of ten frames
    flat = np.s_[:30, :]
    assert np.corrcoef(found.levels[flat].ravel(), pattern[flat].ravel())[0, 1] > 0.9


def test_a_good_camera_has_no_pattern(sheet):
    scene = sheet()
    assert find_pattern([scene.frame() for _ in range(10)]) is None


def test_one_frame_shows_no_pattern(sheet, pattern):
    scene = sheet()
    assert find_pattern([seen(scene.ideal(), pattern, scene.rng)]) is None


def test_pattern_does_not_hold_slow_points_back(sheet, pattern):
    scene = sheet()
    rest = [seen(scene.ideal(), pattern, scene.rng) for _ in range(10)]
    tracker = PointTracker(scene.rest_px, TrackOptions(model="neighbours"))
    state = tracker.init(rest)
    for shift in (0.2, 0.4, 0.6, 0.8):
        frame = seen(scene.ideal(shift=(shift, 0.0)), pattern, scene.rng)
        state, found = tracker.step(state, frame)
    assert found.valid.all()
    error = found.x_px - scene.rest_px[:, 0] - 0.8
    # white offsets move a dot by their deviation over the root of the slopes' energy
    alone = OFFSET / (90.0 * np.sqrt(np.pi / 2.0))
    assert np.abs(error.mean()) < 4.0 * alone / np.sqrt(error.size)
    assert np.sqrt(np.mean(error**2)) < 1.5 * alone


def test_pattern_that_moves_with_the_points_is_texture(sheet):
    scene = sheet()
    texture = gaussian_filter(np.random.default_rng(5).normal(0.0, 1.0, (240, 260)), 0.5)
    texture *= 12.0 / texture.std()
    ideal = scene.ideal() + texture
    tracker = PointTracker(scene.rest_px, TrackOptions(model="neighbours"))
    state = tracker.init([seen(ideal, 0.0, scene.rng) for _ in range(10)])
    assert state.pattern is not None
    for shift in (1, 2, 3, 4):
        state, found = tracker.step(state, seen(np.roll(ideal, shift, axis=1), 0.0, scene.rng))
    assert state.pattern is None
    error = found.x_px - scene.rest_px[:, 0] - 4.0
    assert np.nanmax(np.abs(error)) < 5.0 * np.nanmean(found.std_x_px)


def test_pattern_of_the_sensor_is_kept_when_the_points_have_moved(sheet, pattern):
    scene = sheet()
    tracker = PointTracker(scene.rest_px, TrackOptions(model="neighbours"))
    state = tracker.init([seen(scene.ideal(), pattern, scene.rng) for _ in range(10)])
    for shift in (1.0, 2.0, 3.0):
        frame = seen(scene.ideal(shift=(shift, 0.0)), pattern, scene.rng)
        state, _ = tracker.step(state, frame)
    assert state.pattern is not None
    assert state.textured is None
