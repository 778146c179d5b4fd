"""Round trips through scipy.signal and python-control, responses compared at 50 points."""

import sys

import numpy as np
import pytest
from scipy import signal

from haselab.base import InputError
from haselab.models import Plant, SlowMode
from haselab.models.exchange import from_control, from_scipy, to_control, to_scipy
from haselab.models.rational import RationalModel

OMEGA_RAD_S = np.geomspace(0.01, 100.0, 50)
MODES = (SlowMode(0.4, 4.7), SlowMode(0.1, 0.9))
PLANT = Plant(0.5, 5.11, 0.09, 0.0, MODES)
MODEL = RationalModel.from_plant(PLANT)
DELAYED = RationalModel.from_plant(Plant(0.5, 5.11, 0.09, 0.012, MODES))


def same(left, right, tolerance=1e-10):
    assert np.abs(left / right - 1.0).max() <= tolerance


def of_states(system):
    """Response of a state space without going through polynomials."""
    identity = np.eye(len(system.A))
    inner = [np.linalg.solve(1j * w * identity - system.A, system.B)[:, 0] for w in OMEGA_RAD_S]
    return np.array(inner) @ system.C[0] + system.D[0, 0]


@pytest.mark.parametrize("form", ["tf", "ss", "zpk"])
@pytest.mark.parametrize(("model", "order"), [(MODEL, 0), (DELAYED, 3)], ids=["plain", "delayed"])
def test_scipy_answers_alike_and_gives_the_model_back(form, model, order):
    system = to_scipy(model, form, delay_order=order)
    expected = model.without_delay(order).frequency_response(OMEGA_RAD_S)
    answer = of_states(system) if form == "ss" else system.freqresp(OMEGA_RAD_S)[1]
    same(answer, expected)
    same(from_scipy(system).frequency_response(OMEGA_RAD_S), expected)


@pytest.mark.parametrize("form", ["tf", "ss"])
@pytest.mark.parametrize(("model", "order"), [(MODEL, 0), (DELAYED, 3)], ids=["plain", "delayed"])
def test_python_control_answers_alike_and_gives_the_model_back(form, model, order):
    pytest.importorskip("control")
    system = to_control(model, form, delay_order=order)
    expected = model.without_delay(order).frequency_response(OMEGA_RAD_S)
    same(system(1j * OMEGA_RAD_S), expected)
    again = from_control(system)
    same(again.frequency_response(OMEGA_RAD_S), expected)
    assert (again.input_name, again.output_name) == ("u", "y")
    if order == 0:
        plant = again.to_plant()
        assert plant.damping_ratio == pytest.approx(0.09, rel=1e-9)
        assert plant.slow_modes[0].time_constant_s == pytest.approx(4.7, rel=1e-9)


def test_a_delay_is_left_out_only_when_requested():
    for convert in (to_scipy, to_control):
        with pytest.raises(InputError, match=r"delay of 0\.012 s, which .* cannot represent"):
            convert(DELAYED)
    system = to_scipy(DELAYED.without_delay(0))
    same(system.freqresp(OMEGA_RAD_S)[1], MODEL.frequency_response(OMEGA_RAD_S))


def test_state_spaces_of_others_keep_their_zeros_and_their_relative_degree():
    rng = np.random.default_rng(3)
    for through in (0.0, 0.5):
        for order in (1, 2, 4, 6):
            a = rng.normal(size=(order, order)) - 3.0 * np.eye(order)
            system = signal.StateSpace(a, rng.normal(size=(order, 1)),
                                       rng.normal(size=(1, order)), through)  # fmt: skip
            same(from_scipy(system).frequency_response(OMEGA_RAD_S), of_states(system), 1e-9)
    # A chain of masses: five poles more than zeros, none of them made up by rounding.
    chain = signal.StateSpace(np.diag(np.ones(4), 1) - 2.0 * np.eye(5), np.eye(5)[:, 4:],
                              np.eye(5)[:1], 0.0)  # fmt: skip
    assert from_scipy(chain).numerator == pytest.approx((1.0,), rel=1e-12)


def test_what_cannot_be_taken_is_refused_with_a_reason(monkeypatch):
    with pytest.raises(InputError, match="discrete time"):
        from_scipy(signal.TransferFunction([1.0], [1.0, 0.5], dt=0.1))
    with pytest.raises(InputError, match="2 inputs and 1 outputs"):
        from_scipy(signal.StateSpace(-np.eye(2), np.eye(2), np.ones((1, 2)), np.zeros((1, 2))))
    for read in (from_scipy, from_control):
        with pytest.raises(InputError, match="The model is a str; it must be TransferFunction"):
            read("1/s")
    with pytest.raises(InputError, match="form = x; it must be one of tf, ss, zpk"):
        to_scipy(MODEL, "x")
    with pytest.raises(InputError, match="form = zpk; it must be one of tf, ss"):
        to_control(MODEL, "zpk")
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(InputError, match=r"not installed\. Run: pip install 'haselab\[control\]'"):
        to_control(MODEL)
