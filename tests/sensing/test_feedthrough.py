"""The feedthrough of a sensed strain, from records of fast motion."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.base import InputError
from haselab.models.plant import Plant, SlowMode
from haselab.sensing.feedthrough import fit_feedthrough

_PLANT = Plant(0.9, 40.0, 0.15, 0.0, (SlowMode(0.1, 3.0),))
_RUNS = 40


def _chirp(
    share: float, rng: np.random.Generator, late_s: float = 0.0, noise: float = 1e-5
) -> tuple[np.ndarray, ...]:
    """A chirp from 0.2 to 12 Hz about an offset: sensed 100 times and filmed 60 times a second."""
    rate, span = 100.0, 30.0
    begin = np.arange(0.0, span, 1.0 / rate)
    u = 0.01 * np.sin(2.0 * np.pi * (0.2 * begin + 0.5 * (12.0 - 0.2) / span * begin**2))
    sensed_s = begin + 0.006
    frame_s = np.arange(0.0, span, 1.0 / 60.0)
    moved = _PLANT.simulate(u, rate, np.maximum(sensed_s - late_s, 0.0))
    static = _PLANT.static_gain * u
    sensed = (1.0 - share) * moved + share * static + 0.002
    sensed += 2e-5 * rng.standard_normal(sensed.size)
    length = _PLANT.simulate(u, rate, frame_s)
    strain = length + noise * rng.standard_normal(frame_s.size)
    return sensed_s, sensed, static, frame_s, strain, length


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_the_share_is_within_its_interval_and_known_to_two_per_mille(share: float) -> None:
    rng = np.random.default_rng(1)
    found = [fit_feedthrough(*_chirp(share, rng)) for _ in range(_RUNS)]
    inside = [one.ci95[0] <= share <= one.ci95[1] for one in found]
    errors = [one.value - share for one in found]
    # 95 % of 40 with their binomial scatter: at least 33 in 99.9 % of the cases.
    assert np.abs(errors).max() < 0.002
    assert sum(inside) >= 33


def test_another_time_and_zero_of_the_camera_do_not_look_like_a_share() -> None:
    """2 ms between both measurements: without the fitted time it would be a share of 0.05."""
    rng = np.random.default_rng(2)
    found = fit_feedthrough(*_chirp(0.0, rng, late_s=0.002))
    assert abs(found.value) < 0.01
    assert found.value == pytest.approx(0.0, abs=4.0 * found.std + 0.005)


def test_lost_values_are_left_out_and_too_few_are_refused() -> None:
    rng = np.random.default_rng(3)
    time_s, sensed, static, frame_s, strain, length = _chirp(0.4, rng)
    sensed[::3] = np.nan
    found = fit_feedthrough(time_s, sensed, static, frame_s, strain, length)
    assert found.value == pytest.approx(0.4, abs=0.01)
    sensed[49:] = np.nan
    with pytest.raises(InputError, match="sensed strains are within the measured ones, but 50"):
        fit_feedthrough(time_s, sensed, static, frame_s, strain, length)


def test_noise_of_the_camera_does_not_look_like_a_share() -> None:
    """By least squares, this noise of half the motion made 0.3 a share of 0.4 or more."""
    rng = np.random.default_rng(4)
    found = [fit_feedthrough(*_chirp(0.3, rng, noise=4e-3)) for _ in range(_RUNS)]
    inside = sum(one.ci95[0] <= 0.3 <= one.ci95[1] for one in found)
    errors = np.array([one.value - 0.3 for one in found])
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(_RUNS) + 1e-3
    assert inside >= 33  # as above
    # the standard deviation also contains 0.01 for errors of a map, and half of the error of b
    assert np.median([one.std for one in found]) < 2.0 * errors.std() + 0.02


def test_a_wrong_static_gain_is_within_the_interval() -> None:
    """The gain of a large chirp near the resonance can be 12 % below that of slow motion."""
    rng = np.random.default_rng(5)
    time_s, sensed, static, frame_s, strain, length = _chirp(0.3, rng)
    found = fit_feedthrough(time_s, sensed, 0.88 * static, frame_s, strain, length)
    assert abs(found.value - 0.3) < 2.0 * found.std
    assert found.std < 0.05


def test_records_that_cannot_show_the_fraction_are_refused() -> None:
    rng = np.random.default_rng(6)
    time_s, sensed, static, frame_s, strain, length = _chirp(0.3, rng)
    on_frames = np.interp(frame_s, time_s, static)
    with pytest.raises(InputError, match="the motion is too slow to show"):
        fit_feedthrough(time_s, static, static, frame_s, on_frames, on_frames)
    noise = strain + 0.5 * rng.standard_normal(strain.size)
    with pytest.raises(InputError, match="Use a larger amplitude, or a better model"):
        fit_feedthrough(time_s, sensed, static, frame_s, noise, length)
    constant = np.zeros_like(static)
    with pytest.raises(InputError, match="the motion is too slow to show"):
        fit_feedthrough(time_s, sensed, constant, frame_s, 0.0 * length, 0.0 * length)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: (*r[:3], r[3][::-1], *r[4:]), "frame times must rise"),
        (lambda r: (*r[:3], r[3][:2], r[4][:2], r[5][:2]), "The 2 frame times must rise, and 50"),
        (lambda r: (r[0], r[1][:-1], *r[2:]), "Give one value of each for each time"),
        (lambda r: (*r[:4], r[4][1:], r[5]), "Give one value of each for each frame"),
        (lambda r: (*r[:2], r[2] * np.nan, *r[3:]), "A static strain is not finite"),
    ],
)
def test_records_that_do_not_fit_together_are_refused(change, message) -> None:
    record = _chirp(0.3, np.random.default_rng(7))
    with pytest.raises(InputError, match=message):
        fit_feedthrough(*change(record))


@pytest.mark.parametrize("until_s", [0.6, 1.0, 2.0, 4.0, 10.0])
def test_a_record_of_slow_motion_alone_has_a_wide_interval(until_s: float) -> None:
    """A chirp that was broken off: its first seconds contain less and less of the answer."""
    errors = []
    for seed in range(_RUNS):
        record = _chirp(0.3, np.random.default_rng(seed))
        shown = record[0] <= until_s
        found = fit_feedthrough(*(part[shown] for part in record[:3]), *record[3:])
        errors.append((found.value - 0.3) / found.std)
    assert np.count_nonzero(np.abs(errors) < 1.96) >= 33  # as above
