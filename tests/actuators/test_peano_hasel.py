"""The Peano-HASEL with its film against brute force, quadrature, and the ideal pouch."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq, minimize_scalar

from haselab.actuators import ActuatorLaw, CurlingHasel, PeanoHasel, equilibrium_m, law_table
from haselab.base import InputError, LimitError

KINDS = [PeanoHasel, CurlingHasel]
H = 1e-5  # of the free length: a fiftieth of the rounding of the film of one pouch
PLACES = st.floats(0.05, 0.95)


def at(law: ActuatorLaw, place: float) -> float:
    limits = law.length_limits_m
    return limits.low + place * (limits.high - limits.low)


def slope(function, x: float, step: float) -> float:
    """Derivative by six points: an error of step^6 times the seventh derivative over 140."""
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    return sum(
        w * (function(x + k * step) - function(x - k * step)) for k, w in weights.items()
    ) / (60.0 * step)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@given(place=PLACES, voltage_v=st.floats(1.0, 1.4e4))
@settings(max_examples=40, deadline=None)
def test_forces_and_charge_are_derivatives_of_the_energy(kind, place, voltage_v):
    law = kind()
    length_m, step_m = at(law, place), H * law.free_length_m
    # energies are a difference of terms up to 0.2 J, rounded to 1e-16 of them, over 1e-6 m
    rounding_n = 1e-16 * 0.2 / step_m
    elastic_n = float(law.elastic_force_n(length_m))
    electric_n = float(law.electric_force_n(length_m, voltage_v))
    for at_v, force_n in ((0.0, elastic_n), (voltage_v, elastic_n - electric_n)):
        expected_n = slope(lambda x, v=at_v: float(law.energy_j(x, v)), length_m, step_m)
        assert force_n == pytest.approx(expected_n, rel=1e-8, abs=10.0 * rounding_n)
    step_v = max(1e-3 * voltage_v, 0.1)
    charge_c = -slope(lambda v: float(law.energy_j(length_m, v)), voltage_v, step_v)
    expected_c = float(law.capacitance_f(length_m, voltage_v)) * voltage_v
    assert charge_c == pytest.approx(expected_c, rel=1e-8, abs=1e-14 * 0.2 / step_v)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", [0.2, 0.6, 0.72, 0.9])
def test_the_coenergy_is_the_integral_of_the_charge(kind, place):
    law = kind()
    length_m = at(law, place)
    expected_j, _ = quad(
        lambda v: float(law.capacitance_f(length_m, v)) * v, 0.0, 8e3, epsrel=1e-10, limit=200
    )
    assert float(law.coenergy_j(length_m, 8e3)) == pytest.approx(expected_j, rel=1e-9)


@given(place=PLACES, voltage_v=st.floats(0.0, 1.4e4))
@settings(max_examples=25, deadline=None)
def test_the_energy_is_the_minimum_over_the_zipped_length(place, voltage_v):
    """The formula of the docstring, minimised without derivatives."""
    law = PeanoHasel()
    pouch, width_m = law.pouch, law.rounding_m
    length_m = at(law, place)
    scale_n = law.film_stiffness_n_per_m * width_m
    half_n = 0.5 * law.zipped_f_per_m * law.half_zipped_v**2
    electrode_m = law.electrode_length_m
    theta_j = half_n * law.zipped_share**2 / (1.0 - law.zipped_share) * electrode_m

    def energy_j(angle: float) -> float:
        z = float(pouch.zipped_m(angle))
        stretch_m = length_m / law.pouches - pouch.rest_m + float(pouch.stroke_m(angle))
        film_j, _ = quad(
            lambda u: scale_n * np.logaddexp(0.0, u / width_m), stretch_m - 60.0 * width_m,
            stretch_m, epsrel=1e-12, epsabs=1e-16, limit=200,
            points=[0.0] if stretch_m > 0.0 else None,
        )  # fmt: skip
        if stretch_m - 60.0 * width_m > 0.0:  # the rest of the integral is a parabola
            film_j += 0.5 * law.film_stiffness_n_per_m * (stretch_m - 60.0 * width_m) ** 2
            film_j += scale_n * width_m * math.pi**2 / 6.0
        resisted_j = -half_n * (z + electrode_m * math.log1p(-z / electrode_m))
        zipping_j = 0.5 * law.zipped_f_per_m * voltage_v**2 * z
        return film_j + resisted_j - theta_j * math.log(z / electrode_m) - zipping_j

    low, high = pouch.rest_angle_rad, 0.5 * math.pi
    found = minimize_scalar(
        energy_j, bounds=(low + 1e-9, high - 1e-7), method="bounded", options={"xatol": 1e-12}
    )
    spring_j = 0.5 * law.restoring_n_per_m * (length_m / law.pouches - pouch.rest_m) ** 2
    unzipped_f = law.unzipped_share * law.zipped_f_per_m * electrode_m
    expected_j = law.pouches * (found.fun + spring_j - 0.5 * unzipped_f * voltage_v**2)
    assert float(law.energy_j(length_m, voltage_v)) == pytest.approx(
        expected_j, rel=1e-8, abs=1e-10
    )


@pytest.mark.long
@pytest.mark.parametrize("force_n", [0.2, 1.0, 4.0])
def test_without_compliance_and_resistance_it_is_the_ideal_pouch(force_n):
    law = PeanoHasel(
        pouches=1.0, pouch_width_m=0.01, film_stiffness_n_per_m=1e8, rounding_m=1e-7,
        half_zipped_v=1.0, zipped_share=1e-3, restoring_n_per_m=1e-3,
    )  # fmt: skip
    found_m = equilibrium_m(law, 1e4, force_n)
    ideal = brentq(
        lambda a: float(law.ideal_force_n(a, 1e4)) - force_n, law.pouch.rest_angle_rad, 1.57
    )
    stretch_m = 1e-7 * math.log(math.expm1(force_n / (1e8 * 1e-7)))  # of the film
    expected_m = law.pouch.rest_m - float(law.pouch.stroke_m(ideal)) + stretch_m
    # left: the resistance and restoring_n_per_m, together below 2e-5 of a stroke of 2 mm
    assert found_m == pytest.approx(expected_m, abs=4e-8)


def test_zipping_ends_with_the_electrodes():
    law = PeanoHasel()
    limits = law.length_limits_m
    lengths_m = np.linspace(limits.low, limits.high, 301)
    full_f = law.pouches * law.zipped_f_per_m * law.electrode_length_m
    for voltage_v in (0.0, 300.0, 2e3, 1.5e4, 1e5):
        zipped = law.capacitance_f(lengths_m, voltage_v) / full_f - law.unzipped_share
        assert (zipped > 0.0).all() and (zipped < 1.0).all()
    # the resistance's definitions: a slack film zips its shares at 0 V and at half_zipped_v
    slack_m = limits.low
    assert float(law.capacitance_f(slack_m, 0.0) / full_f) == pytest.approx(0.1 + 0.15, rel=1e-9)
    half = float(law.capacitance_f(slack_m, law.half_zipped_v) / full_f) - 0.1
    # theta adds 0.15^2 / 0.85 / 2 to the balance at one half: z / (1 - z) = 1 + theta / z
    assert half == pytest.approx(brentq(lambda z: z / (1 - z) - 1 - 0.15**2 / 0.85 / z, 0.4, 0.6),
                                 rel=1e-9)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_values_do_not_depend_on_what_is_computed_with_them(kind):
    law = kind()
    limits = law.length_limits_m
    lengths_m = np.linspace(limits.low, limits.high, 997)
    for voltage_v in (0.0, 299.999, 300.001, 6e3):
        together = law.electric_force_n(lengths_m, voltage_v)
        alone = [float(law.electric_force_n(x, voltage_v)) for x in lengths_m[::100]]
        # the tension of 50 N is a difference of lengths, rounded to 1e-16 of 0.1 m times 25 kN/m
        np.testing.assert_allclose(together[::100], alone, rtol=1e-8, atol=1e-11)
    below, above = (law.electric_force_n(lengths_m, v) for v in (299.999, 300.001))
    np.testing.assert_allclose(below, above, rtol=1e-4, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_the_capacitance_that_a_carrier_senses_is_that_of_what_has_zipped(kind):
    law = kind()
    length_m = at(law, 0.6)
    assert float(law.differential_capacitance_f(length_m, 5e3)) == float(
        law.capacitance_f(length_m, 5e3)
    )


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_voltage_shortens_it_and_load_lengthens_it(kind):
    law = kind()
    rests_m = [equilibrium_m(law, v, 2.45) for v in (0.0, 2e3, 5e3, 1e4)]
    assert (np.diff(rests_m) < 0.0).all()
    assert rests_m[0] - rests_m[-1] > 0.02 * rests_m[0]
    assert equilibrium_m(law, 0.0, 0.0) == pytest.approx(law.free_length_m, rel=1e-12)
    assert law.free_length_m < rests_m[0]


def test_a_film_that_nothing_straightens_is_refused():
    with pytest.raises(LimitError, match=r"^actuator.restoring_n_per_m = 0.01 is too small to st"):
        PeanoHasel(restoring_n_per_m=0.01, rounding_m=1e-3)


def test_a_law_too_sharp_for_the_table_is_refused():
    sharp = PeanoHasel(half_zipped_v=500.0)
    with pytest.raises(InputError, match=r"interpolation between 129 voltages has a relative err"):
        law_table(sharp, 1.5e4)
    stiff = dataclasses.replace(PeanoHasel(), rounding_m=5e-6)
    with pytest.raises(InputError, match=r"interpolation between 1024 lengths has a relative er"):
        law_table(stiff, 1.5e4)


@pytest.mark.parametrize(
    ("pouch_mm", "electrode_mm"), [(14, 6), (16, 8), (18, 4), (28, 12), (30, 4)]
)
def test_a_pouch_of_usual_dimensions_can_be_sampled_up_to_20_kilovolts(pouch_mm, electrode_mm):
    """At 16 and 8 mm, a search for the zipped length once ended with all of it zipped."""
    law = PeanoHasel(pouch_length_m=1e-3 * pouch_mm, electrode_length_m=1e-3 * electrode_mm)
    table = law_table(law, 20e3)
    # Zipped films are at most the electrode, which no voltage zips to its end.
    rise = np.diff(table.capacitance_f, axis=0)
    assert (rise[1:] > 0.0).all()
    assert np.abs(np.diff(table.capacitance_f, 4, axis=0)).max() < 5e-3 * table.capacitance_f.max()
