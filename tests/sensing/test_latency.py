"""The output's latency: from synthetic steps, from the twin's monitor, and refused inputs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.sensing import latency, step_latencies

N, RATE_HZ = 200, 20e3


def monitor(drive_v: np.ndarray, delay: int, noise_v: float, carrier_v: float = 0.0) -> np.ndarray:
    """A held drive, so many samples late, with carrier and noise."""
    held = np.repeat(drive_v, N)
    late = np.concatenate([np.full(delay, held[0]), held])[: held.size]
    t = np.arange(held.size) / RATE_HZ
    noise = np.random.default_rng(1).normal(0.0, noise_v, held.size)
    return (late + carrier_v * np.sin(2 * np.pi * 1e3 * t) + noise).reshape(-1, N)


@given(
    st.integers(0, 9 * N), st.floats(0.2, 2.0), st.sampled_from([-1.0, 1.0]),
    st.floats(-1.0, 1.0), st.integers(2, 20),
)  # fmt: skip
def test_a_step_is_timed_to_the_sample_at_any_delay_height_and_sign(delay, height, sign, rest, at):
    drive_v = np.r_[np.full(at, rest), np.full(14, rest + sign * height)]
    times_s = step_latencies(monitor(drive_v, delay, 1e-3, 0.02), drive_v, RATE_HZ)
    assert times_s.shape == (1,)
    # The middle of a jump between two samples lies within the sample before its first one.
    assert delay - 1.0 <= times_s[0] * RATE_HZ <= delay


def test_only_steps_that_stand_before_and_after_count():
    drive_v = np.r_[np.zeros(5), np.ones(20), 2.0 * np.ones(3), np.zeros(20), 0.01 * np.ones(20)]
    times_s = step_latencies(monitor(drive_v, 30, 1e-3, 0.02), drive_v, RATE_HZ)
    # To 1 V and back to 0 V; 2 V stood too short a time, 10 mV drown in the carrier.
    np.testing.assert_allclose(times_s * RATE_HZ, 29.5, atol=0.5)
    assert times_s.shape == (2,)
    late = np.r_[np.zeros(5), np.ones(20)]
    assert step_latencies(monitor(late, 13 * N, 1e-3), late, RATE_HZ).size == 0
    assert step_latencies(np.zeros((30, N)), np.r_[np.zeros(9), np.ones(21)], RATE_HZ).size == 0
    assert latency(np.empty(0), RATE_HZ) is None


def test_the_median_holds_against_one_wrong_step():
    found = latency(np.array([2.0e-3, 2.0e-3, 2.0e-3, 2.0e-3, 9.0e-3]), 200e3)
    assert found.value == 2.0e-3
    assert found.std > 1e-4  # and the spread is reported


@pytest.mark.parametrize("delay_s", [0.5e-3, 2e-3, 4.5e-3])
def test_the_twin_shows_the_delay_that_it_was_given(delay_s):
    config = TwinConfig()
    daq = config.acquisition.model_copy(update={"output_delay_s": delay_s})
    rig = make_twin(config.model_copy(update={"acquisition": daq}), 3)
    d = rig.description
    # So small that the amplifier's current limit plays no part.
    drive_v = np.r_[np.zeros(3), np.full(15, 0.1)]
    blocks = []
    for value in drive_v:
        rig.source.write(float(value))
        blocks.append(rig.acquisition.read()[:, 0])
    volt = d.volt_per_code / (d.v_monitor_v_per_v * d.amplifier_gain)
    found = latency(step_latencies(np.array(blocks) * volt, drive_v, d.rate_hz), d.rate_hz)
    # An amplifier of 6 kHz and damping 0.6 is half-way 1.3 / (2 pi 6 kHz) after its input's step,
    # which is held from one sample of 5 us to the next.
    assert found.value - delay_s == pytest.approx(1.3 / (2 * np.pi * 6e3), abs=5e-6)


@pytest.mark.parametrize("shape", [(10,), (9, N), (10, N, 2)])
def test_shapes_that_do_not_fit_are_refused(shape):
    with pytest.raises(InputError, match=r"must be \(B, N\) and \(B,\)"):
        step_latencies(np.zeros(shape), np.zeros(10), RATE_HZ)
