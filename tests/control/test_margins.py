"""Margins against published figures, python-control and the poles of the closed loop."""

import math

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import LimitError
from haselab.control.gains import PidGains
from haselab.control.stability.margins import loop_response, margins
from haselab.models.plant import Plant, SlowMode

PAPER = Plant(0.5, math.sqrt(26.14), 0.93 / (2.0 * math.sqrt(26.14)))
PAPER_PI = PidGains(0.85, 1.5)
CREEPING = Plant(0.5, 5.11, 0.09, slow_modes=(SlowMode(0.4, 4.7),))


def transfer_function(plant: Plant, gains: PidGains) -> control.TransferFunction:
    s = control.tf("s")
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    total = plant.gain * wn**2 / (s**2 + 2 * zeta * wn * s + wn**2)
    for mode in plant.slow_modes:
        total = total + mode.gain / (mode.time_constant_s * s + 1)
    derivative = gains.kd * s / (gains.derivative_filter_s * s + 1)
    return total * (gains.kp + gains.ki / s + derivative)


def test_the_papers_loop_has_the_published_margins():
    found = margins(PAPER, PAPER_PI, loop_delay_s=0.0, rate_hz=None)
    # Known to 8 digits from two other programs; half a unit of the last digit printed.
    assert found.phase_margin_deg == pytest.approx(12.603864, abs=5e-7)
    assert 10 ** (found.gain_margin_db / 20) == pytest.approx(2.6215645, abs=5e-8)
    assert found.gain_margin_rad_s == pytest.approx(7.4339943, abs=5e-8)
    crossovers = [item.omega_rad_s for item in found.crossovers]
    assert crossovers == pytest.approx([0.85759, 3.79581, 6.02258], abs=5e-6)
    assert 1.0 / found.peak_sensitivity == pytest.approx(0.19709, abs=5e-6)
    assert found.peak_sensitivity_rad_s == pytest.approx(6.116, abs=5e-4)
    assert found.delay_margin_s == pytest.approx(0.0365, abs=5e-5)
    assert found.stable


def test_the_largest_stable_integral_gain_is_the_published_one():
    assert margins(PAPER, PidGains(0.85, 2.6504), loop_delay_s=0.0, rate_hz=None).stable
    assert not margins(PAPER, PidGains(0.85, 2.6506), loop_delay_s=0.0, rate_hz=None).stable


@pytest.mark.parametrize(
    "gains", [PAPER_PI, PidGains(0.3, 0.8), PidGains(0.5, 1.0, 0.4, 0.05), PidGains(1.5, 2, 0.1)]
)
@pytest.mark.parametrize("plant", [PAPER, CREEPING])
def test_continuous_margins_agree_with_python_control(plant, gains):
    found = margins(plant, gains, loop_delay_s=0.0, rate_hz=None)
    theirs = control.stability_margins(transfer_function(plant, gains), returnall=True)
    factors, phases, distances, _, omegas, _ = theirs
    assert [item.omega_rad_s for item in found.crossovers] == pytest.approx(omegas, rel=1e-8)
    assert [abs(item.phase_margin_deg) for item in found.crossovers] == pytest.approx(
        [abs((phase + 180) % 360 - 180) for phase in phases], abs=1e-6
    )
    upward = [factor for factor in factors if factor > 1.0]
    expected = 20 * math.log10(min(upward)) if upward else math.inf
    assert found.gain_margin_db == pytest.approx(expected, abs=1e-7)
    assert 1.0 / found.peak_sensitivity == pytest.approx(min(distances), rel=1e-8)


def closed_loop_radius(plant: Plant, gains: PidGains, rate_hz: float) -> float:
    """Largest pole of the sampled loop with one whole sample of delay, by python-control."""
    z = control.tf([1, 0], [1], 1 / rate_hz)
    sampled = control.c2d(transfer_function(plant, PidGains(1.0, 0.0)), 1 / rate_hz, "zoh") / z
    tau, period = gains.derivative_filter_s, 1 / rate_hz
    law = (
        gains.kp + gains.ki * period * z / (z - 1) + gains.kd * (z - 1) / ((tau + period) * z - tau)
    )
    closed = control.minreal(sampled * law / (1 + sampled * law), verbose=False)
    return float(np.abs(closed.poles()).max())


@pytest.mark.parametrize("kp", [0.5, 4.0, 12.0])
@pytest.mark.parametrize("kd", [0.0, 0.3])
@pytest.mark.parametrize("ki", [0.5, 5.0])
def test_nyquist_count_of_the_sampled_loop_agrees_with_its_poles(kp, kd, ki):
    gains = PidGains(kp, ki, kd, 0.02)
    radius = closed_loop_radius(PAPER, gains, 100.0)
    assert abs(radius - 1.0) > 1e-6
    found = margins(PAPER, gains, loop_delay_s=0.01, rate_hz=100.0)
    assert found.stable == (radius < 1.0)
    assert (found.phase_margin_deg > 0.0) == found.stable


def test_sampled_response_equals_the_discrete_plant_of_python_control():
    omega = np.array([0.3, 5.0, 40.0, 200.0])
    exact = control.c2d(transfer_function(CREEPING, PidGains(1.0, 0.0)), 0.01, "zoh")
    expected = [
        complex(exact(np.exp(1j * value * 0.01))) * np.exp(-1j * value * 0.01) for value in omega
    ]
    gains = PidGains(1.0, 0.0)
    found = loop_response(CREEPING, gains, omega, loop_delay_s=0.01, rate_hz=100.0)
    np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_sampled_response_is_hold_and_delay_where_aliases_are_small():
    """The hold is half a sample of delay and a sinc; aliases add (omega / 2 pi rate)^2 here."""
    omega = np.array([0.5, 2.0, 8.0])
    found = loop_response(PAPER, PidGains(1.0, 0.0), omega, loop_delay_s=0.0073, rate_hz=100.0)
    hold = np.sinc(omega * 0.01 / (2 * np.pi)) * np.exp(-1j * omega * (0.005 + 0.0073))
    alias = 2.0 * (omega / (2 * np.pi * 100.0)) ** 2
    assert np.all(np.abs(found / (hold * PAPER.frequency_response(omega)) - 1.0) < alias)


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(st.floats(0.1, 1.2), st.floats(0.1, 2.0), st.floats(0.0, 0.02))
def test_the_delay_margin_is_where_the_loop_loses_stability(kp, ki, delay_s):
    gains = PidGains(kp, ki)
    start = margins(PAPER, gains, loop_delay_s=delay_s, rate_hz=None)
    if not start.stable:
        return
    inside = margins(
        PAPER, gains, loop_delay_s=delay_s + 0.999 * start.delay_margin_s, rate_hz=None
    )
    beyond = margins(
        PAPER, gains, loop_delay_s=delay_s + 1.001 * start.delay_margin_s, rate_hz=None
    )
    assert inside.stable and not beyond.stable


def test_a_loop_that_never_reaches_gain_one_has_no_crossover():
    found = margins(PAPER, PidGains(0.1, 0.0), loop_delay_s=0.0, rate_hz=None)
    assert found.crossovers == () and math.isnan(found.crossover_rad_s)
    assert found.phase_margin_deg == math.inf and found.stable


def test_a_negative_delay_is_refused():
    with pytest.raises(LimitError, match=r"loop delay = -0\.01 s"):
        margins(PAPER, PAPER_PI, loop_delay_s=-0.01, rate_hz=None)


@pytest.mark.parametrize("delay_s", [0.0, 0.005, 0.010, 0.015, 0.020, 0.025])
def test_a_real_response_at_half_the_rate_is_no_crossing_to_be_solved_for(delay_s):
    """At half the rate the loop is real and its imaginary part is rounding alone."""
    plant = Plant(0.5, 32.107, 0.12, slow_modes=(SlowMode(0.4, 4.7),))
    found = margins(plant, PAPER_PI, loop_delay_s=delay_s, rate_hz=100.0)
    assert found.stable == (delay_s < 0.0145)
    assert np.isfinite(found.gain_margin_db)
