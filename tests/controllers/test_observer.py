"""The observer with inverse dynamics: its motion, its linear loop, its plans, what it reaches."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.actuators import CurlingHasel, DeaStack, Drive, PeanoHasel, PlanarHasel, SampledLaw
from haselab.base import ResultError
from haselab.controllers import CONTROLLERS, KnownActuator, observer_design
from haselab.controllers.linear_loop import (
    Demands,
    LinearLoop,
    penalty,
    sensitivity_of,
    squared_error,
    timed_error,
)
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.observer_design import best_parameters, linear_loop
from haselab.controllers.observer_law import ObserverLaw
from haselab.controllers.reference_plan import ReferencePlan
from haselab.scoreboard import CLASSES, TASKS
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.play import Scenario, play, setting_for
from haselab.scoreboard.tasks.task import staircase

HZ = find_device("hz")
HOST = CLASSES["host-100hz"]
OBSERVER = CONTROLLERS.find("observer")
DESIGNED = OBSERVER.choose({"bandwidth_rad_s": 38.5, "load_n": 0.21, "shake_m_s2": 0.01})
GRAVITY = 9.80665


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    """The public device as it is, with the noise of the host's lock-in."""
    found = true_actuator(HZ)
    farad = float(found.law.capacitance_f(found.zero_length_m))
    return replace(found, capacitance_noise_f=1.8e-4 * farad)


@pytest.mark.parametrize(
    ("law", "mass_kg", "drives_v"),
    [
        (PlanarHasel(), 0.25, (0.8, 1.6, 0.2, 1.2)),
        (DeaStack(), 0.2, (0.6, 1.4, 0.0, 1.0)),
        (PeanoHasel(damping_n_s_per_m=3.0), 0.1, (0.5, 1.2, 0.2, 0.8)),
        (CurlingHasel(curl_rad=0.5, damping_n_s_per_m=2.0), 0.05, (0.5, 1.4, 0.3, 0.9)),
    ],
)
def test_the_motion_is_that_of_the_compiled_one(law, mass_kg, drives_v):
    """Both integrate the same equations, one with steps of 1 ms, the other to 1e-6 of the span."""
    gain, each_s = 5000.0, 0.2
    volt = gain * np.repeat(drives_v, 20)
    edge_s = each_s / 20 * np.arange(volt.size + 1.0)
    sampled = SampledLaw(law, 1e4)
    load_n = np.full(volt.size, GRAVITY * mass_kg)
    drive = Drive(edge_s, volt, load_n, np.full(volt.size, mass_kg), np.zeros(volt.size))
    longest = 0.0  # which softens: it was reached before, as on the scoreboard
    for _ in range(3):
        start, _ = sampled.at_rest(float(volt[0]), 0.0, float(load_n[0]), longest_m=longest)
        exact_m = sampled.respond(drive, edge_s[1:], start).length_m
        longest = max(longest, 1.02 * float(exact_m.max()))
    model = MotionModel(KnownActuator(law, mass_kg, float(exact_m[0]), 0.0, 2.0, gain,
                                      longest_m=longest))  # fmt: skip
    # the branches have relaxed at the first voltage
    state, found_m = model.at_rest(float(start["length_m"][0]), drives_v[0]), []
    state[-1] = 0.0
    for value in volt:
        state = model.moved(state, float(value) / gain, each_s / 20)
        found_m.append(state[0])
    assert np.abs(np.array(found_m) - exact_m).max() < 2e-3 * np.ptp(exact_m)


@given(delay=st.floats(0.1, 2.5), strain=st.floats(0.0, 0.2), bandwidth=st.floats(5.0, 60.0))
@settings(max_examples=15, deadline=None)
def test_the_linear_loop_follows_the_controller_and_the_motion(known, delay, strain, bandwidth):
    """A small change of the load, played with the law itself, is what the matrices say."""
    setting = setting_for(
        OBSERVER.choose({"bandwidth_rad_s": 1.0, "load_n": 1.0}), HOST, known, 0.0
    )
    setting = replace(setting, delay_s=delay * setting.period_s)
    law = ObserverLaw(setting, bandwidth, 0.3, 0.01)
    loop = linear_loop(law, setting, strain, (1.0, 0.0))
    length_m, drive_v = known.length_m(strain), known.static_drive_v(strain)
    model, period_s = law.model, setting.period_s
    rest = model.at_rest(length_m, drive_v)
    whole, late_s = law.whole, setting.delay_s - law.whole * period_s
    true, seen, past_v = [*rest[:-1], rest[-1] + 1e-3], list(rest), [drive_v] * (whole + 2)
    states, found, expected = np.zeros(loop.a.shape[0]), [], []
    for _ in range(40):
        seen = law.observed(seen, past_v, true[0])
        new_v = law.drive_v(law.ahead(seen, past_v), (length_m, 0.0, 0.0), (-math.inf, math.inf))
        past_v = [new_v, *past_v[:-1]]
        true = model.moved(true, past_v[whole + 1], late_s)
        true = model.moved(true, past_v[whole], period_s - late_s)
        found.append(true[0] - length_m)
        states = loop.a @ states + 1e-3 * loop.load
        expected.append(float(loop.length @ states))
    if np.abs(found).max() < 1e-3:  # else it is unstable, and no longer a small change
        assert np.abs(np.subtract(found, expected)).max() < 0.02 * np.abs(expected).max()


def test_loops_of_a_design_share_steps_without_changing_a_bit(known):
    """Another plant of the same law, and another law with the same plant, reuse what they can."""
    setting = replace(setting_for(DESIGNED, HOST, known, 0.0), delay_s=0.017)
    any_law, motions = ObserverLaw(setting, 10.0, 1.0, 0.01), {}
    for bandwidth in (20.0, 35.0):
        steps = observer_design._Steps({}, motions)
        for other in ((1.1, 0.0), (0.9, 0.004), (1.0, 0.011)):
            alone = linear_loop(ObserverLaw(setting, bandwidth, 0.3, 0.01), setting, 0.03, other)
            shared = linear_loop(any_law.tuned(bandwidth, 0.3), setting, 0.03, other, steps)
            for field in fields(LinearLoop):
                assert np.array_equal(getattr(alone, field.name), getattr(shared, field.name))


def test_the_stated_delay_margin_is_that_of_the_played_loop(known):
    """Just within the delay at which the linear loop is unstable, the device rests; beyond not."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    values = dict(DESIGNED.values)
    law = ObserverLaw(setting, values["bandwidth_rad_s"], values["load_n"], values["shake_m_s2"])

    def size(later_s: float) -> float:
        return float(
            np.abs(np.linalg.eigvals(linear_loop(law, setting, 0.03, (1.0, later_s)).a)).max()
        )

    delays_s = 1e-3 * np.arange(1.0, 30.0)
    limit_s = next(later_s for later_s in delays_s.tolist() if size(later_s) > 1.0)
    assert limit_s > 5e-3  # what the drawn devices of the scoreboard have
    rests = Scenario(HZ, known.zero_length_m, 4.0, staircase(((-math.inf, 0.03), (0.0, 0.035))))

    def shaking(later_s: float) -> float:
        played = replace(rests, device=replace(HZ, late_s=round(later_s, 4)))
        trace = play(played, DESIGNED, HOST, known, np.random.default_rng(3))
        return float(trace.between(3.0, 4.0)[1].std())

    assert shaking(0.8 * limit_s) < 2e-3
    assert shaking(1.25 * limit_s) > 5e-3


def test_the_sensitivity_of_a_pure_gain_is_the_closed_form():
    """x' = x - k x(k) with an input that is added to the drive: S = (z - 1) / (z - 1 + k)."""
    gain, one = 0.4, np.ones(1)
    loop = LinearLoop(np.array([[1.0 - gain]]), one, -gain * one, one, one, -gain * one, -gain)
    omega, found = sensitivity_of(loop, 0.01)
    z = np.exp(0.01j * omega)
    np.testing.assert_allclose(found, (z - 1.0) / (z - 1.0 + gain), rtol=1e-12)
    # the length nears 1 / gain, at which the loop rests for good, by (1 - gain) in each update
    assert squared_error(loop, 0.01) == pytest.approx(
        math.sqrt(0.01 / gain**2 / (1.0 - (1.0 - gain) ** 2)), rel=1e-12
    )
    way = (1.0 - (1.0 - gain) ** np.arange(1, 31)) / gain
    assert timed_error(loop, 0.01, 0.3) == pytest.approx(
        0.01 * math.sqrt((np.arange(1, 31) * way**2).sum()), rel=1e-12
    )
    # of the drive by noise: -gain at once, then gain^2 (1 - gain)^(k - 1)
    shaken = math.hypot(gain, gain**2 / math.sqrt(1.0 - (1.0 - gain) ** 2))
    peak, free = float(np.abs(found).max()), math.inf
    for most, missed in ((1.01 * shaken, 0.0), (shaken / 1.1, 0.1)):
        factor = penalty(loop, 0.01, Demands(1.0, most, 1.01 * peak, free))
        assert factor == pytest.approx(math.exp(20.0 * missed), rel=1e-9)


@given(start=st.floats(-0.03, 0.15), size=st.floats(-0.1, 0.1), reserve=st.floats(0.05, 0.3))
@settings(max_examples=10, deadline=None)
def test_a_plan_ends_at_rest_at_the_target_within_the_force_of_the_field(
    known, start, size, reserve
):
    low, high = known.reachable()
    target = min(max(start + size, low + 0.005), high - 0.02)
    model, period_s = MotionModel(known), 0.01
    plan = ReferencePlan(model, known, period_s, reserve, math.inf)
    begin_m, target_m = known.length_m(start), known.length_m(target)
    plan.begin(begin_m)
    state = model.at_rest(begin_m, known.static_drive_v(start))
    steps = [plan.next([target_m], 0.002, state) for _ in range(120)]
    assert steps[0][:2] == (begin_m, 0.0)
    assert steps[-1] == (target_m, 0.0, 0.0)
    half_s = 0.5 * period_s
    rest_n = model.needed_n(state, target_m, 0.0, 0.0)  # near an end, creep may ask for more
    for (x, v, a), (later_x, later_v, _) in pairwise(steps):
        assert later_v == pytest.approx(v + period_s * a, abs=1e-9)
        if (later_x, later_v) != (target_m, 0.0):
            assert later_x == pytest.approx(x + period_s * v + 0.5 * period_s**2 * a, abs=1e-9)
        else:  # the sum of the steps misses the polynomial by little
            assert (
                abs(later_x - x - period_s * v - 0.5 * period_s**2 * a)
                <= 0.02 * abs(target_m - begin_m) + 1e-12
            )
        middle_m = x + half_s * v + 0.5 * half_s**2 * a
        ends_n = [model.pull_n(middle_m, volt) for volt in (0.0, known.highest_drive_v(middle_m))]
        needed_n = model.needed_n(state, middle_m, v + half_s * a, a)
        # between the times that are checked, by less than a tenth of the range
        spare_n = 0.1 * (ends_n[1] - ends_n[0])
        assert min(ends_n[0], rest_n) - spare_n <= needed_n <= max(ends_n[1], rest_n) + spare_n


def test_a_smooth_reference_is_followed_with_its_rate(known):
    period_s, acts_s, omega = 0.01, 0.002, 2.0 * math.pi * 3.0
    plan = ReferencePlan(MotionModel(known), known, period_s, 0.15, math.inf)
    state = MotionModel(known).at_rest(known.length_m(0.03), 1.2)

    def wanted(time_s):
        return known.length_m(0.03 + 0.03 * np.sin(omega * np.maximum(time_s, 0.0)))

    plan.begin(float(wanted(-1.0)))
    errors = []
    for k in range(-5, 60):
        ends_s = (k + 1) * period_s
        samples = wanted(k * period_s + period_s * np.arange(6.0)).tolist()
        length_m, speed, _ = plan.next(samples, acts_s, state)
        rate = known.zero_length_m * 0.03 * omega * np.cos(omega * (ends_s + acts_s))
        if k > 3:
            errors.append((length_m - wanted(ends_s + acts_s), speed - rate))
    # a cubic through samples: the fourth power of omega times the period
    most = 0.03 * known.zero_length_m * (omega * period_s) ** 4
    assert np.abs([e[0] for e in errors]).max() < most
    assert np.abs([e[1] for e in errors]).max() < 2.0 * most / period_s


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "goals"),
    [
        ("T1", {"rise_s": 0.04, "overshoot": 0.05, "settling_s": 0.15, "rise_from_zero_s": 0.065}),
        ("T3", {"sine_1hz": 0.01, "sine_3hz": 0.02, "sine_5hz": 0.05}),
        ("T4", {"peak": 0.01}),
        ("T5", {"change_error_0p2s_kg": 0.0025, "change_error_1s_kg": 0.001, "mass_error": 0.02}),
    ],
)
def test_it_reaches_the_goals_at_100_hz(known, task, goals):
    chosen = next(entry for entry in TASKS.values() if entry.name == task)
    for seed in (1, 2):
        scenario = chosen.scenario(known, np.random.default_rng(seed))
        trace = play(scenario, DESIGNED, HOST, known, np.random.default_rng(seed + 10))
        score = chosen.score(trace, scenario)
        assert trace.failure == ""
        assert {key: score[key] for key in goals if score[key] > goals[key]} == {}


def test_a_demand_that_no_parameters_keep_is_refused(known):
    """A drive without noise cannot follow a noisy length."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)

    def loops(bandwidth: float, load_n: float):
        law = ObserverLaw(setting, bandwidth, load_n, 0.01)
        yield linear_loop(law, setting, 0.05, (1.0, 0.0)), Demands(1e-6, 1e-9, 9.0, 9.0)

    with pytest.raises(ResultError, match=r"parameters of the observer .* noise of the drive is"):
        best_parameters(loops, setting, evaluations=3)
