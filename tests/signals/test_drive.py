"""Drive signals: the values of the study, and the properties of their kind."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.signals import constant, linear_chirp, triangle


def test_the_triangle_of_the_study_has_five_cycles_in_twenty_seconds():
    """Row S2: 0 to 2 V, 0.25 Hz, one value every 10 ms."""
    drive = triangle(0.0, 2.0, 0.25, 5, 100.0)
    assert drive.size == 2000
    assert (drive.min(), drive.max()) == (0.0, 2.0)
    peaks = np.flatnonzero(drive == 2.0)
    assert (peaks / 100).tolist() == [2.0, 6.0, 10.0, 14.0, 18.0]
    # 2 V in 2 s, so 10 mV a value, up or down; the sums are exact to a few roundings of 2 V.
    np.testing.assert_allclose(np.abs(np.diff(drive)), 0.01, atol=1e-13)


@given(
    low=st.floats(-10, 10),
    span=st.floats(0, 10),
    cycles=st.integers(1, 5),
    samples=st.integers(2, 200),
)
def test_a_triangle_stays_between_its_ends_and_repeats(low, span, cycles, samples):
    high = low + span
    drive = triangle(low, high, 1.0, cycles, float(2 * samples))
    assert drive.size == 2 * samples * cycles
    slack = 4e-16 * (abs(low) + span)
    assert drive.min() >= low - slack
    assert drive.max() <= high + slack
    periods = drive.reshape(cycles, -1)
    np.testing.assert_allclose(periods, periods[[0] * cycles], atol=1e-13 * (1 + span) * cycles)


def test_the_chirp_sweeps_its_frequency_in_a_straight_line():
    """The phase's second difference, from an analytic signal by quadrature, is the sweep rate."""
    rate_hz, duration_s, start_hz, stop_hz = 1000.0, 10.0, 0.1, 10.0
    sine = linear_chirp(start_hz, stop_hz, duration_s, rate_hz)
    time_s = np.arange(sine.size) / rate_hz
    crossings_s = time_s[1:][(sine[:-1] < 0) & (sine[1:] >= 0)]
    # n whole turns after the start: f0 t + (f1 - f0) t^2 / 2T = n. A crossing is read to a sample.
    turns = start_hz * crossings_s + (stop_hz - start_hz) * crossings_s**2 / (2 * duration_s)
    assert np.abs(turns - np.arange(1, turns.size + 1)).max() < stop_hz / rate_hz
    assert turns.size == int(0.5 * (start_hz + stop_hz) * duration_s)


@given(start_hz=st.floats(0, 10), stop_hz=st.floats(0, 10))
def test_a_chirp_is_a_sine_of_unit_amplitude_from_zero(start_hz, stop_hz):
    sine = linear_chirp(start_hz, stop_hz, 2.0, 100.0)
    assert sine[0] == 0.0
    assert np.abs(sine).max() <= 1.0


@pytest.mark.parametrize(("start_hz", "stop_hz"), [(-1.0, 10.0), (0.1, 50.0), (60.0, 1.0)])
def test_a_chirp_beyond_half_the_update_rate_is_refused(start_hz, stop_hz):
    with pytest.raises(InputError, match=r"needs frequencies in \[0, 50\) Hz"):
        linear_chirp(start_hz, stop_hz, 1.0, 100.0)


@pytest.mark.parametrize(("duration_s", "rate_hz"), [(0.0, 100.0), (-1.0, 100.0), (1.0, 0.0)])
def test_a_signal_without_a_sample_is_refused(duration_s, rate_hz):
    with pytest.raises(InputError, match="gives no sample"):
        constant(1.0, duration_s, rate_hz)
