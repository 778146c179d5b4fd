"""Spline maps: exact inverse, refusals."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from haselab.base import InputError, LimitError
from haselab.models import SplineMap

SLOPES = st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=9)


@given(SLOPES, st.sampled_from([1.0, -1.0]), st.floats(0.0, 1.0))
def test_the_inverse_returns_the_abscissa(slopes, sign, share):
    curve = SplineMap(np.arange(len(slopes)) * 0.5, sign * np.array(slopes), 3.0)
    x = share * curve.knots[-1]
    # One rounding of the value, divided by the smallest slope, and one of the abscissa.
    reach = np.abs(curve.values).max() + 3.0
    tolerance = 8 * 2.3e-16 * (reach / min(slopes) + curve.knots[-1])
    assert abs(float(curve.inverse(curve.value(x))) - x) <= tolerance


def test_the_value_is_the_integral_of_the_slope():
    curve = SplineMap(np.array([0.0, 0.3, 1.0, 1.2]), np.array([1.0, -2.0, 4.0, 0.0]), 0.25)
    for x in (0.1, 0.3, 0.77, 1.2):
        area = quad(lambda t: float(curve.slope(t)), 0.0, x, points=[0.3, 1.0])[0]
        assert float(curve.value(x)) == pytest.approx(0.25 + area, abs=1e-12)
    assert not curve.is_monotone


def test_what_lies_outside_is_refused_and_rounding_at_the_ends_is_not():
    curve = SplineMap(np.array([0.0, 1.0]), np.array([1.0, 2.0]), 0.0)
    assert curve.inverse([0.0, 1.5 + 1e-13]).tolist() == [0.0, 1.0]
    with pytest.raises(LimitError, match=r"y = 1.6 is outside \[0, 1.5\]"):
        curve.inverse([0.1, 1.6])
    with pytest.raises(LimitError, match=r"x = -0.1 is outside \[0, 1\]"):
        curve.value(-0.1)
    with pytest.raises(LimitError, match="x = nan"):
        curve.slope(np.nan)
    with pytest.raises(InputError, match="has no inverse"):
        SplineMap(np.array([0.0, 1.0]), np.array([1.0, -2.0]), 0.0).inverse(0.1)
    with pytest.raises(InputError, match="knots do not rise"):
        SplineMap(np.array([1.0, 1.0]), np.array([1.0, 2.0]), 0.0)
    with pytest.raises(InputError, match="it must have two or more"):
        SplineMap(np.array([0.0, 1.0]), np.array([1.0, np.inf]), 0.0)
