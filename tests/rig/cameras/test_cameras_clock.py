"""Times of frames: two clocks held together, an exposure signal, frames and their exposures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import DeviceError
from haselab.rig.cameras.clocks import ClockOffset, SlowOffset
from haselab.rig.cameras.pairing import ExposureLog, FramePairing
from haselab.rig.cameras.source import Shot
from haselab.rig.cameras.timed import TimedCamera, Timing

RATE_HZ = 200e3


# ---- two clocks ---------------------------------------------------------------------------------


def test_an_offset_and_a_drift_are_exact_where_one_reading_of_each_piece_is_in_time():
    offset, rng = ClockOffset(), np.random.default_rng(1)
    early_s = np.arange(0.0, 100.0, 0.05)
    late_s = 7.0 + early_s * (1.0 + 5e-5) + rng.exponential(0.004, early_s.size)
    late_s[::5] = 7.0 + early_s[::5] * (1.0 + 5e-5)  # pieces are of 0.25 s
    for early, late in zip(early_s, late_s, strict=True):
        offset.add(early, late)
    # Differences of numbers near 100 are exact to their spacing, and the line ends where it rests.
    assert offset.at(100.0) == pytest.approx(7.0 + 100.0 * 5e-5, abs=10 * np.spacing(107.0))
    assert offset.spread_s == pytest.approx(0.0, abs=10 * np.spacing(107.0))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), drift=st.floats(-1e-4, 1e-4), minutes=st.floats(0.1, 0.7))
def test_the_line_lies_between_the_truth_and_the_least_late_readings(seed, drift, minutes):
    """At the mean time of the record the lower hull is above the truth, and below all pieces."""
    rng, offset = np.random.default_rng(seed), ClockOffset()
    early_s = np.cumsum(rng.uniform(0.005, 0.03, round(60.0 * minutes / 0.0175)))
    delay_s = rng.exponential(0.003, early_s.size)
    for early, delay in zip(early_s, delay_s, strict=True):
        offset.add(early, 3.0 + early * (1.0 + drift) + delay)
    piece = ((early_s - early_s[0]) // 0.25).astype(int)
    ids = np.unique(piece)[-80:]
    least = [np.flatnonzero(piece == k)[delay_s[piece == k].argmin()] for k in ids]
    mean_s = early_s[least].mean()
    error_s = offset.at(mean_s) - (3.0 + drift * mean_s)
    # The least of a piece is chosen with the drift in it, which a piece of 0.25 s changes by this.
    slack_s = 0.25 * 1e-4 + 1e-9
    assert -slack_s <= error_s <= delay_s[least].max() + slack_s


def test_a_clock_that_was_set_is_followed_after_twenty_seconds():
    offset = ClockOffset()
    for k in range(200):
        offset.add(0.1 * k, 1.0 + 0.1 * k)
    for k in range(200, 404):
        offset.add(0.1 * k, 1.5 + 0.1 * k)
    assert offset.at(40.3) == pytest.approx(1.5, abs=1e-12)


@settings(max_examples=100, deadline=None)
@given(
    wanted=st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=30),
    step_s=st.floats(1e-4, 0.1),
)
def test_times_rise_however_the_offset_is_corrected(wanted, step_s):
    slow = SlowOffset()
    times = [k * step_s + slow.step(k * step_s, w) for k, w in enumerate(wanted)]
    # A tenth of the time may be corrected, so nine tenths are left.
    assert (np.diff(times) >= 0.9 * step_s - 1e-12).all()


# ---- exposure signal ----------------------------------------------------------------------------


def exposures(count: int, rate_hz: float, exposure_s: float, seed: int = 0) -> np.ndarray:
    """Begin and end of exposures whose phase to the samples is any."""
    rng = np.random.default_rng(seed)
    start_s = 2e-3 + np.arange(count) / rate_hz + rng.uniform(-2e-5, 2e-5, count)
    return np.stack([start_s, start_s + exposure_s], axis=1)


# ---- frames and exposures -----------------------------------------------------------------------


def record(log: ExposureLog, edges_s: np.ndarray, from_s: float, until_s: float) -> None:
    """Tell a log the exposures that a board has recorded from one time to another."""
    ended = (edges_s[:, 1] > from_s) & (edges_s[:, 1] <= until_s)
    log.add(edges_s[ended].mean(axis=1), until_s)


@pytest.mark.parametrize("latency_s", [0.0, 1e-3, 6e-3])
def test_frames_get_their_exposures_however_late_and_unsteady_they_come(latency_s):
    edges_s = exposures(60, 100.0, 2e-3)
    middle_s = edges_s.mean(axis=1)
    pairing = FramePairing(log := ExposureLog(0.5 / RATE_HZ), 0.01)
    record(log, edges_s, -np.inf, 0.65)
    jitter_s = np.random.default_rng(2).uniform(-1e-3, 1e-3, 60)
    got = [pairing.match(m + latency_s + j) for m, j in zip(middle_s, jitter_s, strict=True)]
    np.testing.assert_allclose(got, middle_s, rtol=0.0, atol=0.5 / RATE_HZ)
    assert pairing.lost == 0


def test_a_lost_frame_is_counted_and_the_next_keeps_its_own_exposure():
    edges_s = exposures(40, 100.0, 2e-3)
    middle_s = edges_s.mean(axis=1)
    pairing = FramePairing(log := ExposureLog(0.5 / RATE_HZ), 0.01)
    record(log, edges_s, -np.inf, 0.45)
    seen = np.setdiff1d(np.arange(40), [0, 1, 10, 11, 12, 25])
    got = [pairing.match(middle_s[k] + 2e-3) for k in seen]
    np.testing.assert_allclose(got, middle_s[seen], rtol=0.0, atol=0.5 / RATE_HZ)
    assert pairing.lost == 4  # the first two were before the first frame


def test_a_frame_waits_for_the_block_with_its_exposure():
    edges_s = exposures(5, 100.0, 2e-3)
    pairing = FramePairing(log := ExposureLog(0.5 / RATE_HZ), 0.01)
    record(log, edges_s, -np.inf, 0.003)
    frame_s = edges_s[0].mean()
    assert pairing.match(frame_s) is None
    record(log, edges_s, 0.003, 0.01)
    assert pairing.match(frame_s) == pytest.approx(edges_s[0].mean(), abs=0.5 / RATE_HZ)


def test_frames_without_a_signal_are_reported():
    log = ExposureLog(0.5 / RATE_HZ)
    record(log, np.empty((0, 2)), -np.inf, 0.1)
    with pytest.raises(DeviceError, match=r"has no exposure in the recorded signal .*wire"):
        FramePairing(log, 0.01).match(0.05)


# ---- a camera on the acquisition's clock --------------------------------------------------------


@dataclass
class Scripted:
    """A driver whose frames are what the test puts there."""

    identity: str = "test camera"
    dropped: int = 0
    jitter_s: float = 0.0
    shots: list[Shot] = field(default_factory=list)
    stops: int = 0

    def start(self, rate_hz: float) -> None:
        self.shots = []

    def take(self) -> list[Shot]:
        taken, self.shots = self.shots, []
        return taken

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass

    def expose(self, host_s: float) -> None:
        self.shots.append(Shot(np.full((2, 3), len(self.shots), np.uint8), host_s))


class Bench:
    """The computer's clock is 50 s ahead of the acquisition's, whose blocks are of 10 ms."""

    def __init__(self, timing: Timing, exposures: ExposureLog | None = None) -> None:
        self.now_s = 50.0
        self.source = Scripted()
        self.camera = TimedCamera(
            self.source, self.clock, timing, now=lambda: self.now_s, exposures=exposures
        )

    def clock(self) -> tuple[float, float]:
        blocks = round((self.now_s - 50.0) / 0.01 - 0.5 + 1e-9)
        return max(blocks, 0) * 0.01, self.now_s


def test_frames_come_with_the_block_of_their_time_and_on_its_clock():
    bench = Bench(Timing(latency_s=2e-3))
    bench.camera.start(100.0)
    times = []
    for k in range(1, 40):
        bench.now_s = 50.0 + 0.01 * k
        bench.source.expose(bench.now_s - 0.005 + 2e-3)  # exposed in the middle of the block
        frames = bench.camera.take()
        assert frames is not None and frames.time_s[-1] <= bench.clock()[0]
        times.append(frames.time_s)
    expected_s = 0.01 * np.arange(1, 40) - 0.005
    np.testing.assert_allclose(np.concatenate(times), expected_s, rtol=0.0, atol=1e-9)
    assert bench.camera.uncertainty_s == pytest.approx(0.0, abs=1e-9)


def test_a_frame_of_a_block_to_come_is_held_back():
    bench = Bench(Timing(latency_s=0.0))
    bench.camera.start(100.0)
    bench.now_s = 50.0100
    bench.camera.take()
    bench.source.expose(50.015)
    bench.now_s = 50.0180
    assert bench.camera.take() is None
    bench.now_s = 50.0200
    frames = bench.camera.take()
    assert frames is not None and frames.time_s == pytest.approx([0.015], abs=1e-9)


def test_an_unknown_latency_is_reported_as_a_period():
    bench = Bench(Timing())
    bench.camera.start(50.0)
    assert bench.camera.uncertainty_s >= 1.0 / 50.0


def test_a_camera_that_stalls_is_reported_after_its_timeout_and_not_before():
    bench = Bench(Timing(timeout_s=0.5))
    bench.camera.start(100.0)
    for k in range(1, 51):
        bench.now_s = 50.0 + 0.01 * k
        if k <= 10:
            bench.source.expose(bench.now_s)
        bench.camera.take()
    bench.now_s = 50.0 + 0.1 + 0.499
    assert bench.camera.take() is None
    bench.now_s = 50.0 + 0.1 + 0.501
    with pytest.raises(DeviceError, match=r"test camera: no frame for 0.501 s\. Check its cable"):
        bench.camera.take()
    bench.camera.stop()
    bench.camera.start(100.0)
    assert bench.camera.take() is None


def test_a_slow_camera_has_three_periods_before_it_is_said_to_stall():
    bench = Bench(Timing(timeout_s=0.5))
    bench.camera.start(1.0)
    for k in range(1, 6):
        bench.now_s = 50.0 + 0.6 * k
        assert bench.camera.take() is None
    bench.now_s = 53.1
    with pytest.raises(DeviceError, match=r"no frame for 3.1 s"):
        bench.camera.take()


def test_a_program_that_was_not_run_takes_the_camera_for_no_silent_one():
    bench = Bench(Timing(timeout_s=0.5))
    bench.camera.start(100.0)
    for k in range(1, 4):
        bench.now_s = 50.0 + 10.0 * k
        assert bench.camera.take() is None
        bench.source.expose(bench.now_s)
        bench.camera.take()


def test_lost_frames_are_counted_and_too_many_of_them_end_the_recording():
    bench = Bench(Timing(most_dropped=0.1))
    bench.camera.start(100.0)
    for k in range(1, 100):
        bench.now_s = 50.0 + 0.01 * k
        bench.source.expose(bench.now_s)
        bench.camera.take()
    bench.source.dropped = 11
    bench.camera.take()
    assert bench.camera.dropped == 11
    bench.source.dropped = 12
    with pytest.raises(DeviceError, match=r"12 of 111 frames are lost \(limit: a fraction of 0.1"):
        bench.camera.take()


def test_frames_whose_blocks_are_not_read_do_not_fill_the_memory():
    bench = Bench(Timing(buffer_s=0.2))
    bench.camera.start(100.0)
    bench.now_s = 50.01
    bench.camera.take()
    bench.clock = lambda: (0.01, bench.now_s)  # type: ignore[method-assign]
    bench.camera._clock = bench.clock
    with pytest.raises(DeviceError, match=r"71 frames are waiting for blocks that have not been"):
        for k in range(1, 200):
            bench.now_s = 50.02 + 0.01 * k
            bench.source.expose(bench.now_s)
            bench.camera.take()


def test_a_camera_whose_clock_goes_back_is_reported():
    bench = Bench(Timing())
    bench.camera.start(100.0)
    bench.now_s = 50.1
    bench.source.expose(50.06)
    bench.source.expose(50.05)
    with pytest.raises(DeviceError, match=r"a frame is 0.01 s earlier than the frame before it"):
        bench.camera.take()


def test_with_an_exposure_signal_the_times_are_the_acquisitions():
    edges_s = exposures(40, 100.0, 2e-3)
    log = ExposureLog(0.5 / RATE_HZ)
    bench = Bench(Timing(), log)
    jitter_s = np.random.default_rng(5).uniform(0.0, 2e-3, 40)
    bench.camera.start(100.0)
    arrived = list(edges_s[:, 1] + 1e-3 + jitter_s)
    times = []
    for k in range(45):
        bench.now_s = 50.0 + 0.01 * (k + 1)
        record(log, edges_s, 0.01 * k, 0.01 * (k + 1))
        while arrived and 50.0 + arrived[0] <= bench.now_s:
            bench.source.expose(50.0 + arrived.pop(0))
        frames = bench.camera.take()
        if frames is not None:
            times.append(frames.time_s)
    found_s = np.concatenate(times)
    np.testing.assert_allclose(found_s, edges_s.mean(axis=1), rtol=0.0, atol=0.5 / RATE_HZ)
    assert bench.camera.uncertainty_s == 0.5 / RATE_HZ and bench.camera.dropped == 0
