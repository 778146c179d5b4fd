"""Rate-independent hysteresis: energy, loops, the general solver, derivatives, linear model."""

import dataclasses
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from haselab import _motion
from haselab.actuators import (
    ActuatorState,
    DeaStack,
    Drive,
    PlanarHasel,
    SampledLaw,
    linearise,
    rates,
    with_parameters,
)
from haselab.actuators.registry import ACTUATORS
from haselab.base import LimitError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import native_bench

MASS_KG, LOAD_N = 0.25, 0.25 * 9.81
FORCE_N, WIDTH = 0.08, 0.03
LAW = PlanarHasel(hysteresis_n=FORCE_N, hysteresis_width=WIDTH)
ELASTIC = dataclasses.replace(
    LAW, branch_share=(), branch_relaxation_s=(), softening_share=0.0, damping_n_s_per_m=1e-9
)  # hysteresis is its only loss
SLIP_M = WIDTH * LAW.free_length_m


def drive_of(voltage_v, interval_s: float) -> Drive:
    same = np.ones(voltage_v.size)
    edge_s = interval_s * np.arange(voltage_v.size + 1)
    return Drive(edge_s, voltage_v, LOAD_N * same, MASS_KG * same, 0.0 * same)


def start_of(law):
    found, _ = SampledLaw(law, 15e3).at_rest(0.0, 0.0, LOAD_N)
    return found


def ringing(law, seconds=3.0):
    """Lengths, speeds and work of the hysteresis after a step of the voltage, every 0.2 ms."""
    times_s = np.arange(0.0, seconds, 2e-4)
    drive = drive_of(np.full(round(100 * seconds), 6e3), 0.01)
    return SampledLaw(law, 15e3).respond(drive, times_s, start_of(law))


def hysteresis_along(length_m):
    """The closed solution: exponential in the length from each sample to the next."""
    force_n, found = 0.0, [0.0]
    for change_m in np.diff(length_m):
        end_n = np.copysign(FORCE_N, change_m)
        force_n = end_n + (force_n - end_n) * np.exp(-abs(change_m) / SLIP_M)
        found.append(force_n)
    return np.array(found)


def test_energy_goes_only_into_hysteresis_and_never_comes_back():
    """Kinetic, elastic, electric and hysteresis energy fall by |v| h^2 / F, as `Losses` states."""
    seen = ringing(ELASTIC)
    force_n = hysteresis_along(seen.length_m)
    energy_j = (
        0.5 * MASS_KG * seen.speed_m_s**2
        + ELASTIC.energy_j(seen.length_m, 6e3)
        - LOAD_N * seen.length_m
        + 0.5 * force_n**2 * SLIP_M / FORCE_N
    )
    lost_w = np.abs(seen.speed_m_s) * force_n**2 / FORCE_N
    lost_j = np.concatenate([[0.0], np.cumsum(0.5 * (lost_w[1:] + lost_w[:-1]) * 2e-4)])
    assert lost_j[-1] > 0.2 * np.ptp(energy_j) > 0.0
    # steps of 0.1 rad: 1e-5 of the energy that moves; trapezia of 0.2 ms: 1e-4 of the loss
    np.testing.assert_allclose(energy_j - energy_j[0], -lost_j, atol=5e-4 * lost_j[-1])
    assert (np.diff(energy_j) < 1e-6 * lost_j[-1]).all()


def loop(seconds: float, law=ELASTIC):
    """Area in J and travel over the slipping length of a slow cycle, the last of four."""
    count = 8000
    phase = 8.0 * np.pi * np.arange(count) / count
    slow = dataclasses.replace(law, damping_n_s_per_m=5.0)
    drive = drive_of(3e3 * (1.0 - np.cos(phase)), seconds / count)
    seen = SampledLaw(slow, 15e3).respond(drive, drive.edge_s[3 * count // 4 :], start_of(slow))
    volts = drive.voltage_v[3 * count // 4 :]
    pull_n = 0.5 * sum(slow.electric_force_n(part, volts)
                       for part in (seen.length_m[:-1], seen.length_m[1:]))  # fmt: skip
    speed_m_s = 0.5 * (seen.speed_m_s[:-1] + seen.speed_m_s[1:])
    area_j = ((pull_n + LOAD_N - 5.0 * speed_m_s) * np.diff(seen.length_m)).sum()
    return float(area_j), float(np.ptp(seen.length_m)) / SLIP_M


@pytest.mark.long
def test_the_area_of_a_loop_is_that_of_the_closed_solution_at_every_speed():
    (fast_j, _), (slow_j, travel) = loop(40.0), loop(160.0)
    without_j, _ = loop(40.0, dataclasses.replace(ELASTIC, hysteresis_n=0.0))
    expected_j = 2.0 * FORCE_N * SLIP_M * (travel - 2.0 * np.tanh(0.5 * travel))
    # the damper lets the length lag by (c w / K)^2 / 2, 2e-3 in the faster cycle
    assert fast_j == pytest.approx(slow_j, rel=1e-2)
    assert slow_j == pytest.approx(expected_j, rel=1e-2)
    assert abs(without_j) < 5e-3 * fast_j


@pytest.mark.long
def test_the_compiled_motion_solves_the_rates():
    """With branches, damping and softening; DOP853 restarted at each edge of the drive."""
    voltage_v = np.array([3e3, 0.0, 9e3])
    drive, start = drive_of(voltage_v, 0.3), start_of(LAW)
    times_s = np.linspace(0.0, 0.8999, 300)
    found = SampledLaw(LAW, 15e3).respond(drive, times_s, start).length_m
    count = len(LAW.losses.branch_share)
    values = np.array([
        start["length_m"][0], 0.0, *start["relaxed_n"][0, :count], 0.0, start["longest_m"][0], 0.0,
    ])  # fmt: skip

    def change(_, y, volt_v):
        state = ActuatorState(y[0], y[1], y[2:-3], y[-3], y[-2], y[-1])
        rate = rates(LAW, state, volt_v, LOAD_N, MASS_KG)
        return np.array([
            rate.length_m, rate.speed_m_s, *rate.relaxed_n, rate.charge_v, rate.longest_m,
            rate.hysteresis_n,
        ])  # fmt: skip

    expected = np.empty(times_s.size)
    for k, volt_v in enumerate(voltage_v):
        span = drive.edge_s[k : k + 2]
        inside = (span[0] <= times_s) & (times_s < span[1])
        part = solve_ivp(
            change, span, values, method="DOP853", rtol=1e-8, atol=1e-11, args=(volt_v,),
            t_eval=np.append(times_s[inside], span[1]), max_step=3e-3,
        )  # fmt: skip
        expected[inside], values = part.y[0, :-1], part.y[:, -1]
    assert np.abs(found - expected).max() < 2e-5 * np.ptp(expected)


def test_derivatives_are_those_of_the_simulated_numbers():
    """Against central differences of 1e-4 of each parameter, from the same start."""
    names = (
        "hysteresis.force_n", "hysteresis.width", "shell.length_m", "shell.shear_modulus_pa",
        "viscosity.damping_n_s_per_m", "mullins.stretch", "dielectric.permittivity",
    )  # fmt: skip
    rng = np.random.default_rng(3)
    drive = drive_of(np.repeat(rng.uniform(0.0, 9e3, 12), 20), 0.01)
    times_s, start = np.linspace(0.0, 2.4, 300), start_of(LAW)
    found = SampledLaw(LAW, 15e3, names).respond(drive, times_s, start)
    for column, name in enumerate(names):
        step = 1e-4 * LAW.parameters()[name]
        ends = [
            SampledLaw(with_parameters(LAW, {name: LAW.parameters()[name] + s * step}), 15e3)
            .respond(drive, times_s, start)
            for s in (-1.0, 1.0)
        ]  # fmt: skip
        for what in ("length", "capacitance"):
            member = "length_m" if what == "length" else "capacitance_f"
            by = getattr(found, f"{what}_by")[:, column]
            expected = (getattr(ends[1], member) - getattr(ends[0], member)) / (2.0 * step)
            assert np.abs(by - expected).max() < 1e-3 * np.abs(expected).max(), (name, what)


def test_a_start_value_of_the_hysteresis_has_its_derivative():
    drive, times_s = drive_of(np.repeat([0.0, 6e3], 50), 0.01), np.linspace(0.0, 1.0, 50)
    rows = np.zeros((_motion.ROWS, 1))
    rows[-1, 0] = 1.0
    sampled, start = SampledLaw(LAW, 15e3), start_of(LAW)
    found = sampled.respond(drive, times_s, start, start_by=rows)
    ends = []
    for change in (-1e-4, 1e-4):
        moved = start.copy()
        moved["hysteresis_n"] += change
        ends.append(sampled.respond(drive, times_s, moved).length_m)
    expected = (ends[1] - ends[0]) / 2e-4
    assert np.abs(found.length_by[:, 0] - expected).max() < 1e-3 * np.abs(expected).max()


def test_small_motion_follows_the_linear_model():
    """A motion of 1 um against a width of 1 mm: the hysteresis acts as a spring."""
    law, still = LAW, dataclasses.replace(LAW, hysteresis_n=0.0)
    point, without = (linearise(each, 5e3, LOAD_N, MASS_KG) for each in (law, still))
    added = np.abs(point.poles).max() ** 2 - np.abs(without.poles).max() ** 2
    assert added == pytest.approx(FORCE_N / SLIP_M / MASS_KG, rel=0.02)
    sampled = SampledLaw(law, 15e3)
    start, _ = sampled.at_rest(5e3, 0.0, LOAD_N, longest_m=0.08)
    start["speed_m_s"] = 3e-5
    times_s = np.linspace(0.0, 0.5, 200)
    free = sampled.respond(drive_of(np.full(50, 5e3), 0.01), times_s, start)
    soft = linearise(law, 5e3, LOAD_N, MASS_KG, longest_m=0.08)
    values, vectors = np.linalg.eig(soft.a)
    shares = np.linalg.solve(vectors, np.eye(soft.b.size)[1] * 3e-5)
    expected = (vectors[0] * shares * np.exp(np.outer(times_s, values))).sum(axis=1).real
    seen = free.length_m - float(start["length_m"][0])
    assert np.abs(seen - expected).max() < 5e-3 * np.ptp(expected)


@pytest.mark.parametrize("kind", ["planar-hasel", "peano-hasel", "curling-hasel", "dea-stack"])
def test_every_kind_has_hysteresis_which_is_off_by_default(kind):
    law = ACTUATORS.find(kind)()
    assert law.losses.hysteresis_n == 0.0
    more = dataclasses.replace(law, hysteresis_n=0.1, hysteresis_width=0.004)
    assert (more.losses.hysteresis_n, more.losses.hysteresis_width) == (0.1, 0.004)


def test_the_twin_moves_with_it():
    config = TwinConfig.model_validate({"hysteresis": {"force_n": FORCE_N, "width": WIDTH}})
    voltage_v = np.repeat([4e3, 0.0, 6e3], 300)
    bench, lengths = native_bench(config, 0), np.empty(900)
    bench.move(voltage_v / config.amplifier.gain, 1, 0.3, lengths)
    sampled = SampledLaw(config.law, 15e3)
    start, _ = sampled.at_rest(0.0, 0.0, 0.0)
    drive = drive_of(voltage_v, 1e-4)
    drive = dataclasses.replace(drive, load_n=np.full(900, 0.3))
    expected = sampled.respond(drive, drive.edge_s[1:], start).length_m
    np.testing.assert_allclose(lengths, expected, rtol=3e-9)


def test_a_width_of_zero_is_refused():
    with pytest.raises(LimitError, match=r"^hysteresis.width = 0 is outside \[0.0001, 1\]"):
        PlanarHasel(hysteresis_width=0.0)
    with pytest.raises(LimitError, match=r"^The hysteresis has a force of 0 N and a width of 0"):
        dataclasses.replace(DeaStack().losses, hysteresis_width=0.0)


def test_a_collapsed_actuator_stops_and_takes_no_longer_than_one_that_moves():
    # beyond its table the force is constant: it got faster and faster, in ever shorter steps
    law = DeaStack(hysteresis_n=0.06, hysteresis_width=0.02)
    volt = np.where(np.arange(6000) < 200, 0.0, 15e3)
    sampled = SampledLaw(law, 16e3, ["actuator.shear_modulus_pa"])
    start, start_by = sampled.at_rest(0.0, 0.0, LOAD_N)
    times_s = np.linspace(0.0, 60.0, 600)
    begun_s = time.process_time()
    found = sampled.respond(drive_of(volt, 0.01), times_s, start, start_by=start_by)
    assert time.process_time() - begun_s < 1.0
    range_m = sampled.table.high_m - sampled.table.low_m
    assert found.length_m[0] > sampled.table.low_m
    assert sampled.table.low_m - 0.02 * range_m <= found.length_m[-1] <= sampled.table.low_m
    assert np.isfinite(found.length_by).all()
