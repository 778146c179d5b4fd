"""Frame rate, time stamps, data rate and the edge of an exposure: what follows from numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import DeviceError
from haselab.rig.cameras.data_rate import LinkLoad
from haselab.rig.cameras.frame_rate import FrameRateMeter
from haselab.rig.cameras.pairing import ExposureTrial, starts_with_edge
from haselab.rig.cameras.stamps import StampedClock


def metered(times_s: np.ndarray) -> FrameRateMeter:
    meter = FrameRateMeter()
    for time_s in times_s:
        meter.add(float(time_s))
    return meter


@settings(derandomize=True)  # more lost frames than that are refused before
@given(
    rate_hz=st.floats(1.0, 1000.0),
    lost=st.floats(0.0, 0.2),
    seed=st.integers(0, 2**16),
)
def test_lost_frames_and_scatter_do_not_change_the_measured_rate(rate_hz, lost, seed):
    random = np.random.default_rng(seed)
    period_s = 1.0 / rate_hz
    kept = np.flatnonzero(random.random(400) >= lost)
    times_s = period_s * (kept + random.uniform(-0.05, 0.05, kept.size))
    # The scatter counts at both ends of at least 128 intervals: 0.1 / 128 of a period.
    assert metered(times_s).rate_hz == pytest.approx(rate_hz, rel=0.1 / 128 + 1e-9)


def test_a_few_frames_give_no_rate():
    meter = metered(0.01 * np.arange(32))
    assert (meter.known, meter.rate_hz, meter.scatter_s) == (False, 0.0, 0.0)


def test_stamps_take_the_scatter_of_arrivals_out():
    random = np.random.default_rng(3)
    clock = StampedClock()
    late_s = np.abs(random.normal(0.0, 1e-3, 400))
    true_s = 0.01 * np.arange(400)
    told_s = [
        clock.host_s(round(1e9 * (50.0 + t)), 7.0 + t + late)[0]
        for t, late in zip(true_s, late_s, strict=True)
    ]
    off_s = np.array(told_s) - true_s - 7.0
    assert np.ptp(off_s[100:]) < 0.2 * np.ptp(late_s)
    assert (np.diff(told_s) > 0.0).all()
    assert clock.stamped and not clock.has_no_clock


@pytest.mark.parametrize("tick_hz", [125e6, 66.6666667e6, 1e6, 8e9])
def test_stamps_in_ticks_are_named_with_their_frequency(tick_hz):
    clock = StampedClock()
    with pytest.raises(DeviceError, match="are ticks of") as caught:
        film(clock, tick_hz)
    assert f"about {tick_hz:.4g} Hz" in str(caught.value)
    known = StampedClock(tick_hz)
    film(known, tick_hz)
    assert known.stamped


def film(clock: StampedClock, tick_hz: float) -> None:
    for k in range(1, 200):
        clock.host_s(round(tick_hz * 0.01 * k), 3.0 + 0.01 * k)


def test_stamps_that_stand_still_are_named():
    clock = StampedClock()
    clock.host_s(5_000_000, 1.0)
    with pytest.raises(DeviceError, match=r"do not rise: 0\.005 s follows 0\.005 s.*arrival"):
        clock.host_s(5_000_000, 1.01)


def test_without_stamps_the_arrivals_count_and_their_scatter_is_reported():
    clock = StampedClock()
    random = np.random.default_rng(1)
    for k in range(100):
        arrived_s = 0.01 * k + random.uniform(0.0, 2e-3)
        assert clock.host_s(0, arrived_s) == (arrived_s, arrived_s)
    assert clock.has_no_clock
    # Differences of two uniform numbers of 2 ms: half of them are within 0.59 ms of 0.
    assert 0.3e-3 < clock.jitter_s < 0.9e-3


def test_arrival_can_be_chosen_over_a_camera_s_bad_clock():
    clock = StampedClock(use_stamps=False)
    for k in range(100):
        clock.host_s(7, 0.01 * k)
    assert not clock.has_no_clock and not clock.stamped


@pytest.mark.parametrize("stall", [(0, 150), (1, 40), (100, 250)])
@pytest.mark.parametrize("scatter_s", [1e-5, 1e-3])
def test_a_stall_of_the_computer_is_no_fault_of_the_stamps(stall, scatter_s):
    clock = StampedClock()
    random = np.random.default_rng(2)
    first, after = stall
    seen_s = 0.0
    for k in range(1, 600):
        came_s = 0.01 * (after if first <= k < after else k)  # then all come at once
        seen_s = max(seen_s + 5e-5, came_s + scatter_s * random.random())
        exposed_s, _ = clock.host_s(round(1e7 * k), seen_s)
    # The first frames may be late; the last ones come on time, but for the scatter.
    assert clock.stamped
    assert abs(exposed_s - seen_s) < max(scatter_s, 1e-4)


def test_four_hundred_frames_of_512_by_512_take_nine_tenths_of_a_gigabit():
    load = LinkLoad(512 * 512, 400.0, 1500, 1e9)
    assert load.byte_s == pytest.approx(104.9e6, rel=1e-3)
    # 1,464 bytes of picture in 1,538 on the wire (38 of Ethernet, 36 of IP, UDP and GVSP).
    assert load.share == pytest.approx(8 * 104.8576e6 * 1538 / 1464 / 1e9)
    assert LinkLoad(512 * 512, 400.0, 9000, 1e9).share < load.share
    assert LinkLoad(512 * 512, load.most_hz, 1500, 1e9).share == pytest.approx(1.0)


@given(
    latency_s=st.floats(0.0, 5e-3),
    short_s=st.floats(1e-4, 5e-3),
    more_s=st.floats(2e-3, 2e-2),
    delay_s=st.floats(-5e-3, 5e-3),
)
def test_two_exposure_times_show_which_edge_is_recorded(latency_s, short_s, more_s, delay_s):
    """By the times themselves: edge, middle and arrival, and a delay of all blocks."""

    def trial(exposure_s: float, *, begins: bool) -> ExposureTrial:
        arrival_s = exposure_s + latency_s + delay_s  # exposed from 0 on
        edge_s = 0.0 if begins else exposure_s
        return ExposureTrial(exposure_s, arrival_s - 0.5 * exposure_s - edge_s - 0.5 * exposure_s)

    for begins in (True, False):
        pair = [trial(e, begins=begins) for e in (short_s, short_s + more_s)]
        assert starts_with_edge(*pair, uncertainty_s=2e-4) is begins


def test_two_equal_exposures_show_nothing():
    assert starts_with_edge(ExposureTrial(1e-3, 0.0), ExposureTrial(1.1e-3, 0.0), 1e-4) is None
