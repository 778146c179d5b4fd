"""Frames that are drawn on demand: their parts, and what a tracker finds in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from haselab.rig.protocols import ImagePart
from haselab.rig.twin.camera import TwinCamera, TwinCameraConfig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench
from haselab.tracking import PointTracker, TrackOptions, detect_fiducials

OPTIONS = TrackOptions(subset_px=21, search_px=40, sloped_light=True)
REST = 10


@pytest.mark.parametrize(("width_px", "height_px"), [(256, 200), (255, 201)])
def test_a_part_of_a_frame_has_the_bits_of_the_whole_and_leaves_other_pixels(width_px, height_px):
    config = TwinCameraConfig(width_px=width_px, height_px=height_px, fiducial_spacing_px=40.0)
    camera = TwinCamera(config, 0.02, 0.02, seed=3)
    lengths_m = np.linspace(0.030, 0.031, config.exposure_samples)[np.newaxis]
    whole = camera.render(lengths_m, 7)[0]
    rng = np.random.default_rng(1)
    for rows in np.sort(rng.integers(0, height_px + 1, (40, 2))).tolist():
        edges = np.sort(rng.integers(0, width_px + 1, 4)).tolist()
        expected = np.full((1, height_px, width_px), 99, dtype=np.uint8)
        part = expected.copy()
        spans = [(edges[0], edges[1]), (edges[2], edges[3])]
        camera.render(lengths_m, 7, part, (tuple(rows), spans))
        for first, stop in spans:
            expected[0, slice(*rows), first:stop] = whole[slice(*rows), first:stop]
        np.testing.assert_array_equal(part, expected)


def test_frames_drawn_one_by_one_are_those_that_are_drawn_together():
    one, other = (TwinBench(TwinConfig(), 5) for _ in range(2))
    taken = []
    for bench in (one, other):
        bench.start(100.0)
        bench.write(1.0)
        for _ in range(10):
            bench.read()
        taken.append(bench.take())
    together, apart = taken
    images = together.images
    for k in reversed(range(len(images))):
        view = apart.view(k)
        parts = [((40, 80), [(0, 512)]), ((200, 230), [(3, 40), (101, 200)])]
        drawn = view.with_parts(parts)
        for rows, columns in parts:
            for first, stop in columns:
                there = slice(*rows), slice(first, stop)
                assert (drawn[there] == images[k][there]).all()
        assert (view.whole() == images[k]).all()
        assert (apart.image(k) == images[k]).all()


class Part:
    """A frame whose pixels are noise until they are asked for."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self._image = image
        self.complete = False

    def whole(self) -> NDArray[np.uint8]:
        self.complete = True
        return self._image

    def with_parts(self, parts: Sequence[ImagePart]) -> NDArray[np.uint8]:
        shown = np.random.default_rng(0).integers(0, 256, self._image.shape).astype(np.uint8)
        for rows, columns in parts:
            for first, stop in columns:
                shown[slice(*rows), first:stop] = self._image[slice(*rows), first:stop]
        return shown


def test_a_tracker_finds_the_same_in_parts_of_frames_also_after_a_jump():
    """The clamp moves by 3 px a frame, jumps by 14 and by 35, and leaves the picture."""
    camera = TwinCamera(TwinCameraConfig(), 0.07, 0.032, seed=2)
    scale_m = camera.config.scale_m_per_px
    moves_px = [0.0] * REST + [3.0] * 8 + [14.0] + [0.0] * 4 + [35.0] + [-2.0] * 4
    lengths_m = 0.05 + scale_m * np.cumsum(moves_px)
    samples = camera.config.exposure_samples
    images = camera.render(np.repeat(lengths_m[:, np.newaxis], samples, axis=1), 0)
    tracker = PointTracker(detect_fiducials(images[:REST].mean(axis=0), 6), OPTIONS)
    plain = parted = tracker.init(list(images[:REST]))
    complete = []
    for image in [*images, np.roll(images[-1], 200, axis=0), *images[-2:]]:
        part = Part(image)
        plain, expected = tracker.step(plain, image)
        parted, found = tracker.step(parted, part)
        for name in ("x_px", "y_px", "std_x_px", "std_y_px", "quality", "reason"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        complete.append(part.complete)
    assert not any(complete[: REST + 8])
    assert complete[REST + 8] or complete[REST + 13]  # it was searched for there
    assert complete[len(images)]
