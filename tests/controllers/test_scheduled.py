"""The scheduled PID: the same poles over voltage and load, and the margins that it states."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, linearise
from haselab.base import ResultError
from haselab.controllers import CONTROLLERS, KnownActuator, Measurement
from haselab.controllers.adaptive.scheduled import grid_of, loop_at
from haselab.controllers.linear_loop import sensitivity_of
from haselab.controllers.sampled_point import sampled_point
from haselab.scoreboard import CLASSES
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.play import Scenario, play, setting_for
from haselab.scoreboard.tasks.task import staircase

HZ, HOST = find_device("hz"), CLASSES["host-100hz"]
KIND = CONTROLLERS.find("scheduled-pid")
POLES = {"omega_rad_s": 29.05, "damping": 0.3127, "integral_rad_s": 15.06, "filter_s": 0.002}
DESIGNED = KIND.choose(POLES)


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    """The public device as it is, with the noise of the host's lock-in."""
    found = true_actuator(HZ)
    farad = float(found.law.capacitance_f(found.zero_length_m))
    return replace(found, capacitance_noise_f=1.8e-4 * farad)


def test_the_poles_are_the_same_at_all_voltages_and_loads(known):
    """By the law's own linear model; the branches relax slowly against the poles."""
    wanted = np.roots([1.0, 2.0 * 0.3127 * 29.05, 29.05**2])
    count = 0
    for row in grid_of(known):
        for point in row:
            kp, ki, kd = point.gains(29.05, 0.3127, 15.06)
            mass = point.known.mass_kg
            acting_v = math.hypot(known.gain_v_per_v * point.drive_v, math.sqrt(known.carrier_v2))
            linear = linearise(known.law, acting_v, GRAVITY_M_S2 * mass, mass,
                               longest_m=known.longest_m)  # fmt: skip
            into = linear.b * known.gain_v_per_v**2 * point.drive_v / acting_v
            size = into.size
            a = np.zeros((size + 1, size + 1))
            a[:size, :size] = linear.a
            row_of_v = np.r_[-kp * linear.c, 1.0]  # the states are length, speed, branches
            row_of_v[1] -= kd
            a[:size] += np.outer(into, row_of_v)
            a[size, :size] = -ki * linear.c
            poles = np.linalg.eigvals(a)
            fast = poles[np.argsort(-np.abs(poles.imag))][:2]
            assert np.abs(np.sort_complex(fast) - np.sort_complex(wanted)).max() < 0.08 * 29.05
            count += 1
    gains = [row[k].gains(29.05, 0.3127, 15.06)[1] for row in grid_of(known) for k in (0, -1)]
    assert count == 15 and max(gains) / min(gains) > 4.0  # the gains do change


def test_the_stated_peak_sensitivity_holds_at_every_point_of_the_grid(known):
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    peaks = []
    for row in grid_of(known):
        for point in row:
            for stiffness, later_s in ((1.0, 0.0), (1.1, 0.0), (0.9, 2e-3)):
                loaded = replace(setting, actuator=point.known)
                sampled = sampled_point(loaded, point.strain, stiffness=stiffness, later_s=later_s)
                loop = loop_at(point, sampled, setting, tuple(POLES.values()))
                peaks.append(float(np.abs(sensitivity_of(loop, setting.period_s)[1]).max()))
    assert max(peaks) < 2.05  # 2 with the identified model, of which these are the design


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_stated_delay_margin_is_that_of_the_played_loop(known, share):
    """Just within the delay at which the linear loop is unstable, the device rests; beyond not."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    row = next(row for row in grid_of(known) if row[0].known.mass_kg == known.mass_kg)
    point = row[1] if share < 0.5 else row[3]

    def size(later_s: float) -> float:
        sampled = sampled_point(setting, point.strain, later_s=later_s)
        loop = loop_at(point, sampled, setting, tuple(POLES.values()))
        return float(np.abs(np.linalg.eigvals(loop.a)).max())

    limit_s = next(t for t in (1e-3 * np.arange(1.0, 60.0)).tolist() if size(t) > 1.0)
    assert limit_s > 5e-3  # what the drawn devices of the scoreboard have
    steps = staircase(((-math.inf, point.strain - 0.005), (0.0, point.strain)))
    rests = Scenario(HZ, known.zero_length_m, 6.0, steps)

    def shaking(later_s: float) -> float:
        played = replace(rests, device=replace(HZ, late_s=round(later_s, 4)))
        trace = play(played, DESIGNED, HOST, known, np.random.default_rng(3))
        return float(trace.between(5.0, 6.0)[1].std())

    assert shaking(0.8 * limit_s) < 2e-3
    assert shaking(1.25 * limit_s) > 4e-3


def test_an_actuator_that_holds_no_load_of_the_grid_is_refused(known):
    with pytest.raises(ResultError, match="none of the loads"):
        grid_of(replace(known, high_v=1e-3))


def test_the_drive_stays_while_the_sensor_is_lost(known):
    setting = setting_for(DESIGNED, HOST, known, 1.04)
    controller = DESIGNED.make()
    controller.start(setting)
    first = controller.step(0.0, Measurement(0.0, math.nan, 1.04, 0.01))
    assert first == pytest.approx(1.04, abs=1e-6)
    lost = Measurement(math.nan, math.nan, first, 0.02, valid=False)
    assert controller.step(0.05, lost) == first
