"""The ideal pouch against published numbers, and against its geometry drawn point by point."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.actuators import PeanoHasel, Pouch
from haselab.base import LimitError

# Kellaris (2019), its model at 10 kV: a pouch of 20 mm, 10 mm wide, film of 18 um and 2.2.
GOLDEN = {"pouches": 1.0, "pouch_width_m": 0.01}


def law_of(electrode_m: float = 0.01) -> PeanoHasel:
    return PeanoHasel(electrode_length_m=electrode_m, **GOLDEN)


def strain_at(law: PeanoHasel, force_n: float) -> float:
    """Ideal contraction at 10 kV: cos / (1 - cos) = F / (kappa V^2 / 2), solved by hand."""
    ratio = force_n / (0.5 * law.zipped_f_per_m * 1e8)
    angle = math.acos(ratio / (1.0 + ratio))
    return float(law.pouch.stroke_m(angle)) / law.pouch.rest_m


@pytest.mark.parametrize(
    ("electrode_m", "blocked_n", "free"), [(0.005, 1.42, 0.231), (0.01, 9.05, 0.1737),
                                           (0.015, 151.0, 0.0903)],
)  # fmt: skip
def test_blocked_force_and_free_strain_are_those_published(electrode_m, blocked_n, free):
    law = law_of(electrode_m)
    found_n = float(law.ideal_force_n(law.pouch.rest_angle_rad, 1e4))
    assert found_n == pytest.approx(blocked_n, rel=5e-3)  # three digits are published
    assert law.pouch.longest_stroke_m / law.pouch.rest_m == pytest.approx(free, rel=1e-3)


def test_the_published_pouch_in_detail():
    law = law_of()
    assert math.degrees(law.pouch.rest_angle_rad) == pytest.approx(13.84, abs=5e-3)
    assert strain_at(law, 0.2) == pytest.approx(0.0958, abs=5e-5)
    assert strain_at(law, 1.0) == pytest.approx(0.0358, abs=5e-5)
    assert 1e12 * float(law.ideal_capacitance_f(0.5 * math.pi)) == pytest.approx(54.1, abs=0.1)


def test_the_actuator_of_14_pouches():
    law = PeanoHasel(
        pouches=14.0, pouch_length_m=9.86e-3, electrode_length_m=4.94e-3, pouch_width_m=0.09025,
        film_thickness_m=15e-6, permittivity=3.15, rounding_m=4e-5,
    )  # fmt: skip
    assert float(law.ideal_force_n(law.pouch.rest_angle_rad, 6e3)) == pytest.approx(50.9, abs=0.1)
    assert law.pouch.longest_stroke_m / law.pouch.rest_m == pytest.approx(0.173, abs=5e-4)
    assert 1e9 * float(law.ideal_capacitance_f(0.5 * math.pi)) == pytest.approx(5.8, abs=0.05)


def test_no_pouch_contracts_by_more_than_a_cylinder():
    """A pouch without electrodes is filled to a cylinder: 1 - 2 / pi of a flat film."""
    limit = 1.0 - 2.0 / math.pi
    assert limit == pytest.approx(0.36, abs=4e-3)
    shares = np.array([0.5, 0.2, 0.05, 0.01])
    pouches = [Pouch(1.0, share) for share in shares]
    shortened = [1.0 - (p.rest_m - p.longest_stroke_m) / p.length_m for p in pouches]
    # the cylinder's chord is 2 / pi of what has not zipped
    np.testing.assert_allclose(shortened, limit * (1.0 - shares), rtol=1e-12)
    assert all(p.longest_stroke_m / p.rest_m < limit for p in pouches)


@given(share=st.floats(0.05, 0.9), place=st.floats(0.02, 0.98), voltage_v=st.floats(1.0, 1e4))
@settings(max_examples=60, deadline=None)
def test_the_force_is_half_the_voltage_squared_times_the_slope_of_the_capacitance(
    share, place, voltage_v
):
    law = PeanoHasel(pouches=1.0, electrode_length_m=0.02 * share)
    pouch = law.pouch
    angle = pouch.rest_angle_rad + place * (0.5 * math.pi - pouch.rest_angle_rad)
    step = 1e-3 * (angle - 0.5 * pouch.rest_angle_rad)
    # both by the angle, by six points: an error of (1e-3)^6
    weights = {1: 45.0, 2: -9.0, 3: 1.0}
    rises = [
        sum(w * float(f(angle + k * step) - f(angle - k * step)) for k, w in weights.items())
        for f in (law.ideal_capacitance_f, pouch.stroke_m)
    ]
    expected_n = 0.5 * voltage_v**2 * rises[0] / rises[1]
    assert float(law.ideal_force_n(angle, voltage_v)) == pytest.approx(expected_n, rel=1e-8)
    slope = float(pouch.zipped_per_rad(angle))
    zipped = rises[0] / law.zipped_f_per_m / (60.0 * step)
    assert slope == pytest.approx(zipped, rel=1e-8)


@given(share=st.floats(0.05, 0.9), place=st.floats(0.0, 1.0))
@settings(max_examples=30, deadline=None)
def test_the_arcs_have_the_films_length_and_hold_the_liquid(share, place):
    """Length and area of two arcs as polygons of 20,000 corners: an error of 1e-8.

    For the longest electrode the rest angle is 0.01 rad, and a - sin(a) cos(a) is rounded to 2e-12.
    """
    pouch = Pouch(0.02, 0.02 * share)
    stroke_m = place * pouch.longest_stroke_m
    angle = float(pouch.angle_rad(stroke_m))
    assert float(pouch.stroke_m(angle)) == pytest.approx(stroke_m, abs=1e-13)
    zipped_m = float(pouch.zipped_m(angle))
    assert -1e-13 <= zipped_m <= pouch.electrode_m * (1.0 + 1e-12)
    radius_m = (pouch.length_m - zipped_m) / (2.0 * angle)
    at = np.linspace(-angle, angle, 20001)
    x, y = radius_m * np.sin(at), radius_m * (np.cos(at) - math.cos(angle))
    assert np.hypot(np.diff(x), np.diff(y)).sum() + zipped_m == pytest.approx(0.02, rel=1e-8)
    area_m2 = 2.0 * float(np.sum(0.5 * (y[1:] + y[:-1]) * np.diff(x)))
    assert area_m2 == pytest.approx(pouch.fill_m2, rel=1e-7)
    assert x[-1] - x[0] + zipped_m == pytest.approx(pouch.rest_m - stroke_m, rel=1e-12)


def test_an_electrode_that_fills_the_pouch_is_refused():
    with pytest.raises(LimitError, match=r"^The electrode of 0.019 m covers more than 90% of the"):
        PeanoHasel(electrode_length_m=0.019)


def test_all_of_the_arcs_at_once_are_those_of_one_after_the_other():
    pouch, angle = Pouch(0.02, 0.01), np.linspace(0.25, 1.5, 50)
    found = pouch.arcs(angle, np.sin(angle), np.cos(angle))
    parts = pouch.zipped_m(angle), pouch.stroke_m(angle), pouch.zipped_per_rad(angle)
    for one, other in zip(found, parts, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
