"""Step metrics against closed forms, the exact partial fractions of a loop, and noise."""

import math

import control
import numpy as np
import pytest

from haselab.base import InputError
from haselab.control.gains import PidGains
from haselab.control.ringing import Ringing, average_out, find_ringing
from haselab.control.simulate import LoopSetting, simulate_drive, simulate_loop
from haselab.control.step_metrics import step_metrics
from haselab.models.plant import Plant, SlowMode

CREEPING = Plant(0.5, 5.11, 0.09, slow_modes=(SlowMode(0.4, 4.7),))
STEP = 0.04
LN9 = math.log(9.0)


def record(moved, rate_hz, before_s=1.0):
    """A step at time zero with a constant second before it."""
    before = round(before_s * rate_hz)
    time_s = np.arange(-before, moved.size) / rate_hz
    return time_s, np.r_[np.zeros(before), moved], np.where(time_s < 0, 0.0, STEP)


def test_a_first_order_step_rises_in_ln9_time_constants():
    t = np.arange(2000) / 100.0
    found = step_metrics(*record(STEP * (1 - np.exp(-t / 0.7)), 100.0))
    # A parabola over a tenth of the rise leaves less than (0.1 ln 9)^3 / 60 of the step.
    assert found.rise_time_s.value == pytest.approx(0.7 * LN9, rel=1e-3)
    assert found.settling_time_s.value == pytest.approx(0.7 * math.log(50.0), abs=0.011)
    assert found.ringing is None and found.trials[0].remark == ""
    assert found.overshoot.value < 1e-6
    assert abs(found.steady_state_error.value) < 1e-9


def test_the_raw_rise_of_a_ringing_step_is_that_of_its_first_swing():
    """Eq. 8 alone passes 10 and 90 % within its first swing; averaged out, no rise is left."""
    omega, zeta = math.sqrt(26.14), 0.93 / (2.0 * math.sqrt(26.14))
    t = np.arange(4000) / 400.0
    damped = omega * math.sqrt(1.0 - zeta**2)
    swing = np.cos(damped * t) + zeta * omega / damped * np.sin(damped * t)
    y = 1.0 - np.exp(-zeta * omega * t) * swing
    found = step_metrics(*record(STEP * y, 400.0))
    first = [np.interp(part, y[:200], t[:200]) for part in (0.1, 0.9)]  # rises up to 0.6 s
    # The final value is the mean of the last tenth, 1 % off at most: 2 % of 0.4 s of rise to 1.
    assert found.raw_rise_time_s.value == pytest.approx(first[1] - first[0], rel=0.03)
    assert found.raw_rise_time_s.value == pytest.approx(0.214, abs=0.005)
    assert math.isnan(found.rise_time_s.value)
    assert found.trials[0].rise_time_s < 0.1 * found.raw_rise_time_s.value
    assert "so its rise time" in found.trials[0].remark


@pytest.mark.parametrize("phase", [0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi])
def test_the_rise_of_a_slow_step_with_ringing_has_a_value_at_every_phase(phase):
    """Whether the averaged or the raw rise is the longer one is chance if it lasts many periods."""
    t = np.arange(2000) / 100.0
    smooth = 1.0 - np.exp(-t / 1.07)
    ring = 0.05 * np.exp(-2.0 * t) * (np.cos(33.0 * t + phase) - math.cos(phase))
    found = step_metrics(*record(STEP * (smooth + ring), 100.0))
    assert found.ringing is not None
    # Averaging is accurate to 5 % of a rise of two or more periods.
    assert found.rise_time_s.value == pytest.approx(1.07 * LN9, rel=0.05)


def test_a_swing_that_creep_hides_from_the_overshoot_is_in_the_excess_over_the_reference():
    """Both swing far beyond the reference; in open loop, creep ends above the first peak."""
    t = np.arange(4000) / 200.0
    swing = 1.0 - np.exp(-20.0 * t) + 0.5 * np.exp(-4.0 * t) * np.sin(15.0 * t)
    closed, creeping = swing, swing + 0.5 * (1.0 - np.exp(-t))
    assert 1.2 < creeping[:200].max() < creeping[-1]
    opened, own = (step_metrics(*record(STEP * y, 200.0)) for y in (creeping, closed))
    assert opened.overshoot.value < 0.01
    # The peaks of the traces, smoothed over a fifth of the ringing's period.
    assert opened.peak_excess.value == pytest.approx(creeping.max() - 1.0, abs=0.02)
    assert own.peak_excess.value == pytest.approx(closed.max() - 1.0, abs=0.02)
    assert own.peak_excess.value == pytest.approx(own.overshoot.value, abs=0.01)
    low = step_metrics(*record(0.9 * STEP * (1.0 - np.exp(-t)), 200.0))
    assert low.peak_excess.value == 0.0


@pytest.mark.parametrize("zeta", [0.03, 0.09, 0.15])
def test_overshoot_of_a_second_order_step_is_the_closed_form(zeta):
    plant = Plant(1.0, 20.0, zeta)
    trace = simulate_drive(
        plant, np.r_[np.zeros(100), np.full(3000, STEP)], LoopSetting(100.0, 0.005)
    )
    found = step_metrics(trace.time_s, trace.y, np.where(trace.time_s < 1.0, 0.0, STEP))
    closed_form = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    # The parabola over a fifth of a period lowers a peak by (pi / 5)^4 / 280, part of 1.
    assert found.overshoot.value == pytest.approx(closed_form, abs=1e-3)
    assert found.ringing.omega_rad_s == pytest.approx(20 * math.sqrt(1 - zeta**2), rel=1e-3)
    assert found.ringing.decay_per_s == pytest.approx(20 * zeta, rel=1e-2)
    assert found.ring_averaged_overshoot.value < 0.1 * closed_form


def slow_part(gains, t):
    """Closed-loop step less its complex pair, by partial fractions of python-control's loop."""
    s = control.tf("s")
    plant = 0.5 * 5.11**2 / (s**2 + 2 * 0.09 * 5.11 * s + 5.11**2) + 0.4 / (4.7 * s + 1)
    law = gains.kp + gains.ki / s
    closed = control.feedback(plant * law, 1)
    numerator, denominator = closed.num[0][0], closed.den[0][0]
    total = np.ones(t.size, dtype=complex)
    for pole in np.roots(denominator):
        residue = np.polyval(numerator, pole) / np.polyval(np.polyder(denominator), pole)
        if abs(pole.imag) < 1.0 and abs(pole) > 1e-9:
            total += residue / pole * np.exp(pole * t)
    return total.real


@pytest.mark.parametrize("gains", [PidGains(0.85, 1.5), PidGains(0.4, 1.2)])
def test_ring_averaged_rise_is_that_of_the_loop_without_its_complex_pair(gains):
    t = np.arange(4000) / 400.0 * 4.0
    slow = slow_part(gains, t)
    rise = np.interp(0.9, slow[: slow.argmax()], t[: slow.argmax()]) - np.interp(0.1, slow, t)
    setting = LoopSetting(100.0, measurement_delay_s=0.0)
    trace = simulate_loop(CREEPING, gains, np.r_[np.zeros(100), np.full(4000, STEP)], setting)
    found = step_metrics(trace.time_s, trace.y, np.where(trace.time_s < 1.0, 0.0, STEP))
    # A line over one period P bends an exponential of time constant T by (P / T)^2 / 24 at the
    # most inside and twice that at the ends: 5 % of the rise here.
    assert found.rise_time_s.value == pytest.approx(rise, rel=0.05)


def test_averaging_leaves_a_straight_line_and_takes_the_ringing_away():
    t = np.arange(1000) / 100.0
    ringing = Ringing(6.0, 0.2)
    trace = 0.3 + 0.02 * t + 0.1 * np.exp(-0.2 * t) * np.cos(6.0 * t + 0.4)
    assert np.abs(average_out(trace, ringing, 100.0) - (0.3 + 0.02 * t)).max() < 1e-12


@pytest.mark.long
def test_noise_alone_does_not_ring():
    rng = np.random.default_rng(5)
    t = np.arange(4000) / 400.0
    found = [find_ringing(t, 1 - np.exp(-t) + 0.1 * rng.standard_normal(t.size)) for _ in range(40)]
    # White noise passes the threshold with probability 1500 exp(-15) = 5e-4 a trace.
    assert found.count(None) == 40


@pytest.mark.long
def test_the_interval_covers_the_noise_free_rise_time():
    setting = LoopSetting(100.0, measurement_delay_s=0.0075)
    reference = np.r_[np.zeros(100), np.full(2500, STEP)]
    trace = simulate_loop(CREEPING, PidGains(0.4, 1.2), reference, setting)
    desired = np.where(trace.time_s < 1.0, 0.0, STEP)
    truth = step_metrics(trace.time_s, trace.y, desired)
    rng = np.random.default_rng(11)
    inside = 0
    for _ in range(60):
        noisy = trace.y + 3e-4 * rng.standard_normal((4, trace.y.size))
        low, high = step_metrics(trace.time_s, noisy, desired).rise_time_s.ci95
        inside += low <= truth.rise_time_s.value <= high
    assert inside >= 52  # 60 draws at 95 %: 52 or fewer have probability 0.02


def test_open_loop_error_is_the_missing_static_gain():
    trace = simulate_drive(
        CREEPING, np.r_[np.zeros(100), np.full(4000, STEP)], LoopSetting(100.0, 0.005)
    )
    found = step_metrics(trace.time_s, trace.y, np.where(trace.time_s < 1.0, 0.0, STEP))
    late = 0.4 * math.exp(-38.0 / 4.7)
    assert found.steady_state_error.value == pytest.approx(0.1 + late, abs=1e-4)
    assert found.rise_time_s.value == pytest.approx(4.7 * math.log(0.4 / 0.09), rel=0.01)


def test_a_step_down_has_the_metrics_of_the_step_up():
    t = np.arange(2000) / 100.0
    time_s, y, reference = record(STEP * (1 - np.exp(-t / 0.7)), 100.0)
    up, down = step_metrics(time_s, y, reference), step_metrics(time_s, 0.01 - y, 0.01 - reference)
    assert down.rise_time_s.value == pytest.approx(up.rise_time_s.value, rel=1e-12)
    assert down.steady_state_error.value == pytest.approx(up.steady_state_error.value, abs=1e-9)


def test_a_response_that_never_settles_has_no_settling_time():
    t = np.arange(2000) / 100.0
    found = step_metrics(*record(STEP * (1 - np.exp(-t) + 0.2 * np.sin(9 * t)), 100.0))
    assert math.isnan(found.settling_time_s.value)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        (np.full(100, 0.04), "reference changes 0 times"),
        (np.r_[np.zeros(50), 0.01, np.full(49, 0.04)], "reference changes 2 times"),
        (np.r_[np.zeros(50), np.full(49, 0.04)], "have shapes"),
        (np.r_[np.zeros(50), np.full(50, -0.04)], "moves by"),
    ],
)
def test_unusable_records_are_refused(reference, message):
    t = np.arange(100) / 100.0
    with pytest.raises(InputError, match=message):
        step_metrics(t, np.where(t < 0.5, 0.0, 0.04), reference)
