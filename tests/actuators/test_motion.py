"""Motion by a law in Python against the compiled twin, a solver of its own, and linear systems."""

import dataclasses
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from haselab.actuators import (
    ACTUATORS,
    ActuatorLaw,
    ActuatorState,
    DeaStack,
    PlanarHasel,
    equilibrium_m,
    law_table,
    linearise,
    motion_substeps,
    rates,
    simulate,
)
from haselab.base import InputError, SafetyError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, native_bench

STEP_S = 1e-4
SLOW_OIL = {"dielectric": {"relaxation_share": 0.4, "relaxation_s": 0.3}}


def stepped_v(steps: int) -> np.ndarray:
    """At the actuator: up, down to zero, up to another level."""
    return np.repeat([4e3, 0.0, 6e3], -(-steps // 3))[:steps]


def in_c(config: TwinConfig, voltage_v: np.ndarray, load_n: float) -> np.ndarray:
    bench, lengths = native_bench(config, 0), np.empty(voltage_v.size)
    bench.move(voltage_v / config.amplifier.gain, 1, load_n, lengths)
    return lengths


@pytest.mark.parametrize("sections", [{}, SLOW_OIL], ids=["default", "slow oil"])
def test_the_planar_law_moves_as_the_c_twin_does(sections):
    """Same scheme, so only rounding differs: 1e-16 a step, over the 1,500 of the test."""
    config = TwinConfig.model_validate(sections)
    voltage_v = stepped_v(1500)
    lengths, _ = simulate(config.law, voltage_v, load_n=1.5, mass_kg=0.25, step_s=STEP_S)
    np.testing.assert_allclose(lengths, in_c(config, voltage_v, 1.5), rtol=1e-12)


def by_law(config: TwinConfig, voltage_v: np.ndarray, load_n: float) -> np.ndarray:
    """The same motion in Python, in as many substeps as the C twin takes."""
    law = config.law
    count = motion_substeps(law, law_table(law, 15e3), STEP_S, 0.02)
    lengths, _ = simulate(
        law, np.repeat(voltage_v, count), load_n=load_n, mass_kg=config.load.mass_kg,
        step_s=STEP_S / count,
    )  # fmt: skip
    return lengths[count - 1 :: count]


@pytest.mark.parametrize("modulus_pa", [15e3, 5e6], ids=["soft", "stiff, more substeps"])
def test_the_stack_in_the_c_twins_table_moves_as_its_law_does(modulus_pa):
    """The table's error is at most 1e-6 of the largest force; here it is 1e-9 of the motion."""
    config = TwinConfig(kind="dea-stack", actuator={"shear_modulus_pa": modulus_pa})
    voltage_v = stepped_v(900)
    found = in_c(config, voltage_v, 0.3)
    assert np.ptp(found) > 5e-4 * 15e3 / modulus_pa
    np.testing.assert_allclose(found, by_law(config, voltage_v, 0.3), rtol=1e-9)


@dataclasses.dataclass(frozen=True)
class Saturating(DeaStack):
    """A stack whose charge saturates with the voltage."""

    kind = "saturating"

    def capacitance_f(self, length_m, voltage_v=0.0):
        saturated = 1.0 / (1.0 + (np.asarray(voltage_v) / 8e3) ** 2)
        return super().capacitance_f(length_m) * 0.5 * (1.0 + saturated)

    electric_force_n = ActuatorLaw.electric_force_n


@pytest.fixture
def saturating(monkeypatch: pytest.MonkeyPatch) -> TwinConfig:
    theirs = EntryPoint("saturating", f"{__name__}:Saturating", ACTUATORS.group)
    monkeypatch.setattr(ACTUATORS, "others", lambda: (theirs,))
    return TwinConfig(kind="saturating")


def test_a_capacitance_that_depends_on_the_voltage_goes_into_the_table_too(saturating):
    """Nine voltages to 15 kV, cubics between them: 1e-3 of the force at a corner of 8 kV."""
    law = saturating.law
    assert law_table(law, 15e3).pull_n_v2.shape == (9, 1024)
    voltage_v = stepped_v(900)
    lengths, linear = (
        by_law(saturating, voltage_v, 0.3),
        by_law(TwinConfig(kind="dea-stack"), voltage_v, 0.3),
    )
    error_m = np.abs(in_c(saturating, voltage_v, 0.3) - lengths).max()
    assert error_m < 2e-3 * np.abs(linear - lengths).max()
    bench = native_bench(saturating, 0)
    assert bench.capacitance(0.03, 7e3) == pytest.approx(
        float(law.differential_capacitance_f(0.03, 7e3)), rel=2e-3
    )


def rate_vector(law, state_values, voltage_v, load_n, mass_kg):
    """`rates` for a solver: length, speed, branches, slow voltage."""
    length, speed, *branches, slow = state_values
    state = ActuatorState(
        np.array(length), np.array(speed), np.array(branches), np.array(slow),
        np.array(law.free_length_m), np.array(0.0),
    )  # fmt: skip
    change = rates(law, state, voltage_v, load_n, mass_kg)
    return np.array([change.length_m, change.speed_m_s, *change.branch_n, change.slow_v])


@pytest.mark.parametrize("kind", [PlanarHasel, DeaStack])
def test_steps_converge_to_the_solution_of_the_rates(kind):
    """First order: half the step, half the error."""
    law = kind(softening_share=0.0) if kind is PlanarHasel else kind()
    start = [law.free_length_m, 0.0, *[0.0] * len(law.losses.branch_share), 0.0]
    solved = solve_ivp(
        lambda _, y: rate_vector(law, y, 4e3, 0.3, 0.25), (0.0, 0.3), start,
        method="LSODA", rtol=1e-10, atol=1e-13,
    ).y[0, -1]  # fmt: skip
    errors = []
    for step_s in (2e-4, 1e-4):
        voltage_v = np.full(round(0.3 / step_s), 4e3)
        lengths, _ = simulate(law, voltage_v, load_n=0.3, mass_kg=0.25, step_s=step_s)
        errors.append(lengths[-1] - solved)
    assert abs(errors[1]) < 1e-3 * law.free_length_m
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)


def test_many_actuators_move_at_once_as_each_alone():
    law, voltage_v = DeaStack(), stepped_v(90)
    loads_n, masses_kg = np.array([0.0, 0.2, 0.4]), np.array([0.05, 0.1, 0.3])
    together, state = simulate(
        law, voltage_v[:, None], load_n=loads_n, mass_kg=masses_kg, step_s=STEP_S
    )
    assert state.branch_n.shape == (3, 2)
    for k in range(3):
        alone, _ = simulate(law, voltage_v, load_n=loads_n[k], mass_kg=masses_kg[k], step_s=STEP_S)
        np.testing.assert_array_equal(together[:, k], alone)
    with pytest.raises(InputError, match="voltage_v has no values"):
        simulate(law, [], load_n=0.0, mass_kg=0.1, step_s=STEP_S)


@pytest.mark.parametrize("kind", [PlanarHasel, DeaStack])
def test_the_linear_model_is_the_derivative_of_rates_and_statics(kind):
    law, voltage_v, load_n, mass_kg = kind(), 5e3, 1.0, 0.25
    length_m = equilibrium_m(law, voltage_v, load_n)
    point = linearise(law, voltage_v, load_n, mass_kg, longest_m=1.5 * length_m)
    count = len(law.losses.branch_share)
    rest = np.array([point.length_m, 0.0, *[0.0] * count, voltage_v])
    used = point.b.size

    def at(values, volts):
        length, speed, *branches, slow = values
        state = ActuatorState(
            np.array(length), np.array(speed), np.array(branches), np.array(slow),
            np.array(1.5 * length_m), np.array(0.0),
        )  # fmt: skip
        change = rates(law, state, volts, load_n, mass_kg)
        return np.array([change.length_m, change.speed_m_s, *change.branch_n, change.slow_v])

    scale = np.array([1e-6, 1e-3, *[1e-3] * count, 1.0])
    numeric = np.stack(
        [(at(rest + s * e, voltage_v) - at(rest - s * e, voltage_v)) / (2 * s)
         for s, e in zip(scale, np.eye(rest.size), strict=True)], axis=1,
    )  # fmt: skip
    np.testing.assert_allclose(point.a, numeric[:used, :used], rtol=1e-5, atol=1e-4)
    higher, lower = (
        equilibrium_m(law, voltage_v + dv, load_n, longest_m=1.5 * length_m) for dv in (1.0, -1.0)
    )
    assert point.gain_m_per_v == pytest.approx((higher - lower) / 2.0, rel=1e-5)
    assert point.poles.real.max() < 0.0
    # One resonance of two poles more than zeros; each branch has its pole and its zero.
    assert (point.poles.size, point.zeros.size) == (2 + count, count)
    np.testing.assert_allclose(
        np.sort(point.zeros.real), np.sort(-1.0 / np.array(law.losses.branch_relaxation_s)),
        rtol=1e-6,
    )  # fmt: skip


def test_charge_creep_adds_a_slow_state():
    law = PlanarHasel(charge_share=0.3)
    point = linearise(law, 5e3, 1.0, 0.25)
    assert point.a.shape == (6, 6)
    assert linearise(PlanarHasel(), 5e3, 1.0, 0.25).gain_m_per_v == pytest.approx(
        point.gain_m_per_v, rel=1e-9
    )


# ---- what the twin refuses ---------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Kinked(DeaStack):
    """A law with a corner."""

    def gap_m(self, length_m):
        return np.abs(np.asarray(length_m) - 0.031) + 1e-3


@dataclasses.dataclass(frozen=True)
class Infinite(DeaStack):
    """A law that is not defined everywhere."""

    def elastic_force_n(self, length_m):
        return np.where(np.asarray(length_m) > 0.05, np.nan, 1.0)


@dataclasses.dataclass(frozen=True)
class Flat(DeaStack):
    """Layers without thickness."""

    def gap_m(self, length_m):
        return 0.0 * np.asarray(length_m)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Kinked, r"gap of the law dea-stack is not smooth"),
        (Infinite, r"value that is not finite \(elastic_n\)"),
        (Flat, r"gap_m = 0 within its length limits. It must be above 0"),
    ],
)
def test_a_law_that_cannot_be_interpolated_is_refused(law, words):
    with pytest.raises(InputError, match=words):
        law_table(law(), 1e4)


def test_a_stiff_actuator_gets_substeps_and_too_stiff_a_one_is_refused():
    law = DeaStack()
    table = law_table(law, 1e4)
    assert motion_substeps(law, table, STEP_S, 0.1) == 1
    stiff = DeaStack(shear_modulus_pa=1e7)
    table = law_table(stiff, 1e4)
    assert motion_substeps(stiff, table, STEP_S, 0.02) > 3
    with pytest.raises(InputError, match=r"follows at most 1e\+03 rad/s"):
        motion_substeps(DeaStack(shear_modulus_pa=1e8), law_table(
            DeaStack(shear_modulus_pa=1e8), 1e4), 1e-2, 1e-9)  # fmt: skip


def test_a_collapse_takes_the_output_away_and_says_why():
    config = TwinConfig.model_validate(
        {"kind": "dea-stack", "actuator": {"shear_modulus_pa": 4e3}, "load": {"mass_kg": 0.1}}
    )
    bench = TwinBench(config, 0)
    with pytest.raises(SafetyError, match=r"left the range of 8.75 to 140 mm .* Lower"):
        for drive_v in np.arange(0.0, 2.0, 0.05):
            bench.write(drive_v)
            bench.wait(0.5)
    assert bench.output_v == 0.0
    assert 5e3 * drive_v > 6e3  # it rests at 6 kV, by its equilibrium
    assert equilibrium_m(config.law, 6e3, 0.981) > config.law.length_limits_m.low


def test_the_weight_on_a_stack_hangs_where_its_law_rests():
    config = TwinConfig.model_validate({"kind": "dea-stack", "load": {"mass_kg": 0.1}})
    bench = TwinBench(config, 0)
    # Creep of 3 s (1 + 0.1) is over after 120 s; the table's error is 1e-9.
    assert bench.length_m == pytest.approx(equilibrium_m(config.law, 0.0, 0.981), rel=1e-8)
    bench.write(1.0)
    bench.wait(120.0)
    assert bench.length_m == pytest.approx(equilibrium_m(config.law, 5e3, 0.981), rel=1e-8)
