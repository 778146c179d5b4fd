"""Equation 4 and its inverse, equation 5."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError, LimitError
from haselab.models import LinearMap, VoltageMap

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)


@given(st.floats(-0.1, 0.2))
def test_the_inverse_returns_the_strain(strain):
    # One rounding of the voltage, divided by the smallest slope of the range.
    tolerance = 1e-14 * max(1.0, abs(float(EQ4.voltage_v(strain)))) / 4.0 + 1e-14
    assert abs(float(EQ4.strain(EQ4.voltage_v(strain))) - strain) <= tolerance


def test_the_saturation_limits_map_to_the_voltages_of_the_reference_study():
    assert EQ4.voltage_v([-0.05, 0.1]) * 5.0 == pytest.approx([0.27, 8.95], abs=5e-3)


def test_a_map_that_turns_has_no_inverse_and_a_voltage_out_of_reach_is_refused():
    turning = VoltageMap(1.0, 3.0, 0.1, -80.0)
    assert EQ4.is_monotone(-0.05, 0.1)
    assert not turning.is_monotone(-0.1, 0.2)
    with pytest.raises(InputError, match="not monotone"):
        turning.strain(1.0)
    with pytest.raises(LimitError, match=r"voltage_v = 50 V is outside"):
        EQ4.strain([1.0, 50.0])


def test_the_capacitance_map_is_equation_5():
    eq5 = LinearMap(4.923e6, -0.276)
    assert eq5.strain(7.6e-8) == pytest.approx(0.098148)
    assert eq5.relative_capacitance(eq5.strain(5e-8)) == pytest.approx(5e-8)
