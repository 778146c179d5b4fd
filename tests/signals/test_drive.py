"""Drive signals: the values of the study, and the properties of their kind."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.signals import constant, linear_chirp, multisine, prbs, square, triangle


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


@given(flips=st.integers(1, 50), periods=st.integers(1, 20))
def test_a_square_holds_each_sign_for_half_a_period(flips, periods):
    signs = square(50.0 / flips, periods * flips / 50.0, 100.0)
    assert signs.size == 2 * flips * periods
    np.testing.assert_array_equal(signs.reshape(periods, 2, flips)[:, 0], 1.0)
    np.testing.assert_array_equal(signs.reshape(periods, 2, flips)[:, 1], -1.0)


@pytest.mark.parametrize("length", range(5, 17))
def test_a_pseudo_random_sequence_is_of_maximal_length(length):
    """One more plus than minus, and an autocorrelation of -1 at every lag but zero."""
    bits = 2**length - 1
    signs = prbs(0.01, bits / 100.0, 100.0)
    assert (signs.size, signs.sum()) == (bits, 1.0)
    correlation = np.fft.ifft(np.abs(np.fft.fft(signs)) ** 2).real
    np.testing.assert_allclose(correlation[1:], -1.0, atol=1e-6)


def test_bits_are_held_for_whole_updates():
    signs = prbs(0.05, 3.0, 100.0)
    changes = np.flatnonzero(np.diff(signs)) + 1
    assert (changes % 5 == 0).all()
    assert changes.size > 10


def test_a_multisine_has_its_lines_with_their_powers_and_a_low_crest():
    """A periodic sum: each line stands alone in the transform. Random phases give crests near 3."""
    lines_hz = np.arange(1, 21) / 10.0
    power = np.linspace(1.0, 3.0, 20)
    x = multisine(lines_hz, 10.0, 100.0, power)
    spectrum = np.abs(np.fft.rfft(x)) ** 2
    np.testing.assert_allclose(spectrum[1:21] / spectrum[1], power, rtol=1e-9)
    assert spectrum[21:].max() < 1e-18 * spectrum[1:21].max()
    assert np.abs(x).max() == 1.0
    assert 1.0 / x.std() < 2.3


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: square(51.0, 1.0, 100.0), r"must have a frequency in \(0, 50\] Hz"),
        (lambda: prbs(0.001, 1.0, 100.0), "bits must be 0.01 s or longer"),
        (lambda: prbs(0.01, 1.0, 100.0, 0), "from start 0"),
        (lambda: multisine([60.0], 1.0, 100.0), r"must have lines in \(0, 50\) Hz"),
        (lambda: multisine([6.0], 1.0, 100.0, [0.0]), "some above 0"),
    ],
)
def test_signals_that_cannot_be_are_refused(make, match):
    with pytest.raises(InputError, match=match):
        make()
