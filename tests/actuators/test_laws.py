"""Each law against independent routes: derivatives, the C twin, published numbers."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.actuators import (
    ACTUATORS,
    VACUUM_F_PER_M,
    ActuatorLaw,
    CurlingHasel,
    DeaStack,
    Losses,
    PeanoHasel,
    PlanarHasel,
    SampledLaw,
    actuator_law,
    equilibrium_m,
    with_stated,
)
from haselab.base import InputError, LimitError, Limits
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import native_bench

LAWS = [PlanarHasel, DeaStack]
H = 1e-3


def slope(function, x: float, step: float) -> float:
    """Derivative by six points: an error of step^6 times the seventh derivative over 140."""
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    return sum(
        w * (function(x + k * step) - function(x - k * step)) for k, w in weights.items()
    ) / (60.0 * step)


@pytest.mark.parametrize("kind", LAWS)
@given(place=st.floats(0.05, 0.5), voltage_v=st.floats(10.0, 1e4), scale=st.floats(0.5, 2.0))
@settings(max_examples=40, deadline=None)
def test_forces_and_charge_are_derivatives_of_the_energy(kind, place, voltage_v, scale):
    law = kind(shear_modulus_pa=scale * kind().shear_modulus_pa)
    limits = law.length_limits_m
    length_m = limits.low + place * (limits.high - limits.low)
    step_m = H * law.free_length_m
    elastic_n = slope(lambda x: float(law.energy_j(x, 0.0)), length_m, step_m)
    # Truncation (1e-3)^6 and rounding 1e-16 / 1e-3 of the energy, which may be large against the
    # force near the free length.
    size_n = float(np.abs(law.energy_j(length_m, 0.0))) / law.free_length_m
    assert float(law.elastic_force_n(length_m)) == pytest.approx(
        elastic_n, rel=1e-9, abs=1e-11 * size_n + 1e-10
    )
    whole_n = slope(lambda x: float(law.energy_j(x, voltage_v)), length_m, step_m)
    electric_n = float(law.electric_force_n(length_m, voltage_v))
    assert elastic_n - electric_n == pytest.approx(whole_n, rel=1e-9, abs=1e-11 * size_n + 1e-10)
    charge_c = -slope(lambda v: float(law.energy_j(length_m, v)), voltage_v, 1e-3 * voltage_v)
    expected_c = float(law.capacitance_f(length_m, voltage_v)) * voltage_v
    # The energy also holds the elastic one, whose rounding the difference over 1e-3 V sees.
    rounding_c = 1e-13 * abs(float(law.energy_j(length_m, 0.0))) / (1e-3 * voltage_v)
    assert charge_c == pytest.approx(expected_c, rel=1e-9, abs=rounding_c)


@pytest.mark.parametrize("kind", LAWS)
def test_the_closed_forms_are_those_that_a_law_without_them_gets(kind):
    law = kind()
    limits = law.length_limits_m
    lengths_m = np.linspace(limits.low, limits.high, 50)[1:-1]
    np.testing.assert_allclose(
        ActuatorLaw.electric_force_n(law, lengths_m, 5e3), law.electric_force_n(lengths_m, 5e3),
        rtol=1e-8,
    )  # fmt: skip
    forces_n = law.elastic_force_n(lengths_m)
    # Fourth order with a step of 5e-4: (5e-4)^4 = 6e-14 of the fifth derivative.
    np.testing.assert_allclose(
        ActuatorLaw.elastic_force_n(law, lengths_m), forces_n, atol=1e-8 * np.abs(forces_n).max()
    )


@dataclasses.dataclass(frozen=True)
class Varactor(DeaStack):
    """Its charge saturates, so that capacitance depends on the voltage."""

    def capacitance_f(self, length_m, voltage_v=0.0):
        return super().capacitance_f(length_m) / (1.0 + (np.asarray(voltage_v) / 8e3) ** 2)

    electric_force_n = ActuatorLaw.electric_force_n


def test_a_capacitance_that_depends_on_the_voltage_keeps_energy_and_charge_consistent():
    law = Varactor()
    length_m, voltage_v = 0.03, 6e3
    # By hand: the integral of C v / (1 + v^2/a^2) over v is C a^2 / 2 ln(1 + V^2/a^2).
    free_f = float(DeaStack().capacitance_f(length_m))
    exact_j = free_f * 8e3**2 / 2.0 * np.log1p((voltage_v / 8e3) ** 2)
    assert float(law.coenergy_j(length_m, voltage_v)) == pytest.approx(exact_j, rel=1e-8)
    # C ~ 1 / x^2, so the force is -2 / x of the co-energy.
    assert float(law.electric_force_n(length_m, voltage_v)) == pytest.approx(
        -2.0 * exact_j / length_m, rel=1e-8
    )
    a2 = 8e3**2
    slope_f = free_f * (1 - voltage_v**2 / a2) / (1 + voltage_v**2 / a2) ** 2
    assert float(law.differential_capacitance_f(length_m, voltage_v)) == pytest.approx(
        slope_f, rel=1e-7
    )


def test_the_planar_law_has_the_numbers_of_the_c_twin():
    """A table of 1,024 lengths with cubics between them: 1e-6 of a value."""
    config = TwinConfig.model_validate(
        {"mullins": {"share": 0.3, "stretch": 1.2}, "electrodes": {"stiffening": 2.0}}
    )
    law, bench = config.planar_hasel, native_bench(config, 0)
    for length_m in np.linspace(0.9, 2.2, 27) * law.free_length_m:
        softening = law.losses.softening(1.0)  # the bench is new
        assert bench.elastic_force(length_m) == pytest.approx(
            float(law.elastic_force_n(length_m) * softening), rel=1e-6, abs=1e-6
        )
        assert bench.capacitance(length_m) == pytest.approx(
            float(law.capacitance_f(length_m)), rel=1e-6
        )
        assert bench.gap(length_m) == pytest.approx(float(law.gap_m(length_m)), rel=1e-6)


def test_the_planar_law_and_twin_toml_have_the_same_defaults_and_limits():
    config = TwinConfig()
    assert config.planar_hasel == PlanarHasel()
    for about in PlanarHasel.described():
        section, _, name = about.key.partition(".")
        field = type(getattr(config, section)).model_fields[name]
        bounds = {}
        for rule in field.metadata:
            for word in ("gt", "ge", "lt", "le"):
                if hasattr(rule, word):
                    bounds[word[0]] = getattr(rule, word)
        if bounds:
            assert bounds.get("g", about.low) == about.low, about.key
            assert bounds.get("l", about.high) == about.high, about.key


def test_a_soft_stack_collapses_where_the_literature_says():
    """Suo (2010), neo-Hooke without load: at 4^(-1/3) = 0.63 and V/d = 0.687 sqrt(mu / eps)."""
    law = DeaStack(extension_limit=1e6)
    critical_v = (
        np.sqrt((4 ** (-1 / 3) - 4 ** (-4 / 3)) * law.shear_modulus_pa)
        / np.sqrt(VACUUM_F_PER_M * law.permittivity)
        * law.layer_thickness_m
    )
    field = critical_v / law.layer_thickness_m
    scale = np.sqrt(law.shear_modulus_pa / (VACUUM_F_PER_M * law.permittivity))
    assert field / scale == pytest.approx(0.687, abs=5e-4)
    stretch = equilibrium_m(law, 0.9999 * critical_v, 0.0) / law.free_length_m
    # Near the peak the voltage is a parabola: 1e-4 below it, sqrt(1e-4) away in length.
    assert stretch == pytest.approx(4 ** (-1 / 3), abs=0.02)
    with pytest.raises(LimitError, match=r"no equilibrium .* Lower the voltage or the load"):
        equilibrium_m(law, 1.0001 * critical_v, 0.0)


@pytest.mark.parametrize("kilovolt", [0.3, 1.0])
def test_a_stack_has_the_blocked_force_and_free_strain_of_the_pressure(kilovolt):
    """Pelrine (1998): p = eps E^2 presses, p A blocked, and -p / Y of strain free, Y = 3 mu."""
    law, voltage_v = DeaStack(), 1e3 * kilovolt
    field_v_m = voltage_v / law.layer_thickness_m
    pressure_pa = VACUUM_F_PER_M * law.permittivity * field_v_m**2
    blocked_n = -float(law.electric_force_n(law.free_length_m, voltage_v))
    assert blocked_n == pytest.approx(pressure_pa * law.area_m2, rel=1e-12)
    strain = equilibrium_m(law, voltage_v, 0.0) / law.free_length_m - 1.0
    small = pressure_pa / (3.0 * law.shear_modulus_pa)
    # next order, neo-Hooke: 3 mu (e - e^2) = -p (1 - 3 e); Gent's limit adds e^3
    assert strain == pytest.approx(-small, abs=5.0 * small**2)
    layers_f = law.layers * VACUUM_F_PER_M * law.permittivity * law.area_m2 / 7e-4
    assert float(law.capacitance_f(law.free_length_m)) == pytest.approx(layers_f, rel=1e-12)


@pytest.mark.parametrize("voltage_v", [0.0, 3e3, 6e3])
def test_a_neo_hookean_stack_rests_where_its_cubic_has_a_root(voltage_v):
    """mu (l - l^-2) A = -eps (V/d)^2 A l^-3 + F: a polynomial in l, solved by its companion."""
    law = DeaStack(extension_limit=1e6)
    load_n = 0.5
    eps = VACUUM_F_PER_M * law.permittivity * (voltage_v / law.layer_thickness_m) ** 2
    mu, area = law.shear_modulus_pa, law.area_m2
    # l^4 mu A - l^3 F - l mu A + eps A = 0
    found = np.roots([mu * area, -load_n, 0.0, -mu * area, eps * area])
    real = np.sort(found[np.abs(found.imag) < 1e-9].real)
    stable = real[-1]  # the larger one; the smaller is the top of the barrier
    assert equilibrium_m(law, voltage_v, load_n) / law.free_length_m == pytest.approx(
        stable,
        rel=2e-5,  # J_m = 1e6 is not neo-Hooke's infinity: J / J_m < 1e-6 of the force
    )


def test_unknown_kinds_names_and_values_are_refused_with_what_to_do():
    assert {"planar-hasel", "dea-stack"} <= set(ACTUATORS.packages())
    with pytest.raises(InputError, match=r"No actuator 'muscle' .* dea-stack"):
        actuator_law("muscle", {})
    with pytest.raises(InputError, match=r"actuator.layer is not a parameter .* layers, "):
        actuator_law("dea-stack", {"layer": 3.0})
    with pytest.raises(InputError, match=r"actuator.layers = 0 is outside \[1, 100000\]"):
        actuator_law("dea-stack", {"layers": 0.0})
    with pytest.raises(InputError, match=r"branch_share is 0.1, but it must be a list of numbers"):
        actuator_law("dea-stack", {"branch_share": 0.1})
    with pytest.raises(InputError, match=r"layers is \(1.0,\), but it must be a number"):
        actuator_law("dea-stack", {"layers": (1.0,)})


def test_losses_that_cannot_be_are_refused():
    with pytest.raises(LimitError, match="1 branch shares and 0 relaxation times"):
        Losses(branch_share=(0.1,))
    with pytest.raises(LimitError, match="Use positive numbers"):
        Losses(branch_share=(0.1,), branch_relaxation_s=(0.0,))


def test_a_shell_stretched_beyond_its_chains_is_refused():
    law = PlanarHasel(locking_stretch=1.6)
    with pytest.raises(LimitError, match=r"shell.lateral_stretch = 3 is beyond .* 2.77"):
        _ = law.length_limits_m
    assert isinstance(PlanarHasel().length_limits_m, Limits)


@pytest.mark.parametrize("kind", [*LAWS, PeanoHasel, CurlingHasel])
def test_a_grid_has_the_values_of_the_functions(kind):
    law = kind()
    limits = law.length_limits_m
    lengths_m, voltages_v = np.linspace(limits.low, limits.high, 7), np.array([0.0, 100.0, 6e3])
    found = law.on_grid(lengths_m, voltages_v)
    np.testing.assert_allclose(found.elastic_n, law.elastic_force_n(lengths_m), rtol=1e-9)
    for k, voltage_v in enumerate([1.0, 100.0, 6e3]):  # below 1 V nothing changes
        electric_n = law.electric_force_n(lengths_m, voltage_v)
        np.testing.assert_allclose(
            found.pull_n_v2[k] * voltage_v**2, electric_n, rtol=1e-8, atol=1e-9
        )
        known_f = law.differential_capacitance_f(lengths_m, voltages_v[k])
        np.testing.assert_allclose(found.capacitance_f[k], known_f, rtol=1e-9)


@pytest.mark.parametrize("kind", [PeanoHasel, CurlingHasel])
def test_a_grid_solved_from_a_similar_law_is_the_same(kind):
    """A slope over 2e-4 of a parameter: of Newton's steps, even orders of the error cancel."""
    law = kind()
    limits = law.length_limits_m
    grid = np.linspace(limits.low, limits.high, 50), np.linspace(0.0, 9e3, 10)
    near = law.on_grid(*grid)
    for about in law.described():
        value = getattr(law, about.name)
        if isinstance(value, tuple) or not about.fitted or value == 0.0:
            continue
        both = [dataclasses.replace(law, **{about.name: value * (1.0 + h)}) for h in (1e-4, -1e-4)]
        cold, warm = ([part.on_grid(*grid, of) for part in both] for of in (None, near))
        for name in ("elastic_n", "capacitance_f", "pull_n_v2"):
            exact = getattr(cold[0], name) - getattr(cold[1], name)
            found = getattr(warm[0], name) - getattr(warm[1], name)
            rounding = 1e-10 * np.abs(getattr(near, name)).max()
            within = 1e-4 * np.abs(exact).max() + rounding
            assert np.abs(found - exact).max() <= within, (about.name, name)


def test_a_stated_list_is_the_whole_list():
    times = {"actuator.branch_relaxation_s[0]": 2.0}
    one = with_stated(DeaStack(), {"actuator.branch_share[0]": 0.2, **times})
    assert one.losses.branch_share == (0.2,) and one.losses.branch_relaxation_s == (2.0,)
    third = {
        f"actuator.branch_{of}[{k}]": 0.1 for of in ("share", "relaxation_s") for k in range(3)
    }
    assert with_stated(DeaStack(), third).losses.branch_share == (0.1, 0.1, 0.1)
    with pytest.raises(LimitError, match="2 branch shares and 1 relaxation times"):
        with_stated(DeaStack(), times)
    for wrong, what in (("branch_share", "a list of numbers"), ("permittivity[0]", "one number")):
        with pytest.raises(InputError, match=f"{wrong.split('[')[0]} is {what}"):
            with_stated(DeaStack(), {f"actuator.{wrong}": 3.0})


def test_a_law_that_is_valid_at_no_length_is_refused():
    law = PlanarHasel(shell_lateral_stretch=2.59, locking_stretch=1.5)
    with pytest.raises(LimitError, match=r"0\.0193867 and 0\.0114957 m, but the lower"):
        SampledLaw(law, 1e4)
