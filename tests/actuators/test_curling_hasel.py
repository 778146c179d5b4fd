"""The curling HASEL: its strip drawn point by point, and its balance of moments."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from haselab.actuators import CurlingHasel, PeanoHasel, curling_hasel, equilibrium_m
from haselab.base import LimitError


@given(angle=st.floats(0.28, 1.79))
@settings(max_examples=40, deadline=None)
def test_the_curl_is_that_of_an_arc_that_hangs(angle):
    """The arc as a polygon of 20,000 sides: an error of 1e-9 of its height."""
    law = CurlingHasel()
    middles = (np.arange(20000) + 0.5) / 20000
    height_m = law.strip_m * float(np.cos(angle * middles).mean())
    assert float(law.curl_rad_at(height_m)) == pytest.approx(angle, rel=1e-8)


@pytest.mark.parametrize(
    ("load_n", "voltage_v"), [(0.5, 0.0), (2.45, 0.0), (2.45, 8e3), (1.0, 5e3)]
)
def test_it_rests_where_the_energy_of_strip_cells_and_load_is_smallest(load_n, voltage_v):
    """Minimised over the angle without derivatives; the cells are those of a Peano-HASEL."""
    law = CurlingHasel()
    cells = PeanoHasel()  # has the same defaults
    rest_m = cells.pouches * cells.pouch.rest_m

    def energy_j(angle: float) -> float:
        strip_j = 0.5 * 1e-2 / 0.1 * (angle - 1.1) ** 2
        cells_j = float(cells.energy_j(rest_m - 6e-3 * angle, voltage_v))
        return strip_j + cells_j - load_n * 0.1 * math.sin(angle) / angle

    found = minimize_scalar(energy_j, bounds=(0.3, 1.75), method="bounded", options={"xatol": 1e-9})
    expected_m = 0.1 * math.sin(found.x) / found.x
    # a minimum of energies rounded to 1e-16 J is found to 1e-8 of the angle
    assert equilibrium_m(law, voltage_v, load_n) == pytest.approx(expected_m, rel=1e-7)


def test_a_curl_beyond_its_cells_is_refused():
    with pytest.raises(LimitError, match=r"^actuator.curl_rad = 1.6 is not below 1.48 rad, where"):
        CurlingHasel(curl_rad=1.6, lever_m=0.015)


def test_the_curl_at_many_lengths_needs_no_more_steps_than_at_one(monkeypatch):
    law, steps = CurlingHasel(), []
    slope = curling_hasel._slope
    monkeypatch.setattr(curling_hasel, "_slope", lambda angle: steps.append(1) or slope(angle))
    limits = law.length_limits_m
    law.curl_rad_at(np.linspace(limits.low, limits.high, 1024))
    assert len(steps) <= 8
