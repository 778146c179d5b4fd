"""The page of a tracked clip: whole without the net, honest about what is missing."""

import re
from dataclasses import replace

import numpy as np
import pytest

from haselab.report.track_page import TrackReport, TrackStrain, track_page
from haselab.tracking import LossReason, Tracks

FRAMES = 40


@pytest.fixture(scope="module")
def report():
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(20, 180, 7), np.linspace(20, 280, 9))
    rest = np.stack([x.ravel(), y.ravel()], axis=1)
    strain = 0.1 * np.sin(np.linspace(0, np.pi, FRAMES))
    place_y = rest[:, 1] * (1 + strain[:, None])
    shape = place_y.shape
    reason = np.zeros(shape, np.uint8)
    reason[10:20, 30] = LossReason.COVERED
    valid = reason == 0
    std = np.full(shape, 0.02)
    tracks = Tracks(
        np.where(valid, np.broadcast_to(rest[:, 0], shape), np.nan),
        np.where(valid, place_y, np.nan),
        std, std, np.where(valid, 0.99, 0.2), valid, reason,
    )  # fmt: skip
    time_s = np.arange(FRAMES) / 400
    return TrackReport(
        title="Tracks of a <clip>",
        frame=rng.integers(0, 255, (300, 200), dtype=np.uint8),
        rest_px=rest,
        gauge=np.array([0, 1, 2, 60, 61, 62]),
        time_s=time_s,
        has_time=True,
        tracks=tracks,
        strain=TrackStrain(time_s, strain, np.full(FRAMES, 1e-4), np.full(FRAMES, 6)),
        facts={"codec": "ffv1"},
        warnings=["the video is compressed with loss"],
    )


def test_the_page_is_whole_without_the_net_and_the_same_every_time(report):
    page = track_page(report)
    assert page == track_page(report)
    assert "Tracks of a &lt;clip&gt;" in page
    assert re.findall(r'<figure id="(\w+)"', page) == [
        *("paths", "motion", "field", "strain", "quality", "std")
    ]
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    assert "the video is compressed with loss" in page


def test_the_page_shows_the_strain_of_gauge_and_field(report):
    page = track_page(report)
    best = np.argmax(report.strain.strain)
    printed = 100 * report.strain.strain[best]
    assert f"0.000 to {printed:.3f} %" in page
    # the field is that of the same uniform stretch, without noise
    assert f"median {printed:.3f} %" in page


def test_lost_positions_are_shown_with_their_reason_and_share(report):
    page = track_page(report)
    assert re.search(r"covered</th><td>0\.4 %", page)  # 10 of 40 x 63
    assert "99.6 % of the positions found" in page


def test_a_clip_of_few_points_without_gauge_or_time_leaves_those_figures_out(report):
    t = report.tracks
    few = Tracks(
        *(part[:, :2] for part in (t.x_px, t.y_px, t.std_x_px, t.std_y_px, t.quality, t.valid)),
        reason=None,
    )
    bare = replace(
        report, rest_px=report.rest_px[:2], gauge=np.zeros(0, int), tracks=few, strain=None,
        time_s=np.arange(FRAMES, dtype=float), has_time=False,
    )  # fmt: skip
    page = track_page(bare)
    assert re.findall(r'<figure id="(\w+)"', page) == ["paths", "motion", "quality", "std"]
    assert "strain" not in re.sub(r"<style>.*?</style>|<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_a_clip_in_which_nothing_is_found_still_has_its_page(report):
    t = report.tracks
    lost = np.full(t.x_px.shape, np.nan)
    none = Tracks(lost, lost, lost, lost, np.full(lost.shape, 0.1), lost > 0,
                  np.full(lost.shape, int(LossReason.UNLIKE), np.uint8))  # fmt: skip
    page = track_page(replace(report, tracks=none, strain=None))
    assert "0.0 % of the positions found" in page
    assert re.search(r"too unlike the reference</th><td>1e\+02 %|<td>100 %", page)
