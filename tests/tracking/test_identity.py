"""Which point is which: scenes that jump, patterns that repeat, light that is uneven."""

import numpy as np
import pytest

from haselab.tracking import LossReason, PointTracker, TrackOptions
from haselab.tracking.audit import expected_wrong, wrong_share
from haselab.tracking.guided import GuidedTracker, find_guides
from haselab.tracking.particles.follow import ParticleTracker

TOGETHER = TrackOptions(model="neighbours")
REST = 5
# 0.1 px are six deviations of a dot's displacement in this noise; the next dot is 20 px away
CLOSE_PX = 0.1


def rotation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]]) - np.eye(2)


def followed(tracker, made, motions):
    """Largest error of the valid positions and their share, frame by frame."""
    state = tracker.init([made.frame() for _ in range(REST)])
    for motion in motions:
        state, found = tracker.step(state, made.frame(*motion))
        yield found, np.stack([found.x_px, found.y_px], axis=1) - made.place(*motion)


@pytest.mark.parametrize("shift", [(10.0, 0.0), (-8.0, 4.0), (23.7, -17.2), (0.0, 31.0)])
def test_dots_that_all_jump_keep_their_names(sheet, shift):
    made = sheet(7, 7)
    motions = [(np.zeros((2, 2)), shift), (np.zeros((2, 2)), (0.0, 0.0))] * 2
    for found, error in followed(PointTracker(made.rest_px, TOGETHER), made, motions):
        assert found.valid.mean() > 0.8  # of a jump to the edge, those near it leave
        assert np.nanmax(np.abs(error)) < CLOSE_PX


@pytest.mark.parametrize("gradient", [rotation(0.35), rotation(-0.2), 0.09 * np.eye(2)])
def test_a_sudden_turn_or_change_of_size_is_found(sheet, gradient):
    made = sheet(7, 7)
    still = np.zeros((2, 2))
    motions = [(gradient, (0.0, 0.0)), (still, (0.0, 0.0))]
    for found, error in followed(PointTracker(made.rest_px, TOGETHER), made, motions):
        assert found.valid.mean() > 0.9
        assert np.nanmax(np.abs(error)) < CLOSE_PX


def test_the_edge_of_a_grid_distinguishes_a_jump_from_the_same_less_a_pitch(sheet):
    made = sheet()
    x, y = np.meshgrid(np.arange(8) * 16.0 + 70.3, np.arange(8) * 16.0 + 60.3)
    grid = type(made)(np.stack([x.ravel(), y.ravel()], axis=1), rng=made.rng)
    motions = [(np.zeros((2, 2)), (10.0, 0.0)), (np.zeros((2, 2)), (0.0, 0.0))]
    for found, error in followed(PointTracker(grid.rest_px, TOGETHER), grid, motions):
        assert found.valid.all()
        assert np.abs(error).max() < CLOSE_PX


def test_a_jump_in_a_grid_without_end_is_ambiguous_and_a_slow_motion_is_not(sheet):
    made = sheet()
    x, y = np.meshgrid(np.arange(-3, 20) * 16.0 + 0.3, np.arange(-3, 19) * 16.0 + 0.3)
    grid = type(made)(np.stack([x.ravel(), y.ravel()], axis=1), rng=made.rng)
    middle = (np.abs(grid.rest_px - [130.0, 120.0]) < 50.0).all(axis=1)
    tracker = PointTracker(grid.rest_px[middle], TOGETHER)
    state = tracker.init([grid.frame() for _ in range(REST)])
    for k in range(1, 4):
        state, found = tracker.step(state, grid.frame(shift=(3.0 * k, 0.0)))
        assert found.valid.all()
        assert np.abs(found.x_px - grid.rest_px[middle, 0] - 3.0 * k).max() < CLOSE_PX
    for shift in (19.0, 9.0, 9.0):
        state, found = tracker.step(state, grid.frame(shift=(shift, 0.0)))
        assert not found.valid.any()
    assert np.mean((found.reason & LossReason.AMBIGUOUS) > 0) > 0.9


def test_a_sudden_loss_of_light_that_all_points_share_hides_none(sheet):
    made = sheet()
    tracker = PointTracker(made.rest_px, TOGETHER)
    state = tracker.init([made.frame() for _ in range(REST)])
    for level in (0.4, 0.35, 1.0):
        state, found = tracker.step(state, made.noisy(level * made.ideal()))
        assert found.valid.all()


def test_uneven_light_is_taken_out_at_a_cost_that_is_stated(sheet):
    made = sheet()
    y, x = np.mgrid[: made.shape[0], : made.shape[1]]
    light = 0.8 + 0.4 * np.exp(-((x - 130.0) ** 2 + (y - 120.0) ** 2) / (2 * 40.0**2))
    tracker = PointTracker(made.rest_px, TOGETHER)
    state = tracker.init([made.frame() for _ in range(10)])
    errors, stated = [], []
    for _ in range(8):
        state, found = tracker.step(state, made.noisy(light * made.ideal()))
        errors.append(np.stack([found.x_px, found.y_px], axis=1) - made.rest_px)
        stated.append(np.stack([found.std_x_px, found.std_y_px], axis=1))
    # 784 errors determine their rms to 3 %; slopes of 0.4 / 40 px would move dots by 0.2 px
    true = np.sqrt(np.mean(np.square(errors)))
    assert true < 0.03
    assert 0.8 < np.sqrt(np.mean(np.square(stated))) / true < 1.25


def test_points_that_scatter_more_than_the_noise_say_so(sheet):
    made = sheet()
    tracker = PointTracker(made.rest_px, TOGETHER)
    state = tracker.init([made.frame() for _ in range(REST)])
    rng = np.random.default_rng(9)
    errors, stated = [], []
    for _ in range(12):  # as a codec moves dots: each its own way, by more than the camera's noise
        shaken = type(made)(made.rest_px + rng.normal(0.0, 0.08, made.rest_px.shape), rng=rng)
        state, found = tracker.step(state, shaken.frame())
        kept = found.valid
        errors.append((np.stack([found.x_px, found.y_px], axis=1) - made.rest_px)[kept])
        stated.append(np.stack([found.std_x_px, found.std_y_px], axis=1)[kept])
    true = np.sqrt(np.mean(np.concatenate(errors) ** 2))
    assert true > 0.06
    assert 0.8 < np.sqrt(np.mean(np.concatenate(stated) ** 2)) / true < 1.25


def test_the_expected_share_of_wrong_positions_is_that_of_normal_errors():
    rng = np.random.default_rng(1)
    std = np.array([[0.2], [0.3]])
    away = np.abs(rng.normal(0.0, std, (2, 200_000)))
    # sum of both axes: an upper bound, nearly reached while both are rare
    share = np.mean((away > 0.5).any(axis=0))
    assert expected_wrong(std, 0.5)[0] == pytest.approx(share, rel=0.05)
    assert expected_wrong(np.zeros((2, 3)), 0.5).tolist() == [0.0, 0.0, 0.0]


def test_dots_around_a_few_points_identify_them(sheet):
    made = sheet(9, 9)
    points = made.rest_px[[21, 40, 59]]
    guides = find_guides(made.frame(), points, TrackOptions())
    assert len(guides) > 40
    tracker = GuidedTracker(points, guides, TrackOptions())
    state = tracker.init([made.frame() for _ in range(REST)])
    for k in range(6):
        shift = np.array([10.0, 0.0]) * (k % 2)
        state, found = tracker.step(state, made.frame(shift=shift))
        assert found.valid.all()
        error = np.stack([found.x_px, found.y_px], axis=1) - points - shift
        assert np.abs(error).max() < CLOSE_PX


def test_a_point_that_leaves_its_surroundings_is_followed_alone(sheet):
    made = sheet(9, 9)
    points = made.rest_px[[40]]
    guides = find_guides(made.frame(), points, TrackOptions())
    tracker = GuidedTracker(points, guides, TrackOptions())
    state = tracker.init([made.frame() for _ in range(REST)])
    for k in range(1, 5):
        place = made.rest_px.copy()
        place[40] += [0.0, 1.5 * k]
        state, found = tracker.step(state, type(made)(place, rng=made.rng).frame())
        assert found.valid.all()
        assert np.abs(found.y_px[0] - place[40, 1]) < 3 * CLOSE_PX  # another dot is in the subset


def test_particles_that_move_each_for_itself_keep_their_names_or_say_that_they_do_not(sheet):
    made = sheet(7, 7)
    rng = np.random.default_rng(4)
    tracker = ParticleTracker(made.rest_px)
    state = tracker.init([made.frame()])
    place = made.rest_px.copy()
    for _ in range(15):
        place = place + rng.normal(0.0, 1.0, place.shape)
        state, found = tracker.step(state, type(made)(place, rng=rng).frame())
        error = np.stack([found.x_px, found.y_px], axis=1) - place
        assert np.nanmax(np.abs(error)) < 0.5
    assert found.valid.mean() > 0.7
    for _ in range(12):  # steps of half a distance between dots: they cannot be distinguished
        place = place + rng.normal(0.0, 12.0, place.shape)
        state, found = tracker.step(state, type(made)(place, rng=rng).frame())
    assert not found.valid.any()


def test_the_expected_share_has_a_lower_limit_that_grows_with_the_lost_positions():
    assert wrong_share(1e-36, 1000, 1000) == 1e-4
    assert wrong_share(1e-36, 600, 1000) == pytest.approx(2e-3)
    assert wrong_share(12.0, 600, 1000) == pytest.approx(0.02)
    assert wrong_share(0.0, 0, 0) == 1e-4
