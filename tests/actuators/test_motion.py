"""Motion of the twin's actuator against its law, linear models, and laws that are refused."""

import dataclasses

import numpy as np
import pytest

from haselab.actuators import (
    ActuatorLaw,
    ActuatorState,
    DeaStack,
    Drive,
    PlanarHasel,
    SampledLaw,
    equilibrium_m,
    law_table,
    linearise,
    rates,
)
from haselab.actuators.registry import ACTUATORS
from haselab.base import InputError, SafetyError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, native_bench

STEP_S = 1e-4
SLOW_OIL = {"dielectric": {"relaxation_share": 0.4, "relaxation_s": 0.3}}
CONFIGS = {
    "planar": TwinConfig(),
    "slow oil": TwinConfig.model_validate(SLOW_OIL),
    "stack": TwinConfig(kind="dea-stack"),
    "stiff stack": TwinConfig(kind="dea-stack", actuator={"shear_modulus_pa": 5e6}),
}


def stepped_v(steps: int) -> np.ndarray:
    """At the actuator: up, down to zero, up to another level."""
    return np.repeat([4e3, 0.0, 6e3], -(-steps // 3))[:steps]


def on_the_twin(config: TwinConfig, voltage_v: np.ndarray, load_n: float) -> np.ndarray:
    bench, lengths = native_bench(config, 0), np.empty(voltage_v.size)
    bench.move(voltage_v / config.amplifier.gain, 1, load_n, lengths)
    return lengths


def by_law(config: TwinConfig, voltage_v: np.ndarray, load_n: float) -> np.ndarray:
    """The same motion by the law alone, in steps of a fifth of the twin's."""
    law, count = config.law, voltage_v.size
    sampled = SampledLaw(law, 15e3)
    sampled.parameters["step_s"] = 0.2 * STEP_S
    same, edge_s = np.ones(count), STEP_S * np.arange(count + 1)
    drive = Drive(edge_s, voltage_v, load_n * same, config.load.mass_kg * same, 0.0 * same)
    start, _ = sampled.at_rest(0.0, 0.0, 0.0)
    return sampled.respond(drive, edge_s[1:], start).length_m


@pytest.mark.parametrize("name", CONFIGS)
def test_the_twin_moves_as_its_law_does(name):
    """Order 4; the kink where softening begins leaves 1e-9 of the length."""
    config, voltage_v = CONFIGS[name], stepped_v(900)
    expected = by_law(config, voltage_v, 0.3)
    assert np.ptp(expected) > 1e-6
    np.testing.assert_allclose(on_the_twin(config, voltage_v, 0.3), expected, rtol=3e-9)


@pytest.mark.parametrize("kind", ["planar-hasel", "peano-hasel", "curling-hasel", "dea-stack"])
def test_a_wait_of_the_twin_ends_where_its_short_steps_do(kind):
    """Steps of up to 2.5 ms instead of 0.1 ms: 1e-6 of the motion, and the lengths between too."""
    config = TwinConfig(kind=kind)
    bench, lengths = native_bench(config, 0), np.empty(6000)
    bench.move(np.array([0.8, 0.0, 1.2]), 2000, 2.0, lengths)
    expected = by_law(config, np.repeat([4e3, 0.0, 6e3], 2000), 2.0)
    assert np.abs(lengths - expected).max() < 2e-6 * np.ptp(expected)


@dataclasses.dataclass(frozen=True)
class Saturating(DeaStack):
    """A stack whose charge saturates with the voltage."""

    kind = "saturating"

    def capacitance_f(self, length_m, voltage_v=0.0):
        saturated = 1.0 / (1.0 + (np.asarray(voltage_v) / 8e3) ** 2)
        return super().capacitance_f(length_m) * 0.5 * (1.0 + saturated)

    electric_force_n = ActuatorLaw.electric_force_n


def test_a_capacitance_that_depends_on_the_voltage_goes_into_the_table_too(monkeypatch):
    """65 voltages to 15 kV, cubics between them."""
    find = ACTUATORS.find
    monkeypatch.setattr(
        ACTUATORS, "find", lambda kind: Saturating if kind == "saturating" else find(kind)
    )
    config = TwinConfig(kind="saturating")
    law = config.law
    assert law_table(law, 15e3).pull_n_v2.shape == (129, 1024)
    bench = native_bench(config, 0)
    assert bench.capacitance(0.03, 7e3) == pytest.approx(
        float(law.differential_capacitance_f(0.03, 7e3)), rel=1e-5
    )


@pytest.mark.parametrize("kind", [PlanarHasel, DeaStack])
def test_the_linear_model_is_the_derivative_of_rates_and_statics(kind):
    law, voltage_v, load_n, mass_kg = kind(), 5e3, 1.0, 0.25
    length_m = equilibrium_m(law, voltage_v, load_n)
    point = linearise(law, voltage_v, load_n, mass_kg, longest_m=1.5 * length_m)
    count = len(law.losses.branch_share)
    rest = np.array([point.length_m, 0.0, *[0.0] * count, voltage_v])
    used = point.b.size
    longest_m, share = 1.5 * length_m, np.array(law.losses.branch_share)

    def elastic_n(length_m):
        softening = law.losses.softening(longest_m / law.free_length_m)
        return float(law.elastic_force_n(length_m) * softening)

    def at(values, volts):
        """Rates of length, speed, force of each branch g (F - y), and slow voltage."""
        length, speed, *branches, slow = values
        state = ActuatorState(
            np.array(length), np.array(speed), elastic_n(length) - np.array(branches) / share,
            np.array(slow), np.array(longest_m),
        )  # fmt: skip
        change = rates(law, state, volts, load_n, mass_kg)
        slope = (elastic_n(length + 1e-6) - elastic_n(length - 1e-6)) / 2e-6
        branch_n_s = share * (slope * speed - change.relaxed_n)
        return np.array([change.length_m, change.speed_m_s, *branch_n_s, change.charge_v])

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
