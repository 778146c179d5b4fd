"""Loop shaping with coprime factors: its margin by other routes, and the loop on the device."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from haselab.base import ResultError
from haselab.controllers import CONTROLLERS, KnownActuator, Measurement
from haselab.controllers.linear_loop import refuse_missed
from haselab.controllers.model_based.coprime import (
    Sampled,
    guaranteed_margins,
    in_series,
    robust_controller,
    stability_margin,
)
from haselab.controllers.model_based.h_infinity import synthesis
from haselab.controllers.model_based.h_infinity_design import loop_of, robustness_of
from haselab.controllers.sampled_point import sampled_point
from haselab.rig.twin.config import TwinConfig
from haselab.scoreboard import CLASSES, TASKS
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.play import Scenario, play, setting_for
from haselab.scoreboard.tasks.task import staircase

HZ, HOST = find_device("hz"), CLASSES["host-100hz"]
KIND = CONTROLLERS.find("h-infinity")
VALUES = {"gain_n_per_m": 673.0, "integral_rad_s": 27.92, "lead_rad_s": 51.8, "reserve": 0.15}
DESIGNED = KIND.choose(VALUES)


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    """The public device as it is, with the noise of the host's lock-in."""
    found = true_actuator(HZ)
    farad = float(found.law.capacitance_f(found.zero_length_m))
    return replace(found, capacitance_noise_f=1.8e-4 * farad)


def drawn_system(seed: int, order: int) -> Sampled:
    """With its slowest pole from well inside to outside of the unit circle."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    a *= rng.uniform(0.5, 1.2) / np.abs(np.linalg.eigvals(a)).max()
    return Sampled(a, rng.normal(size=order), rng.normal(size=order))


@given(seed=st.integers(0, 2**32 - 1), order=st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_the_largest_margin_is_that_of_the_hankel_norm_of_the_factors(seed, order):
    """Factors and Gramians in discrete time, by other equations than the design solves."""
    plant = drawn_system(seed, order)
    _, margin, largest = robust_controller(plant, 1.05)
    a, b, c = plant.a, plant.b, plant.c
    p = solve_discrete_are(a.T, c[:, None], np.outer(b, b), np.eye(1))
    r = 1.0 + c @ p @ c
    inject = -(a @ p @ c) / r
    inner, into, out = a + np.outer(inject, c), np.stack([b, inject], axis=1), c / math.sqrt(r)
    reach = solve_discrete_lyapunov(inner, into @ into.T)
    seen = solve_discrete_lyapunov(inner.T, np.outer(out, out))
    hankel2 = float(np.abs(np.linalg.eigvals(reach @ seen)).max())
    # 1 - hankel^2 loses what is below rounding errors of the equations
    assert largest**2 == pytest.approx(1.0 - hankel2, rel=1e-5, abs=1e-7)
    assert margin == pytest.approx(largest / 1.05, rel=1e-12)


@given(seed=st.integers(0, 2**32 - 1), order=st.integers(1, 5))
@settings(max_examples=25, deadline=None)
def test_the_loop_is_stable_and_keeps_its_margin_at_all_frequencies(seed, order):
    """The four-block gain over frequency, from responses alone."""
    plant = drawn_system(seed, order)
    controller, margin, largest = robust_controller(plant)
    if largest < 0.02:  # near what no controller can stabilise
        return
    direct = np.outer(plant.b, plant.c) * controller.d
    closed = np.block([
        [plant.a + direct, np.outer(plant.b, controller.c)],
        [np.outer(controller.b, plant.c), controller.a],
    ])  # fmt: skip
    assert np.abs(np.linalg.eigvals(closed)).max() < 1.0
    assert stability_margin(plant, controller) >= margin * (1.0 - 1e-6)
    turns = np.pi * np.linspace(1e-3, 1.0, 200)
    g, k = plant.response(turns), controller.response(turns)
    blocks = np.stack([np.ones_like(g), g, k, k * g]) / (1.0 - g * k)
    # of rank one, so its largest singular value is the root of the sum of squares
    gain = np.sqrt((np.abs(blocks) ** 2).sum(axis=0))
    assert gain.max() <= (1.0 + 1e-6) / margin


def test_two_systems_in_series_have_the_product_of_their_responses():
    first, second = drawn_system(1, 3), replace(drawn_system(2, 2), d=0.7)
    turns = np.linspace(0.1, 3.0, 20)
    np.testing.assert_allclose(
        in_series(first, second).response(turns),
        first.response(turns) * second.response(turns), rtol=1e-10,
    )  # fmt: skip


def test_a_plant_that_no_controller_stabilises_is_refused():
    hidden = Sampled(np.diag([1.5, 0.5]), np.array([0.0, 1.0]), np.ones(2))
    with pytest.raises(ResultError, match="no solution"):
        robust_controller(hidden)


def test_the_linear_loop_has_at_least_the_guaranteed_margins(known):
    """Gains and phases by which the loop of the design point stays stable: from its poles."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    found = synthesis(setting, VALUES)
    stated = robustness_of(setting, VALUES)
    assert stated["stability_margin"] == pytest.approx(found.epsilon) and found.epsilon > 0.25
    factor, phase_rad = guaranteed_margins(found.epsilon)
    assert stated["guaranteed_gain_margin_db"] == pytest.approx(20.0 * math.log10(factor))
    assert stated["guaranteed_phase_margin_deg"] == pytest.approx(math.degrees(phase_rad))
    turns = np.pi * np.geomspace(1e-4, 1.0, 20000)
    loop = found.shaped.response(turns) * found.controller.response(turns)
    # positive feedback: distances of the gain at the phase of 1, of the phase at the gain 1
    crossing = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))
    assert np.abs(np.angle(loop[crossing])).min() >= phase_rad - 1e-3
    real = np.flatnonzero((np.diff(np.sign(loop.imag)) != 0) & (loop.real[:-1] > 0.0))
    gains = np.abs(loop[real])
    assert np.all((gains <= (1.0 + 1e-3) / factor) | (gains >= factor * (1.0 - 1e-3)))


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_the_stated_delay_margin_is_that_of_the_played_loop(known, share):
    """Just within the delay at which the linear loop is unstable, the device rests; beyond not."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    low, high = known.reachable()
    strain = low + share * (high - low)
    found = synthesis(setting, VALUES)

    def size(later_s: float) -> float:
        loop = loop_of(sampled_point(setting, strain, later_s=later_s), found)
        return float(np.abs(np.linalg.eigvals(loop.a)).max())

    limit_s = next(t for t in (1e-3 * np.arange(1.0, 60.0)).tolist() if size(t) > 1.0)
    assert limit_s > 5e-3  # what the drawn devices of the scoreboard have
    rests = Scenario(HZ, known.zero_length_m, 4.0,
                     staircase(((-math.inf, strain - 0.005), (0.0, strain))))  # fmt: skip

    def shaking(later_s: float) -> float:
        played = replace(rests, device=replace(HZ, late_s=round(later_s, 4)))
        trace = play(played, DESIGNED, HOST, known, np.random.default_rng(3))
        return float(trace.between(3.0, 4.0)[1].std())

    assert shaking(0.8 * limit_s) < 2e-3
    assert shaking(1.25 * limit_s) > 4e-3


@pytest.mark.parametrize("power", [1.0, -1.0])
def test_the_device_rests_with_any_force_within_the_guaranteed_gain_margin(known, power):
    """An amplifier whose gain is wrong by the root of the factor: the force is its square."""
    setting = setting_for(DESIGNED, HOST, known, 0.0)
    factor, _ = guaranteed_margins(synthesis(setting, VALUES).epsilon)
    table = HZ.config.model_dump()
    table["amplifier"]["gain"] *= factor ** (0.5 * power)
    table.pop("origin", None)
    device = replace(HZ, config=TwinConfig.model_validate(table))
    steps = staircase(((-math.inf, 0.0), (0.0, 0.005)))
    trace = play(Scenario(device, known.zero_length_m, 4.0, steps), DESIGNED, HOST, known,
                 np.random.default_rng(3))  # fmt: skip
    assert trace.failure == ""
    rest = trace.between(3.0, 4.0)[1]
    assert float(rest.std()) < 1e-3
    assert float(rest.mean()) == pytest.approx(0.005, abs=3e-4)


def test_the_weight_does_not_wind_up_while_the_drive_is_at_its_limit(known):
    """A desired strain out of reach for 3 s: then back within the time of a usual step."""
    low, _ = known.reachable()
    points = ((-math.inf, 0.0), (0.0, low - 0.05), (3.0, 0.0))
    scenario = Scenario(HZ, known.zero_length_m, 5.0, staircase(points))
    trace = play(scenario, DESIGNED, HOST, known, np.random.default_rng(3))
    assert trace.failure == ""
    back = trace.between(3.3, 5.0)[1]
    assert np.abs(back).max() < 5e-3


def test_the_drive_stays_while_the_sensor_is_lost(known):
    setting = setting_for(DESIGNED, HOST, known, known.static_drive_v(0.0))
    controller = DESIGNED.make()
    controller.start(setting)
    first = controller.step(0.0, Measurement(0.0, math.nan, setting.drive_start, 0.01))
    assert first == pytest.approx(setting.drive_start, abs=1e-4)
    lost = Measurement(math.nan, math.nan, first, 0.02, valid=False)
    assert controller.step(0.05, lost) == first


@pytest.mark.long
@pytest.mark.parametrize(
    ("task", "goals"),
    [
        ("T1", {"rise_s": 0.04, "overshoot": 0.05, "settling_s": 0.15, "rise_from_zero_s": 0.065}),
        ("T3", {"sine_1hz": 0.01, "sine_3hz": 0.02, "sine_5hz": 0.05}),
        ("T4", {"peak": 0.0105, "recovery_s": 0.15}),
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


def test_a_mode_that_the_plant_hardly_shows_is_refused():
    """It is unstable, and rounding errors exceed a stability margin of 1e-8."""
    hidden = Sampled(np.diag([1.5, 0.5]), np.array([1e-8, 1.0]), np.array([1.0, 1.0]))
    with pytest.raises(ResultError, match=r"gives no stable loop|have no solution"):
        robust_controller(hidden)


def test_a_design_that_misses_a_demand_says_which_and_by_how_much():
    kept = {"the peak sensitivity": 1.04, "the noise of the drive": 0.2}
    refuse_missed([kept, kept], "gains", 0.01, "Use another.")
    missed = kept | {"the noise of the drive": 6.32}
    with pytest.raises(ResultError, match=r"the noise of the drive is 6\.32 times its limit\. Use"):
        refuse_missed([kept, missed], "gains", 0.01, "Use another.")
