"""The simulated loop against python-control, brute-force integration, the controller's rules."""

import math

import control
import numpy as np
import pytest

from haselab.base import InputError
from haselab.control.gains import PidGains, Saturation
from haselab.control.plants.modes import Modes, SampledLoops, split_delay
from haselab.control.simulate import LoopSetting, simulate_drive, simulate_loop
from haselab.models.plant import Plant, SlowMode

CREEPING = Plant(0.5, 5.11, 0.09, slow_modes=(SlowMode(0.4, 4.7),))
WIDE = Saturation(-1e3, 1e3)


def test_unsaturated_loop_equals_the_discrete_loop_of_python_control():
    gains, period = PidGains(0.4, 1.5, 0.3, 0.05), 0.01
    s = control.tf("s")
    z = control.tf([1, 0], [1], period)
    fast = control.ss(0.5 * 5.11**2 / (s**2 + 2 * 0.09 * 5.11 * s + 5.11**2))
    plant = control.c2d(fast + control.ss(0.4 / (4.7 * s + 1)), period, "zoh") * control.ss(1 / z)
    derivative = control.ss(gains.kd * (z - 1) / ((gains.derivative_filter_s + period) * z - 0.05))
    law = control.ss(gains.kp + gains.ki * period * z / (z - 1))
    closed = control.feedback(control.feedback(plant, derivative) * law, 1)
    time_s = np.arange(400) * period
    expected = control.forced_response(closed, time_s, np.full(400, 0.04)).outputs
    setting = LoopSetting(100.0, measurement_delay_s=period, saturation=WIDE)
    found = simulate_loop(CREEPING, gains, np.full(400, 0.04), setting)
    # Both are exact: 400 steps of rounding at 1e-16 of 0.04, times the loop's gain of about 10.
    np.testing.assert_allclose(found.measured, expected, rtol=0.0, atol=400 * 1e-16 * 0.04 * 10)


def brute_force(plant, gains, reference, setting, substeps=200):
    """Small Euler-Cauchy steps of the plant's differential equations, delay by a long memory."""
    period = 1.0 / setting.rate_hz
    h = period / substeps
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    lag = round((plant.delay_s + setting.measurement_delay_s) / h)
    x = v = c = 0.0
    trail, u_all = [0.0] * lag, []
    integral = filtered = 0.0
    for desired in reference:
        measured = trail[len(trail) - lag] if lag else 0.5 * x + c
        error = desired - measured
        change = period / (period + gains.derivative_filter_s) * (measured - filtered)
        filtered += change
        free = gains.kp * error + integral - gains.kd * change / period
        beyond = (free > setting.saturation.high and error > 0) or (
            free < setting.saturation.low and error < 0
        )
        integral += 0.0 if beyond else gains.ki * error * period
        u = gains.kp * error + integral - gains.kd * change / period
        u = min(max(u, setting.saturation.low), setting.saturation.high)
        u_all.append(u)
        for _ in range(substeps):
            trail.append(plant.gain * x + c)
            middle = v + 0.5 * h * (wn * wn * (u - x) - 2 * zeta * wn * v)
            v += h * (wn * wn * (u - x - 0.5 * h * v) - 2 * zeta * wn * middle)
            x += h * middle
            tau = plant.slow_modes[0].time_constant_s
            c += h / tau * (plant.slow_modes[0].gain * u - c) * (1 - 0.5 * h / tau)
    return np.array(u_all)


@pytest.mark.parametrize("delay_s", [0.0035, 0.0100, 0.0175])
def test_saturated_loop_equals_a_brute_force_integration(delay_s):
    gains = PidGains(2.0, 3.0, 0.3, 0.03)
    setting = LoopSetting(100.0, measurement_delay_s=delay_s)
    reference = np.r_[np.full(200, 0.08), np.full(200, -0.03)]
    found = simulate_loop(CREEPING, gains, reference, setting)
    assert found.u.max() == 0.1 and found.u.min() == -0.05
    expected = brute_force(CREEPING, gains, reference, setting)
    # Second-order steps of h = 50 us: (wn h)^2 = 7e-8 a radian, over 20 rad, on 0.15 of range,
    # times the controller's gain of kd / filter + kp = 12.
    assert np.abs(found.u - expected).max() < 7e-8 * 20 * 0.15 * 12


def test_open_loop_of_the_paper_settles_when_the_analytic_envelope_says():
    plant = Plant(0.5, math.sqrt(26.14), 0.93 / (2.0 * math.sqrt(26.14)))
    trace = simulate_drive(plant, np.full(1500, 0.04), LoopSetting(100.0, 0.005))
    zeta = plant.damping_ratio
    peak = 0.02 * (1.0 + math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)))
    assert trace.y.max() == pytest.approx(peak, rel=1e-4)
    late = trace.time_s > -math.log(0.02 * math.sqrt(1 - zeta**2)) / 0.465
    assert np.abs(trace.y[late] / 0.02 - 1.0).max() < 0.02


def test_integrator_stands_still_while_the_output_is_clamped():
    gains = PidGains(0.0, 2.0)
    setting = LoopSetting(measurement_delay_s=0.005, saturation=Saturation(-0.01, 0.01))
    reference = np.r_[np.full(3000, 0.05), np.full(200, 0.0)]
    trace = simulate_loop(CREEPING, gains, reference, setting)
    assert np.all(trace.u[100:3000] == 0.01)
    # Frozen at most one increment (2 * 0.05 * 0.01) above the limit: it leaves within 3 samples.
    assert np.flatnonzero(trace.u[3000:] < 0.01)[0] <= 10


def test_a_plant_at_rest_on_its_initial_drive_stays_there():
    setting = LoopSetting(initial_u=0.03, measurement_delay_s=0.0123)
    level = 0.03 * CREEPING.static_gain
    trace = simulate_loop(CREEPING, PidGains(0.85, 1.5, 0.1, 0.02), np.full(300, level), setting)
    assert np.abs(trace.y - level).max() < 1e-14
    assert np.abs(trace.u - 0.03).max() < 1e-14


@pytest.mark.parametrize("delay_s", [0.0, 0.01, 0.0099999, 0.0100001, 0.027])
def test_delay_is_split_into_whole_samples_and_a_lead(delay_s):
    samples, lead = split_delay(delay_s, 0.01)
    assert samples * 0.01 - lead == pytest.approx(delay_s, abs=1e-11)
    assert 0.0 <= lead < 0.01


def test_a_drive_beyond_the_limits_is_refused_not_clipped():
    with pytest.raises(InputError, match=r"drive spans \[0\.2, 0\.2\]"):
        simulate_drive(CREEPING, [0.2], LoopSetting(100.0, 0.005))


def test_a_reference_with_a_gap_is_refused():
    with pytest.raises(InputError, match="reference has shape"):
        simulate_loop(CREEPING, PidGains(1.0, 1.0), [0.0, np.nan], LoopSetting(100.0, 0.005))


@pytest.mark.parametrize("gains", [PidGains(0.85, 1.5), PidGains(2.0, 3.0, 0.3, 0.03)])
def test_the_simulated_controller_is_the_c_cores(gains):
    """The C core, fed with the simulated measurements, gives the simulated outputs."""
    core = pytest.importorskip("haselab._core", reason="extension _core is not built")
    setting = LoopSetting(100.0, measurement_delay_s=0.0075)
    reference = np.r_[np.full(150, 0.08), np.full(150, -0.03), np.full(150, 0.01)]
    found = simulate_loop(CREEPING, gains, reference, setting)
    pid = core.Pid(gains.kp, gains.ki, gains.kd, 0.01, gains.derivative_filter_s, -0.05, 0.1)
    u = [pid.step(*pair) for pair in zip(reference, found.measured, strict=True)]
    # Single precision: an integral of 0.1 rounds by 2^-24 * 0.1 a step; the filter's rounding of
    # 0.1 * 2^-24 reaches the output times kd / period.
    bound = 450 * 2.0**-24 * 0.1 + 4 * 0.1 * 2.0**-24 * gains.kd / 0.01 + 1e-8
    assert np.abs(np.array(u) - found.u).max() < bound


@pytest.mark.parametrize("delay_s", [0.0, 0.0075, 0.01, 0.023])
def test_closed_loop_poles_are_the_roots_of_one_plus_the_loop(delay_s):
    """At a pole z the loop's response is -1; the response is an independent formula."""
    gains = PidGains(0.4, 1.5, 0.3, 0.05)
    loops = SampledLoops.of([CREEPING], [gains], period_s=0.01, measurement_delay_s=delay_s)
    poles = loops.poles()[0]
    near = poles[np.abs(poles) > 0.5]
    assert near.size >= 4
    omega = np.log(near) / 0.01j  # a complex frequency: z = exp(j omega T)
    modes = Modes.of(CREEPING)
    samples, lead_s = split_delay(delay_s, 0.01)
    z = np.exp(1j * omega * 0.01)
    terms = modes.free(lead_s) * modes.held(0.01) / (z[:, None] - modes.free(0.01))
    plant = z**-samples * ((terms + modes.held(lead_s)) @ modes.residues)
    law = gains.kp + gains.ki * 0.01 * z / (z - 1) + gains.kd * (z - 1) / (0.06 * z - 0.05)
    assert np.abs(1.0 + law * plant).max() < 1e-9
