"""Physical limits against closed forms, and numbers of traces that are known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import ArrayLike

from haselab.actuators import ActuatorLaw, Losses, parameter
from haselab.base import Limits, ResultError
from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import (
    fastest_step,
    least_peak,
    least_tracking_error,
    mean_error,
    weight_error_kg,
)
from haselab.scoreboard.measures import (
    load_response,
    smoothed,
    step_response,
    tracking_error,
    variation_v_per_s,
)
from haselab.scoreboard.play import Trace

GRAVITY = 9.81
MASS_KG, PULL_N, STIFFNESS = 0.2, 4.0, 20.0


@dataclass(frozen=True)
class Slider(ActuatorLaw):
    """A mass on a weak spring that a field pulls with the same force at every length.

    With the weight balanced, the field pulls by +F or -F about equilibrium: a double integrator, as
    long as the spring is weak.
    """

    kind = "slider"
    stiffness: float = parameter(3.0, unit="N/m", low=0.0, high=1e3, description="spring")

    @property
    def free_length_m(self) -> float:
        return 1.0

    @property
    def length_limits_m(self) -> Limits:
        return Limits("length", 0.2, 2.0, "m")

    @property
    def losses(self) -> Losses:
        return Losses(damping_n_s_per_m=1e-9)

    def elastic_energy_j(self, length_m: ArrayLike):
        """The weight is held by a constant force, and half of the field's force as well."""
        x = np.asarray(length_m)
        held_n = MASS_KG * GRAVITY + 0.5 * PULL_N
        return 0.5 * self.stiffness * (x - 1.0) ** 2 + held_n * x

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0):
        return 1e-9 + 2.0 * PULL_N / 1e8 * np.asarray(length_m) + 0.0 * np.asarray(voltage_v)

    def gap_m(self, length_m: ArrayLike):
        return 1e-3 + 0.0 * np.asarray(length_m)


def slider(stiffness: float = 3.0) -> KnownActuator:
    return KnownActuator(Slider(stiffness), MASS_KG, 1.0, 0.0, 2.0, 5000.0, longest_m=1.0)


def test_the_fastest_step_of_a_double_integrator_is_that_of_its_closed_form():
    """Rest to rest over d with acceleration a: 2 sqrt(d/a); 10 % after sqrt(0.2 d/a), 90 % as
    long before the end. One step of the simulation is 0.1 ms, and the spring has 0.8 % of the
    force."""
    for before, after in ((0.0, 0.005), (0.0, -0.005)):
        found = fastest_step(slider(), before, after)
        unit_s = math.sqrt(0.005 * 1.0 / (0.5 * PULL_N / MASS_KG))
        assert found.time_s == pytest.approx(2.0 * unit_s, abs=2e-4)
        assert found.rise_s == pytest.approx((2.0 - 2.0 * math.sqrt(0.2)) * unit_s, abs=2e-4)
        assert found.switch_s == pytest.approx(unit_s, abs=2e-4)
        time_s, strain = found.motion
        assert time_s[-1] == pytest.approx(found.time_s)
        # Half of the way is done when the voltage switches, and the end is the desired strain.
        halfway = float(np.interp(found.switch_s, time_s, strain))
        assert halfway == pytest.approx(0.5 * after, rel=0.02)
        assert strain[-1] == pytest.approx(after, rel=0.02)


def test_a_step_out_of_reach_has_no_bound():
    with pytest.raises(ResultError, match="cannot be driven"):
        fastest_step(slider(200.0), 0.0, 0.05)  # the spring stops it after 0.02


def test_the_least_peak_of_a_double_integrator_is_that_of_its_closed_form():
    """With the added force f: f t^2/2m, then the rest (f - F/2) brakes the speed f t/m."""
    known, dead_s, added_kg = slider(), 0.02, 0.02
    force_n, mass_kg = added_kg * GRAVITY, MASS_KG + added_kg
    speed = force_n * dead_s / mass_kg
    brake = (0.5 * PULL_N - force_n) / mass_kg
    expected = 0.5 * force_n / mass_kg * dead_s**2 + speed**2 / (2.0 * brake)
    assert least_peak(known, 0.0, added_kg, dead_s) == pytest.approx(expected, rel=5e-3)
    assert least_peak(known, 0.0, added_kg, 0.04) > 3.9 * expected  # as the dead time squared


def test_the_limit_by_noise_is_the_median_error_of_a_mean():
    """5,000 draws: the median is known to 1.25/sqrt(5000) of a standard deviation, here 2 %."""
    rng = np.random.default_rng(8)
    means = np.abs(rng.standard_normal((5000, 6, 25)).mean(axis=2))
    assert mean_error([1.0], 25.0) == pytest.approx(float(np.median(means[:, 0])), rel=0.06)
    largest = float(np.median(means.max(axis=1)))
    assert mean_error(6 * [1.0], 25.0) == pytest.approx(largest, rel=0.03)


def test_the_limit_of_a_weight_is_that_of_a_double_integrator():
    """x = g t^2 / 2m per kg, as long as the spring is weak: it turns back 5 % at 0.2 s."""
    at_s = 0.01 * np.arange(1.0, 21.0)
    slope = 0.5 * GRAVITY * at_s**2 / MASS_KG
    expected = 0.6745 * 1e-4 / math.sqrt(float(slope @ slope))
    assert weight_error_kg(slider(), 0.0, 1e-4, at_s) == pytest.approx(expected, rel=0.06)


WAVE_S = 1e-3 * np.arange(1000)


def test_a_reference_that_a_held_force_can_follow_has_no_tracking_error():
    """Arcs of a constant acceleration, which changes its sign 0.25 s and 0.75 s into the period."""
    phase = WAVE_S % 0.5
    arcs = 5.0 * (0.25 * phase - 0.5 * phase**2) * np.where(WAVE_S < 0.5, 1.0, -1.0)
    found = least_tracking_error(slider(0.0), arcs, 1e-3, 0.01, 0.0)
    assert found < 1e-9
    shifted = np.roll(arcs, 2)  # with the changes of the force
    assert least_tracking_error(slider(0.0), shifted, 1e-3, 0.01, 2e-3) < 1e-9


def test_a_wave_beyond_the_force_is_followed_no_better_than_by_full_force():
    """Of a sine that asks for twice the force, a square wave of the force follows the most."""
    most = 0.5 * PULL_N / MASS_KG  # m/s^2, on a length of 1 m
    amplitude = 2.0 * most / (2.0 * np.pi) ** 2
    wave = amplitude * np.sin(2.0 * np.pi * WAVE_S)
    found = least_tracking_error(slider(0.0), wave, 1e-3, 0.01, 0.0)
    phase = WAVE_S % 0.5
    arcs = most * (0.25 * phase - 0.5 * phase**2) * np.where(WAVE_S < 0.5, 1.0, -1.0)
    expected = float(np.sqrt(np.mean((wave - arcs) ** 2))) / np.ptp(wave)
    assert found == pytest.approx(expected, rel=1e-3)
    assert least_tracking_error(slider(0.0), 0.4 * wave, 1e-3, 0.01, 0.0) < 1e-4


TIME_S = 1e-3 * np.arange(1, 6001) - 2.0


def trace(strain, reference=None) -> Trace:
    update_s = 0.01 * np.arange(600) - 2.0
    wanted = np.zeros(600) if reference is None else reference(update_s)
    drive_v = np.where(np.arange(600) % 2, 0.1, -0.1)
    return Trace(TIME_S, strain(TIME_S), update_s, wanted, drive_v, np.full(600, math.nan), 1e6)


def test_a_first_order_step_has_its_rise_and_settling_time():
    tau_s, after = 0.1, 0.04
    found = step_response(
        trace(lambda t: after * np.where(t > 0, 1.0 - np.exp(-t / tau_s), 0.0)),
        0.0,
        2.0,
        0.0,
        after,
    )
    assert found.rise_s == pytest.approx(tau_s * math.log(9.0), abs=2e-4)
    assert found.settling_s == pytest.approx(tau_s * math.log(50.0), abs=2e-3)  # two samples
    assert found.overshoot == pytest.approx(0.0, abs=1e-6)
    assert abs(found.error) < 1e-6


def test_a_resonant_step_has_the_overshoot_of_its_damping():
    zeta, omega = 0.3, 20.0
    damped = omega * math.sqrt(1.0 - zeta**2)

    def strain(t):
        t = np.maximum(t, 0.0)
        wave = np.cos(damped * t) + zeta / math.sqrt(1 - zeta**2) * np.sin(damped * t)
        return -0.02 * (1.0 - np.exp(-zeta * omega * t) * wave)

    found = step_response(trace(strain), 0.0, 2.0, 0.0, -0.02)
    expected = math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))
    assert found.overshoot == pytest.approx(expected, abs=1e-3)


def test_a_step_that_did_not_happen_or_swings_has_no_numbers():
    stuck = step_response(trace(lambda t: 0.0 * t), 0.0, 2.0, 0.0, 0.04)
    swings = step_response(
        trace(lambda t: np.where(t > 0, 0.04 + 0.05 * np.sin(30.0 * t), 0.0)), 0.0, 2.0, 0.0, 0.04
    )
    short = step_response(trace(lambda t: 0.0 * t), 3.0, 2.0, 0.0, 0.04)
    for score in (stuck, swings, short):
        assert math.isnan(score.rise_s) and math.isnan(score.overshoot)


def test_a_step_is_scored_by_the_desired_strain_and_not_by_the_one_that_was_reached():
    """A first-order response to 0.7 of the step never crosses 90 % of it, and never settles."""
    tau_s, after = 0.1, 0.04

    def reaches(share):
        return trace(lambda t: after * share * np.where(t > 0, 1.0 - np.exp(-t / tau_s), 0.0))

    short = step_response(reaches(0.7), 0.0, 2.0, 0.0, after)
    assert math.isnan(short.rise_s) and math.isnan(short.settling_s)
    assert (short.overshoot, short.error) == (0.0, pytest.approx(-0.3 * after, rel=1e-4))
    long = step_response(reaches(1.25), 0.0, 2.0, 0.0, after)
    # 1 - exp(-t / tau) = 0.72 and 0.08
    assert long.rise_s == pytest.approx(tau_s * math.log(0.92 / 0.28), abs=2e-4)
    assert long.overshoot == pytest.approx(0.25, abs=1e-4) and math.isnan(long.settling_s)
    # a second step of the same size that begins where the first one has ended, far from its start
    missed = step_response(reaches(0.7), 1.0, 2.0, -after, 0.75 * after)
    assert math.isnan(missed.rise_s) and missed.overshoot == 0.0


def test_a_load_response_has_its_peak_and_its_time_back():
    peak, tau_s = 0.01, 0.2
    found = load_response(
        trace(lambda t: 0.05 + np.where(t > 0, peak * np.exp(-t / tau_s), 0.0)), 0.0, 3.0
    )
    assert found[0] == pytest.approx(peak, rel=5e-3)
    # the mean of 20 ms of an exponential is larger by (0.02 / 0.2)^2 / 24 of it
    assert found[1] == pytest.approx(tau_s * math.log(peak / 1e-3), abs=2e-3)
    lasting = load_response(trace(lambda t: 0.05 + 0.01 * (t > 0)), 0.0, 3.0)
    assert math.isnan(lasting[1])


def test_the_tracking_error_of_a_delayed_sine_is_that_of_its_delay():
    omega, delay_s = 2.0 * math.pi * 2.0, 0.004
    wanted = 0.03 * np.sin(omega * TIME_S)
    late = trace(lambda t: 0.03 * np.sin(omega * (t - delay_s)))
    # amplitude of the difference 2 A sin(w d / 2), over 2 A and sqrt(2)
    expected = math.sin(0.5 * omega * delay_s) / math.sqrt(2.0)
    assert tracking_error(late, wanted, 0.0, 3.0) == pytest.approx(expected, rel=1e-3)


def test_the_drive_s_variation_is_the_sum_of_its_changes_per_second():
    assert variation_v_per_s(trace(lambda t: 0.0 * t)) == pytest.approx(0.2 / 0.01)


def test_the_moving_mean_keeps_lines_and_removes_what_is_as_long_as_its_window():
    time_s = 1e-3 * np.arange(400)
    np.testing.assert_allclose(smoothed(time_s)[20:-20], time_s[20:-20], atol=1e-12)
    wave = smoothed(np.sin(2.0 * np.pi * time_s / 0.021))  # 21 samples
    assert np.abs(wave[20:-20]).max() < 1e-12
