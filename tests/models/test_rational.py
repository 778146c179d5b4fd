"""The rational form: partial fractions there and back, delays as all-passes, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.models import Plant, SlowMode
from haselab.models.rational import RationalModel

OMEGA_RAD_S = np.geomspace(0.01, 100.0, 50)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.1, 10.0), st.floats(1.0, 60.0), st.floats(0.01, 2.0),
    st.lists(st.tuples(st.floats(-1.0, 1.0).filter(lambda c: abs(c) > 0.01),
                       st.integers(3, 9)), max_size=2, unique_by=lambda mode: mode[1]),
)  # fmt: skip
def test_a_plant_comes_back_from_its_rational_form(gain, omega, zeta, modes):
    # The slowest fast pole is omega/4, so time constants of 2^k/omega from k = 3 on are slower.
    slow = tuple(SlowMode(c, 2.0**k / omega) for c, k in sorted(modes, key=lambda mode: -mode[1]))
    plant = Plant(gain, omega, zeta, 0.01, slow)
    model = RationalModel.from_plant(plant)
    expected = plant.frequency_response(OMEGA_RAD_S)
    size = np.abs(plant.frequency_response(0.0)) + np.abs(expected)
    assert (np.abs(model.frequency_response(OMEGA_RAD_S) - expected) <= 1e-12 * size).all()
    again = model.to_plant()
    assert again.delay_s == plant.delay_s
    assert len(again.slow_modes) == len(slow)
    # Roots of a polynomial of order 4 whose poles differ by 2 or more: 1e-16 times about 1e4.
    assert again.natural_frequency_rad_s == pytest.approx(omega, rel=1e-9)
    assert again.gain == pytest.approx(gain, rel=1e-7)
    for mode, true in zip(again.slow_modes, slow, strict=True):
        assert mode.time_constant_s == pytest.approx(true.time_constant_s, rel=1e-8)
        assert mode.gain == pytest.approx(true.gain, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("order", "reach"), [(1, 0.27), (2, 1.0), (4, 3.4)])
def test_the_all_pass_keeps_the_magnitude_and_the_phase_up_to_its_reach(order, reach):
    delayed = RationalModel((2.0,), (1.0, 3.0), 0.05)
    plain = delayed.without_delay(order)
    omega_rad_s = np.linspace(0.0, reach / 0.05, 100)
    ratio = plain.frequency_response(omega_rad_s) / delayed.frequency_response(omega_rad_s)
    assert plain.delay_s == 0.0
    assert np.allclose(np.abs(ratio), 1.0, rtol=1e-12)
    assert np.abs(np.angle(ratio, deg=True)).max() <= 0.1
    assert delayed.without_delay(0).numerator == delayed.numerator


def test_the_all_pass_is_the_one_of_python_control():
    control = pytest.importorskip("control")
    top, bottom = control.pade(0.012, 3)
    mine = RationalModel((1.0,), (1.0,), 0.012).without_delay(3)
    assert mine.numerator == pytest.approx(np.array(top) / bottom[0], rel=1e-12)
    assert mine.denominator == pytest.approx(np.array(bottom) / bottom[0], rel=1e-12)


def test_poles_zeros_and_gain_make_a_model():
    model = RationalModel.from_poles([-1 + 2j, -1 - 2j, -4.0], [-3.0], 0.7, 0.1)
    assert model.frequency_response(0.0) == pytest.approx(0.7)
    assert sorted(model.poles.real) == pytest.approx([-4.0, -1.0, -1.0])
    assert model.zeros == pytest.approx([-3.0])
    assert RationalModel.from_dict(model.to_dict()) == model


TWO_MODES = tuple(np.poly([-1j - 1, 1j - 1, -2 - 3j, -2 + 3j]).real)


@pytest.mark.parametrize(
    ("model", "match"),
    [
        (RationalModel((1.0, 3.0), (1.0, 1.0, 9.0)), "zero at -3 rad/s; a Plant must not have one"),
        (RationalModel((1.0,), (1.0, 1.0)), "two fast, stable ones"),
        (RationalModel((1.0,), (1.0, -0.1, 9.0)), "stable"),
        (RationalModel((1.0,), TWO_MODES), "two fast"),
        (RationalModel((1.0,), tuple(np.poly([-9.0, -8.0, -1.0, -1.0]))), "equal"),
    ],
)  # fmt: skip
def test_what_is_no_plant_is_refused(model, match):
    with pytest.raises(InputError, match=match):
        model.to_plant()


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: RationalModel((), (1.0,)), "numerator = "),
        (lambda: RationalModel((1.0,), (0.0, 0.0)), "denominator is 0"),
        (lambda: RationalModel((1.0, 0.0, 0.0), (1.0, 1.0)), "2 zeros and 1 poles"),
        (lambda: RationalModel((float("nan"),), (1.0,)), "finite numbers"),
        (lambda: RationalModel((1.0,), (1.0, 1.0), -0.1), "delay_s = -0.1 s"),
        (lambda: RationalModel((1.0,), (1.0, 1.0), 0.1).without_delay(11), "order = 11"),
        (lambda: RationalModel.from_poles([1j - 1], [], 1.0), "with their conjugates"),
        (lambda: RationalModel.from_poles([0.0], [], 1.0), "other than 0"),
        (lambda: RationalModel.from_dict({"numerator": [1.0]}), "denominator"),
        (lambda: RationalModel.from_dict({"numerator": ["x"], "denominator": [1]}), "wrong value"),
    ],
)
def test_bad_models_are_refused(make, match):
    with pytest.raises(InputError, match=match):
        make()
