import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.report.numbers import interval_text, number_text, value_text


def parse(text):
    """A shown number as a float, and half a unit of its last digit."""
    mantissa, _, power = text.replace("−", "-").partition("×10")
    exponent = int(power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or 0)
    decimals = len(mantissa.partition(".")[2])
    return float(mantissa) * 10.0**exponent, 0.5 * 10.0 ** (exponent - decimals)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.324, "1.324"),
        (-26.92, "−26.92"),
        (4.923e6, "4.923×10⁶"),
        (5.6e-8, "5.6×10⁻⁸"),
        (26.14, "26.14"),
        (0.0, "0"),
        (6.0, "6"),
        (15600.0, "15600"),
        (math.nan, "—"),
        (math.inf, "—"),
    ],
)
def test_numbers_of_the_paper_read_as_printed(value, text):
    assert number_text(value) == text


@given(st.floats(-1e12, 1e12).filter(lambda x: x == 0.0 or abs(x) > 1e-12))
def test_five_significant_digits_survive_the_text(value):
    shown, _ = parse(number_text(value))
    assert shown == pytest.approx(value, rel=0.5e-4, abs=0.0)


@given(
    st.floats(-1e9, 1e9).filter(lambda x: abs(x) > 1e-9),
    st.floats(1e-5, 3.0),
)
def test_value_and_interval_keep_two_digits_of_the_standard_deviation(value, relative_std):
    std = abs(value) * relative_std
    shown, interval = interval_text(value, std, (value - 2 * std, value + 2 * std))
    number, half_unit = parse(shown)
    assert abs(number - value) <= half_unit * (1 + 1e-6)
    assert half_unit <= 0.05 * std * (1 + 1e-6) or half_unit == 0.5
    assert interval.startswith("[")


def test_an_interval_shares_the_power_of_ten_of_its_value():
    assert interval_text(4.95e6, 2e4, (4.911e6, 4.989e6)) == ("4.950×10⁶", "[4.911, 4.989]×10⁶")


def test_an_end_that_is_not_finite_reads_as_open():
    assert interval_text(3.0, 0.5, (2.0, None)) == ("3.00", "[2.00, open]")


@pytest.mark.parametrize("std", [0.5, math.nan, None])
def test_an_interval_without_ends_is_a_dash(std):
    """Before, it was "[open, open]", which no one could read."""
    assert interval_text(3.0, std, (None, math.inf))[1] == "—"
    text = value_text({"value": 3.0, "std": std, "ci95": [None, None], "unit": "m"})
    assert text in ("3 m", "3.00 m")


def test_an_uncertain_zero_takes_its_scale_from_the_uncertainty():
    assert interval_text(1e-9, 0.1, (-0.2, 0.2)) == ("0.00", "[−0.20, 0.20]")


def test_cells_of_any_kind_become_text():
    assert value_text([2.5, 3]) == "2.5 to 3"
    assert value_text({"a": 1.0, "b": "x"}) == "a 1; b x"
    assert value_text({"value": 2.0, "std": 0.1, "ci95": [1.8, 2.2], "unit": "s"}) == (
        "2.00 [1.80, 2.20] s"
    )
    assert value_text(False) == "no"
