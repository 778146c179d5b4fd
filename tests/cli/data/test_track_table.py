"""Rows of the table of tracks: the same text as Python's own formatting, for any number."""

import csv
import io

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from haselab.pipelines.tracking.table import COLUMNS, METRES, Block, TrackRows, reason_name
from haselab.pipelines.tracking.track_collector import TrackCollector
from haselab.tracking import LossReason, Tracks

FEW = st.floats(-9e4, 9e4, allow_nan=False)


def block_of(numbers, reason=None, first=0):
    """Numbers of shape (5, F, P)."""
    reason = np.zeros(numbers[0].shape, np.uint8) if reason is None else reason
    tracks = Tracks(*numbers, valid=reason == 0, reason=reason)
    frames = first + np.arange(len(numbers[0]))
    return Block(first, 0.0025 * frames, tracks, frames)


def lines(rows, block, rest):
    return list(csv.reader(io.StringIO((rows.header() + rows.block(block, rest)).decode())))


@given(st.lists(FEW, min_size=5, max_size=5))
def test_numbers_are_rounded_to_five_digits_after_the_point(values):
    block = block_of(np.array(values).reshape(5, 1, 1))
    row = lines(TrackRows(["a"], None), block, np.zeros((1, 2)))[1]
    for text, value in zip(row[3:8], values, strict=True):
        # half a unit of the last digit, and the rounding of value / 1e-5 in double
        assert abs(float(text) - value) <= 0.5e-5 * (1 + 1e-9) + 2e-16 * abs(value) * 4
        whole, _, part = text.partition(".")
        assert len(part) == 5
        assert whole.lstrip("-") == str(int(abs(float(text))))


@given(FEW, FEW)
def test_displacements_in_metres_are_exact_to_a_picometre(x, rest):
    block = block_of(np.array([x, 0, 0, 0, 0.0]).reshape(5, 1, 1))
    row = lines(TrackRows(["a"], 1e-4), block, np.array([[rest, 0.0]]))[1]
    exact = (x - rest) * 1e-4
    assert abs(float(row[9]) - exact) <= 0.5e-12 + 4e-16 * abs(exact) * 4


def test_lost_points_read_nan_with_their_reason_and_names_are_quoted():
    numbers = np.full((5, 2, 2), 1.5)
    numbers[:4, 1, 0] = np.nan
    reason = np.zeros((2, 2), np.uint8)
    reason[1, 0] = LossReason.UNLIKE | LossReason.COVERED
    names = ['left, "top"', "été"]
    rows = lines(TrackRows(names, 1e-4), block_of(numbers, reason, first=41), np.zeros((2, 2)))
    assert rows[0] == [*COLUMNS, *METRES, "reason"]
    assert [row[2] for row in rows[1:]] == names * 2
    assert rows[3][:2] == ["42", "0.105"]
    assert rows[3][3:7] == ["nan"] * 4
    assert rows[3][8:] == ["0", "nan", "nan", "unlike+covered"]
    assert rows[4][8:] == ["1", "0.000150000000", "0.000150000000", ""]


def test_every_reason_has_a_word():
    assert reason_name(0) == ""
    assert all(reason_name(int(flag)) for flag in LossReason)


def test_of_a_long_clip_all_of_the_few_points_and_some_frames_of_all_are_kept():
    points, frames = 300, 5000
    kept = TrackCollector(points, np.array([3, 7]))
    for first in range(0, frames, 50):
        numbers = np.broadcast_to(first + np.arange(50.0)[None, :, None], (5, 50, points)).copy()
        kept.add(block_of(numbers, first=first))
    assert kept.always().x_px.shape == (frames, 2)
    np.testing.assert_array_equal(kept.always().x_px[:, 1], np.arange(frames))
    thin = kept.thinned()
    assert len(set(np.diff(thin.frame))) == 1
    np.testing.assert_array_equal(thin.tracks.x_px[:, 0], thin.frame)
    assert 1000 <= len(thin.frame) <= 2000
    assert kept.valid.tolist() == [frames] * points
