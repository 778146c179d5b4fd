"""The native kernels: one answer on every instruction set, and the spline that they claim to be."""

import numpy as np
import pytest
from scipy.ndimage import spline_filter

from haselab import _track
from haselab.tracking import PointTracker, TrackOptions

RNG = np.random.default_rng(8)
HEIGHT, WIDTH = 130, 150
STEPS_PER_GREY = 4 * (37632 / (6 * 14 * 194)) ** 2


def smooth_texture(seed):
    rough = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH))
    waves = np.fft.rfft2(rough)
    fy, fx = np.fft.fftfreq(HEIGHT)[:, None], np.fft.rfftfreq(WIDTH)[None, :]
    soft = np.fft.irfft2(waves * np.exp(-((fx**2 + fy**2) / (2 * 0.1**2))), s=rough.shape)
    return 128 + 40 * soft / soft.std()


def moved(frame, x, y):
    """The frame shifted by (x, y) px, in Fourier space."""
    fy, fx = np.fft.fftfreq(HEIGHT)[:, None], np.fft.rfftfreq(WIDTH)[None, :]
    return np.fft.irfft2(np.fft.rfft2(frame) * np.exp(-2j * np.pi * (fx * x + fy * y)), frame.shape)


def as_pixels(frame, kind):
    factor = 1 if kind is np.uint8 else 16
    return np.rint(np.clip(frame, 0, 255) * factor).astype(kind)


def answers(tracker, frames, kernels):
    """All arrays that the kernel writes for each frame in turn."""
    state, rows = tracker.init(frames[:1]), []
    before = [state.poses, state.velocity_px, state.reason, state.gain]
    count = len(state.poses)
    for frame in frames:
        after = [np.empty_like(part) for part in before]
        found = np.empty((2, count)), np.empty((2, count)), np.empty(count)
        native, rules = state.reference.native, state.reference.rules
        _track.step(native, rules, frame, state.reference.bits, *before, *after, *found, kernels)
        rows.append([*after, *found])
        before = after
    return rows


@pytest.mark.parametrize("kernels", _track.kernels())
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    ("model", "side"), [("neighbours", 15), ("affine", 21), ("translation", 33), ("neighbours", 9)]
)
def test_all_kernels_give_the_same_bits(kernels, kind, model, side):
    grid = np.stack(np.meshgrid(np.arange(26.2, 124, 16), np.arange(26.6, 104, 16)), -1)
    points = grid.reshape(-1, 2)
    scene = smooth_texture(1)
    frames = [as_pixels(moved(scene, 0.37 * k**1.5, -0.21 * k), kind) for k in range(6)]
    frames[3][40:70, 50:90] = 20  # something to lose and to find again
    tracker = PointTracker(points, TrackOptions(model=model, subset_px=side))
    for row, other in zip(
        answers(tracker, frames, kernels), answers(tracker, frames, "portable"), strict=True
    ):
        for part, same in zip(row, other, strict=True):
            np.testing.assert_array_equal(part, same)


@pytest.mark.parametrize("kernels", _track.kernels())
def test_coefficients_are_those_of_the_interpolating_spline(kernels):
    frame = RNG.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    steps = np.empty(frame.shape, np.int16)
    _track.coefficients(frame, 8, steps, kernels)
    exact = spline_filter(frame.astype(float), order=3, mode="mirror")
    error = (steps / STEPS_PER_GREY + 128.0 - exact)[16:-16, 16:-16]
    # Two products rounded to half a step along each axis. Along x they pass the filter along y,
    # which lifts white noise by (37632 / (6 * 14 * 194)) * sqrt(mean of 1 / B²) = 2.309 * 1.90;
    # along y the last factor, 4 - s, by sqrt(16 + 2).
    rounding = np.sqrt(2.0 / 12.0) * np.hypot(2.309 * 1.90, np.sqrt(18.0)) / STEPS_PER_GREY
    # the product leaves out s8 / 37634 of white noise: sqrt(2) of it, along both axes
    cut = 2.0 / 37634 * np.std(exact)
    assert np.std(error) < 1.1 * np.hypot(rounding, cut)
    assert abs(np.mean(error)) < 0.02


def test_twelve_bits_of_the_same_picture_give_the_same_coefficients():
    frame = RNG.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    narrow, wide = np.empty((2, *frame.shape), np.int16)
    _track.coefficients(frame, 8, narrow)
    _track.coefficients(frame.astype(np.uint16) * 16, 12, wide)
    np.testing.assert_array_equal(narrow, wide)


def test_the_filter_over_the_frame_gives_the_bits_of_the_filter_around_each_point():
    points = RNG.uniform(20, 110, (1200, 2))
    frames = [as_pixels(moved(smooth_texture(3), 0.3 * k, 0.8 * k), np.uint8) for k in range(3)]
    # 1200 subsets cover the frame many times over, 5 do not
    many, few = (PointTracker(points[:count], TrackOptions()) for count in (1200, 5))
    for all_of_them, some in zip(answers(many, frames, ""), answers(few, frames, ""), strict=True):
        np.testing.assert_array_equal(all_of_them[0][:5], some[0])
        for part in (4, 5):  # positions and deviations
            np.testing.assert_array_equal(all_of_them[part][:, :5], some[part])


def test_unknown_kernels_are_refused():
    frame = np.zeros((20, 20), np.uint8)
    with pytest.raises(ValueError, match="does not run the kernels neon"):
        _track.coefficients(frame, 8, np.empty(frame.shape, np.int16), "neon")
