"""Particles linked to trajectories, beside trackpy and beside known truth."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.store.video.opening import open_video
from haselab.tracking import DotProfile, link_particles, locate_particles


def links(frame, particle):
    """Pairs of detections (row numbers) that follow each other in one trajectory."""
    pairs, last = set(), {}
    for row, (now, number) in enumerate(zip(frame, particle, strict=True)):
        if number in last and frame[last[number]] == now - 1:
            pairs.add((last[number], row))
        last[number] = row
    return pairs


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:The inplace keyword")  # inside trackpy
@pytest.mark.parametrize("reach_px", [3.0, 5.0])
def test_links_of_real_colloids_equal_those_of_trackpy(shared_data, reach_px):
    trackpy = pytest.importorskip("trackpy")
    pandas = pytest.importorskip("pandas")
    trackpy.quiet()
    found = []
    with open_video(shared_data / "video/bulk-water.mov") as video:
        for _, frame in zip(range(25), video, strict=False):
            found.append(locate_particles(frame, DotProfile(2.0, "dark")).points_px)
    ours = link_particles(found, reach_px=reach_px, memory=0)
    table = pandas.DataFrame({"frame": ours.frame, "x": ours.x_px, "y": ours.y_px})
    theirs = trackpy.link(table, reach_px, memory=0).sort_index()
    mine = links(ours.frame, ours.particle)
    oracle = links(theirs["frame"].to_numpy(), theirs["particle"].to_numpy())
    assert len(oracle) > 5000
    # both take the least sum of squares; only ties at the reach itself may differ
    assert len(mine ^ oracle) <= 1e-3 * len(oracle)


def test_fast_particles_keep_their_identity_through_gaps_and_false_detections():
    rng = np.random.default_rng(6)
    start = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), -1).reshape(-1, 2) * 20
    speed = np.array([6.0, 2.0])
    detections, identity = [], []
    for k in range(40):
        seen = rng.uniform(size=100) > 0.03
        place = start[seen] + k * speed + rng.normal(0, 0.05, (seen.sum(), 2))
        false = rng.uniform(0, 250, (3, 2)) + k * speed
        detections.append(np.concatenate([place, false]))
        identity.append(np.concatenate([np.flatnonzero(seen), np.full(3, -1)]))
    linked = link_particles(detections, reach_px=8.0, memory=3, persistence=1.0)
    truth = np.concatenate(identity)
    numbers = [linked.particle[truth == dot] for dot in range(100)]
    # a false detection within 8 px of a missing dot may steal it: 0.03 x 3 x 200 / 62,500 px²
    # a dot and frame, 4 % of the dots in 40 frames; 10 % allowed
    whole = sum(len(set(number)) == 1 for number in numbers)
    assert whole >= 90


def test_memory_bridges_a_gap_and_no_longer():
    seen = [np.array([[5.0, 5.0]])] + [np.zeros((0, 2))] * 2 + [np.array([[5.5, 5.0]])]
    assert set(link_particles(seen, reach_px=2.0, memory=2).particle) == {0}
    assert set(link_particles(seen, reach_px=2.0, memory=1).particle) == {0, 1}


def test_no_detection_at_all_gives_no_trajectory():
    assert link_particles([np.zeros((0, 2))] * 3, reach_px=1.0).particle.size == 0


@pytest.mark.parametrize("choice", [{"reach_px": 0.0}, {"memory": -1}, {"persistence": 1.5}])
def test_wrong_choices_are_refused(choice):
    with pytest.raises(InputError, match="reach_px must be above 0"):
        link_particles([], **{"reach_px": 1.0, **choice})
