"""The compiled motion against a general solver, and its derivatives against differences."""

import dataclasses
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from haselab import _motion
from haselab.actuators import (
    ActuatorState,
    CurlingHasel,
    DeaStack,
    Drive,
    PeanoHasel,
    PlanarHasel,
    SampledLaw,
    equilibrium_m,
    rates,
    response,
    with_parameters,
)
from haselab.actuators.threads import in_threads
from haselab.base import InputError, LimitError

MASS_KG, LOAD_N = 0.25, 0.25 * 9.81
LAWS = {
    "planar": PlanarHasel(charge_share=0.1, charge_relaxation_s=2.0),
    "stack": DeaStack(),
}


def drive_of(seconds: float = 4.0, highest_v: float = 8e3) -> Drive:
    """A chirp with a step to zero and one to the top, 100 values a second."""
    count = round(100 * seconds)
    time_s = 0.01 * np.arange(count)
    voltage_v = 0.5 * highest_v + 0.3 * highest_v * np.sin(2.0 * np.pi * (0.2 + time_s) * time_s)
    voltage_v[count // 4 : count // 3] = 0.0
    voltage_v[count // 2 : count // 2 + 40] = highest_v
    same = np.ones(count)
    return Drive(0.01 * np.arange(count + 1), voltage_v, LOAD_N * same, MASS_KG * same, 5e3 * same)


def start_of(law, longest: float = 1.0):
    """At rest under the load, with all of the softening between that length and `longest` left."""
    length_m = equilibrium_m(law, 0.0, LOAD_N)
    state = ActuatorState.at_rest(law, length_m, longest_m=longest * length_m)
    found = np.zeros(1, _motion.STATE)
    found["length_m"], found["longest_m"] = state.length_m, state.longest_m
    found["relaxed_n"][0, : state.relaxed_n.size] = state.relaxed_n
    return found


def solved(law, drive: Drive, start, times_s):
    """The same motion by DOP853 from the rates in Python, restarted at every edge."""
    branches = len(law.losses.branch_share)
    values = np.concatenate([
        [start["length_m"][0], start["speed_m_s"][0]], start["relaxed_n"][0, :branches],
        [start["charge_v"][0], start["longest_m"][0]],
    ])  # fmt: skip
    found = np.empty(times_s.size)

    def change(_, y, volt_v):
        state = ActuatorState(y[0], y[1], y[2 : 2 + branches], y[-2], y[-1])
        rate = rates(law, state, volt_v, LOAD_N, MASS_KG)
        return np.array([rate.length_m, rate.speed_m_s, *rate.relaxed_n, rate.charge_v,
                         rate.longest_m])  # fmt: skip

    for k, volt_v in enumerate(drive.voltage_v):
        # the rates know no carrier: its mean square is part of the voltage's
        span = drive.edge_s[k : k + 2]
        inside = (span[0] <= times_s) & (times_s < span[1])
        part = solve_ivp(
            change, span, values, method="DOP853", rtol=1e-10, atol=1e-13, args=(volt_v,),
            t_eval=np.append(times_s[inside], span[1]), max_step=2e-3,
        )  # fmt: skip
        found[inside], values = part.y[0, :-1], part.y[:, -1]
    return found


@pytest.mark.long
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("longest", [1.0, 1.3], ids=["new", "softened before"])
def test_the_compiled_motion_solves_the_rates(name, longest):
    """Order 4 at 2.5 ms and 33 rad/s: 1e-6 of the span; 2e-5 where a kink of softening is near."""
    law = LAWS[name]
    drive = drive_of(2.0, 8e3 if name == "planar" else 3e3)
    drive = dataclasses.replace(drive, ripple_v2=np.zeros(drive.voltage_v.size))
    times_s = np.linspace(0.001, 1.999, 700)
    start = start_of(law, longest)
    found = SampledLaw(law, 15e3).respond(drive, times_s, start).length_m
    expected = solved(law, drive, start, times_s)
    assert np.abs(found - expected).max() < 2e-5 * np.ptp(expected)


@pytest.mark.parametrize("name", LAWS)
def test_half_the_step_gives_a_sixteenth_of_the_error(name):
    law = dataclasses.replace(LAWS[name], **({"softening_share": 0.0} if name == "planar" else {}))
    sampled, drive = SampledLaw(law, 15e3), drive_of(highest_v=3e3)
    times_s = drive.edge_s[10::40]
    lengths = []
    for step_s in (1e-2, 5e-3, 1e-4):
        sampled.parameters["step_s"], sampled.parameters["phase"] = step_s, 10.0
        lengths.append(sampled.respond(drive, times_s, start_of(law)).length_m)
    coarse, fine = (np.abs(part - lengths[2]).max() for part in lengths[:2])
    assert 10.0 < coarse / fine < 25.0


BY = {
    "planar": (
        "shell.shear_modulus_pa", "shell.locking_stretch", "shell.length_m",
        "electrodes.stiffness_n_per_m", "electrodes.stiffening", "viscosity.share[0]",
        "viscosity.share[2]", "viscosity.relaxation_s[1]", "viscosity.damping_n_s_per_m",
        "mullins.share", "mullins.stretch", "mullins.width", "dielectric.permittivity",
        "dielectric.capacitance_exponent", "dielectric.relaxation_share",
        "dielectric.relaxation_s",
    ),
    "stack": (
        "actuator.layers", "actuator.shear_modulus_pa", "actuator.permittivity",
        "actuator.density_kg_m3", "actuator.branch_share[1]", "actuator.damping_n_s_per_m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_are_those_of_the_simulated_numbers(name):
    """Against central differences of 1e-4, whose own error is 1e-5 of the largest one.

    The start is the same state for all, so that only what the parameter does afterwards counts.
    """
    law, drive = LAWS[name], drive_of(highest_v=8e3 if name == "planar" else 3e3)
    times_s = np.linspace(0.0, 4.0, 400)
    start = start_of(law, 1.2)
    found = SampledLaw(law, 15e3, BY[name]).respond(drive, times_s, start)
    values = law.parameters()
    for column, key in enumerate(BY[name]):
        field, _, index = key.partition("[")
        value = values[field][int(index[:-1])] if index else values[field]
        step = 1e-4 * value
        ends = [
            SampledLaw(with_parameters(law, {key: value + s * step}), 15e3).respond(
                drive, times_s, start
            )
            for s in (-1.0, 1.0)
        ]
        for by, what in ((found.length_by, "length_m"), (found.capacitance_by, "capacitance_f")):
            expected = (getattr(ends[1], what) - getattr(ends[0], what)) / (2.0 * step)
            worst = np.abs(by[:, column] - expected).max()
            assert worst < 3e-4 * np.abs(expected).max(), (key, what)


def test_a_part_of_the_columns_that_starts_late_is_waited_for(monkeypatch):
    """As on a busy machine, where the second thread has not begun when the first is done."""
    law, drive, times_s = LAWS["planar"], drive_of(), np.linspace(0.0, 4.0, 50)
    sampled, start = SampledLaw(law, 15e3, BY["planar"]), start_of(law, 1.2)
    monkeypatch.setattr("haselab.actuators.response._CORES", 2)
    monkeypatch.setattr("haselab.actuators.response._COLUMNS_EACH", 4)

    def late(job, items, most):
        """One thread, which pauses after each part."""
        return in_threads(lambda item: (job(item), time.sleep(0.2))[0], items, 1)

    monkeypatch.setattr("haselab.actuators.response.in_threads", late)
    again = sampled.respond(drive, times_s, start)
    monkeypatch.setattr("haselab.actuators.response._CORES", 1)
    found = sampled.respond(drive, times_s, start)
    np.testing.assert_array_equal(again.length_by, found.length_by)
    np.testing.assert_array_equal(again.capacitance_by, found.capacitance_by)


def test_start_values_can_be_parameters_too():
    law, drive = LAWS["planar"], drive_of()
    times_s, start = np.linspace(0.0, 4.0, 50), start_of(LAWS["planar"], 1.2)
    rows = np.zeros((_motion.ROWS, 3))
    rows[0, 0] = rows[1, 1] = rows[3, 2] = 1.0
    sampled = SampledLaw(law, 15e3)
    found = sampled.respond(drive, times_s, start, start_by=rows)
    for column, (field, step) in enumerate(
        (("length_m", 1e-6), ("speed_m_s", 1e-5), ("longest_m", 1e-6))
    ):
        ends = []
        for s in (-1.0, 1.0):
            moved = start.copy()
            moved[field] += s * step
            ends.append(sampled.respond(drive, times_s, moved).length_m)
        expected = (ends[1] - ends[0]) / (2.0 * step)
        assert np.abs(found.length_by[:, column] - expected).max() < 1e-3 * np.abs(expected).max()


def test_a_time_outside_the_drive_is_refused():
    law = LAWS["stack"]
    with pytest.raises(InputError, match=r"^Lengths were requested from 0 to 5 s, but"):
        SampledLaw(law, 15e3).respond(drive_of(), [0.0, 5.0], start_of(law))


def test_edges_that_do_not_rise_are_refused():
    one = np.ones(2)
    with pytest.raises(InputError, match=r"^The edges of a drive do not rise"):
        Drive(np.array([0.0, 1.0, 1.0]), one, one, one, one)
    with pytest.raises(InputError, match=r"^A drive has 3 edges and 3 voltages"):
        Drive(np.array([0.0, 1.0, 2.0]), np.ones(3), one, one, one)


@pytest.mark.parametrize("longest", [0.0, 0.06], ids=["new", "softened before"])
def test_the_state_at_rest_stays_and_has_the_derivatives_of_its_equilibrium(longest):
    law, by = LAWS["planar"], BY["planar"]
    sampled = SampledLaw(law, 15e3, by)
    state, rows = sampled.at_rest(4e3, 5e3, LOAD_N, longest_m=longest)
    held = Drive(
        np.array([0.0, 30.0]), np.array([4e3]), np.array([LOAD_N]), np.array([MASS_KG]),
        np.array([5e3]),
    )  # fmt: skip
    found = sampled.respond(held, [30.0], state, start_by=rows)
    assert found.length_m[0] == pytest.approx(float(state["length_m"][0]), abs=2e-9)
    # where everything rests, so do the derivatives
    np.testing.assert_allclose(
        found.length_by[0], rows[0], rtol=0.0, atol=1e-4 * np.abs(rows[0]).max()
    )
    for column, name in enumerate(by):
        field, _, index = name.partition("[")
        value = law.parameters()[field]
        value = value[int(index[:-1])] if index else value
        lengths = [
            equilibrium_m(
                with_parameters(law, {name: value * factor}),
                np.hypot(4e3, np.sqrt(5e3)), LOAD_N, longest_m=longest or None,
            )
            for factor in (0.999, 1.001)
        ]  # fmt: skip
        expected = (lengths[1] - lengths[0]) / (0.002 * value)
        scale = max(abs(expected), 1e-5 / value)
        assert rows[0, column] == pytest.approx(expected, abs=1e-3 * scale), name


def test_the_index_after_the_last_adds_a_branch():
    law = with_parameters(
        PlanarHasel(), {"viscosity.share[3]": 0.1, "viscosity.relaxation_s[3]": 9.0}
    )
    assert law.losses.branch_share[3:] == (0.1,) and law.losses.branch_relaxation_s[3:] == (9.0,)
    with pytest.raises(LimitError, match=r"4 branch shares and 3 relaxation times"):
        _ = with_parameters(PlanarHasel(), {"viscosity.share[3]": 0.1}).losses
    with pytest.raises(InputError, match=r"viscosity.share\[4\] does not exist: .* has 3 values"):
        with_parameters(PlanarHasel(), {"viscosity.share[4]": 0.1})


@pytest.mark.parametrize("law", [PeanoHasel(), CurlingHasel()], ids=lambda law: law.kind)
def test_derivatives_of_a_pouch_are_differences_of_solved_laws(law):
    # a similar law starts from the solution of this one, with a single step of Newton
    name, rel = "actuator.film_stiffness_n_per_m", 1e-3
    table = SampledLaw(law, 1e4, [name])
    ends = [
        SampledLaw(with_parameters(law, {name: 25e3 * (1.0 + s * rel)}), 1e4).table
        for s in (-1.0, 1.0)
    ]
    by = (ends[1].elastic_n - ends[0].elastic_n) / (2.0 * rel * 25e3)
    np.testing.assert_allclose(table._elastic[0], by, atol=1e-4 * np.abs(by).max())
    by = (ends[1].pull_n_v2 - ends[0].pull_n_v2) / (2.0 * rel * 25e3)
    np.testing.assert_allclose(table._pull[0], by, atol=1e-3 * np.abs(by).max())


def test_the_law_that_was_just_simulated_is_not_tabulated_again(monkeypatch):
    law, tabulated = PeanoHasel(damping_n_s_per_m=6.25), []
    table_of = response.law_table
    monkeypatch.setattr(
        response, "law_table", lambda *what: tabulated.append(what) or table_of(*what)
    )
    SampledLaw(law, 1e4)
    SampledLaw(law, 1e4, ["actuator.permittivity"])
    assert len(tabulated) == 1
