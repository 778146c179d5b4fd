"""Estimates, limits, errors: the words and numbers every room shares."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from haselab import base
from haselab.base import Estimate, HaselabError, LimitError, Limits

FINITE = st.floats(-1e12, 1e12)
SPREAD = st.floats(0.0, 1e6)


@given(value=FINITE, std=SPREAD)
def test_normal_interval_holds_ninety_five_percent(value, std):
    estimate = Estimate.normal(value, std, "V")
    low, high = stats.norm.ppf([0.025, 0.975], value, std) if std else (value, value)
    assert estimate.ci95 == pytest.approx((low, high), rel=1e-12, abs=1e-12 * (abs(value) + std))


@given(value=st.floats(1e-9, 1e9), relative=st.floats(1e-3, 3.0))
def test_lognormal_interval_is_that_of_the_logarithm_and_stays_positive(value, relative):
    estimate = Estimate.lognormal(value, relative, "s")
    expected = stats.lognorm.ppf([0.025, 0.975], relative, scale=value)
    np.testing.assert_allclose(estimate.ci95, expected, rtol=1e-9)
    assert 0 < estimate.ci95[0] < value < estimate.ci95[1]


def test_the_lognormal_interval_of_an_unknown_number_is_from_0_to_infinity():
    assert Estimate.lognormal(4.2, math.inf, "s").ci95 == (0.0, math.inf)
    assert Estimate.lognormal(-4.2, math.inf, "s").ci95 == (-math.inf, 0.0)
    zero = Estimate.lognormal(0.0, math.inf, "s")
    assert (zero.std, zero.ci95) == (math.inf, (0.0, math.inf))


@given(value=FINITE, std=SPREAD, factor=st.floats(-1e3, 1e3))
def test_scaling_keeps_the_interval_in_order_and_the_value_inside(value, std, factor):
    scaled = Estimate.normal(value, std, "rad/s").scaled(factor, "Hz")
    assert scaled.ci95[0] <= scaled.value <= scaled.ci95[1]
    assert scaled.std >= 0.0
    assert scaled.unit == "Hz"


@given(value=FINITE, std=SPREAD)
def test_dictionary_and_back_is_the_same_estimate(value, std):
    estimate = Estimate.normal(value, std, "N")
    assert set(estimate.to_dict()) == {"value", "std", "ci95", "unit"}
    assert Estimate.from_dict(estimate.to_dict()) == estimate


def test_both_ends_of_a_range_are_allowed():
    Limits("drive voltage", 0.0, 2.0, "V").check([0.0, 1.0, 2.0])


@pytest.mark.parametrize("value", [-1e-12, 2.0000001, math.nan, math.inf, [1.0, 3.0]])
def test_a_value_outside_or_none_at_all_is_refused_with_the_four_facts(value):
    limits = Limits("drive voltage", 0.0, 2.0, "V")
    with pytest.raises(LimitError, match=r"^drive voltage = .* V is outside \[0, 2\] V\. Lower"):
        limits.check(value)


def test_the_file_of_the_limit_that_was_crossed_is_named():
    limits = Limits("drive voltage", 0.0, 2.0, "V", high_source="leg.toml")
    with pytest.raises(LimitError, match=r"widen the limit in leg\.toml\.$"):
        limits.check(3.0)
    with pytest.raises(LimitError, match=r"widen the limit in the rig file\.$"):
        limits.check(-1.0)


def test_every_error_is_one_of_ours_and_one_of_the_language():
    kinds = [getattr(base, name) for name in base.__all__ if name.endswith("Error")]
    for kind in kinds:
        assert issubclass(kind, HaselabError)
        builtin = [k for k in kind.__mro__ if k.__module__ == "builtins"]
        assert kind is HaselabError or Exception not in builtin[:1], kind
        assert kind.exit_code in {1, 2, 3, 4}


def test_base_needs_nothing_but_numpy_and_the_language():
    allowed = {"haselab", "numpy", *sys.stdlib_module_names}
    for path in Path(base.__file__).parent.glob("*.py"):
        for line in path.read_text().splitlines():
            if line.startswith(("import ", "from ")):
                assert line.split()[1].split(".")[0] in allowed, f"{path.name}: {line}"
