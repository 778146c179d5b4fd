"""Folders of numbered images: their order, and images that are missing among them."""

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.store.video.opening import open_video
from haselab.store.video.stills import image_numbers, natural_order


def write(folder, names):
    """Images whose grey level is their place in `names`."""
    for level, name in enumerate(names):
        tifffile.imwrite(folder / name, np.full((16, 20), level, np.uint8))


def test_numbers_without_leading_zeros_are_read_by_value(tmp_path):
    write(tmp_path, [f"img_{n}.tif" for n in (1, 2, 9, 10, 11, 100)])
    with open_video(tmp_path) as video:
        assert [int(frame[0, 0]) for frame in video] == list(range(6))


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=30, unique=True), st.integers(0, 7))
def test_natural_order_is_the_order_of_the_numbers(numbers, width):
    names = [f"cam2_{n:0{width}d}.png" for n in numbers]
    by_value = [f"cam2_{n:0{width}d}.png" for n in sorted(numbers)]
    assert sorted(names, key=natural_order) == by_value


@pytest.mark.parametrize(
    ("names", "places"),
    [
        (["0028", "0029", "0031", "0032"], [0, 1, 3, 4]),
        (["a1", "a2", "a3"], [0, 1, 2]),
        (["a_000", "a_005", "a_010"], [0, 1, 2]),  # every fifth image was kept
        (["a_000", "a_005", "a_015"], [0, 1, 3]),
        (["run3_7", "run3_8", "run3_10"], [0, 1, 3]),
        (["run3_7", "run4_8", "run4_10"], [0, 1, 2]),  # two numbers differ
        (["first", "second"], [0, 1]),
        (["7"], [0]),
        (["20260101", "20260102", "20261231"], [0, 1, 2]),  # dates
    ],
)
def test_gaps_in_the_numbering_are_missing_frames(names, places):
    assert image_numbers(names) == places


def test_later_images_keep_their_time_after_a_missing_one(tmp_path):
    write(tmp_path, ["0028.tif", "0029.tif", "0031.tif"])
    (tmp_path / "times.csv").write_text("frame,time_s\n0,5\n1,5.1\n2,5.2\n3,5.35\n")
    with open_video(tmp_path) as video:
        assert video.missing == (2,)
        assert [time_s for time_s, _ in video.timed()] == pytest.approx([0.0, 0.1, 0.35])


@pytest.mark.parametrize("name", ["beam.cihx", "beam.cih"])
def test_the_header_of_a_photron_recording_names_its_frames(tmp_path, name):
    (tmp_path / name).write_text("<cih></cih>")
    with pytest.raises(InputError, match=r"is the header .* Give the frames: beam\.mraw"):
        open_video(tmp_path / name)
