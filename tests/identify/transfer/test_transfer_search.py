"""The C code behind the transfer functions against independent routes to the same numbers."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter, lsim

from haselab.identify.noise import autoregression, coloured_covariance
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.identify.transfer.layout import layout_of
from haselab.identify.transfer.problem import Found, TransferProblem
from haselab.models import Plant, SlowMode

OMEGA, ZETA = float(np.sqrt(26.14)), 0.0909495
TIME_S = np.arange(2000) / 400.0


def random_input(seed, count=500):
    return np.random.default_rng(seed).normal(size=count)


@given(
    omega=st.floats(2.0, 60.0),
    zeta=st.floats(0.02, 3.0),
    tau=st.floats(0.3, 20.0),
    delay_s=st.floats(0.0, 0.05),
    shift=st.floats(0.0, 0.01),
    before=st.floats(-1.0, 1.0),
)
@example(2.0, 1.0, 1.0, 0.0, 0.0, 0.0)
@settings(max_examples=60, deadline=None)
def test_the_model_is_the_plant_for_any_pole_delay_and_clock(
    omega, zeta, tau, delay_s, shift, before
):
    # Plant.simulate takes scipy's filter; both are exact, so only rounding separates them, except
    # that the C code moves zeta by up to 1e-6 to keep two poles apart.
    plant = Plant(0.7, omega, zeta, delay_s, (SlowMode(0.3, tau),))
    u, time_s = random_input(3), TIME_S + shift
    layout = layout_of(TransferStructure(slow_modes=1, initial_state=False, offset=False))
    record = Record(u, 100.0, np.sin(time_s), time_s, before)
    search = np.array([math.log(omega), math.log(zeta), math.log(tau), delay_s])
    found = Found(search, np.array([0.7, 0.3]), [np.zeros(0)], 0.0, True)
    (output,) = TransferProblem(layout, [record], 0.1).predict(found)
    expected = plant.simulate(u - before, 100.0, time_s) + before * plant.static_gain
    part = 1e-8 + (2e-6 if abs(zeta**2 - 1.0) < 2e-6 else 0.0)
    assert np.allclose(output, expected, atol=part * np.abs(expected).max())


@pytest.mark.parametrize(
    "poles, zeros, slow", [(1, 0, 0), (2, 1, 0), (2, 0, 2), (3, 2, 1), (5, 3, 0)]
)
def test_factors_leave_orthogonal_residuals_and_the_slopes_are_those_of_the_cost(
    poles, zeros, slow
):
    rng = np.random.default_rng(poles)
    structure = TransferStructure(poles=poles, zeros=zeros, slow_modes=slow)
    layout = layout_of(structure)
    records = [
        Record(random_input(1), 100.0, rng.normal(size=2000), TIME_S),
        Record(np.ones(4), 100.0, rng.normal(size=900), TIME_S[:900] + 0.0013, 0.3),
    ]
    problem = TransferProblem(layout, records, 0.1)
    search = np.array(
        [math.log(v) for k in range(poles // 2) for v in (5.0 * 2**k, 0.2 + 0.1 * k)]
        + [math.log(0.1)] * (poles % 2)
        + [math.log(0.8 * 3.0**k) for k in range(slow)]
        + [0.0123]
    )
    found, columns = problem.project(search), problem.columns(problem.project(search))
    left = np.concatenate(columns.residuals)
    assert found.cost == pytest.approx(left @ left, rel=1e-12)
    outputs = problem.predict(found)
    for record, output, residual in zip(records, outputs, columns.residuals, strict=True):
        assert np.allclose(record.y - output, residual, atol=1e-9)
    stacked = np.vstack(columns.sensitivities)
    size = search.size
    along = stacked[:, size:].T @ left / np.linalg.norm(stacked[:, size:], axis=0)
    assert np.abs(along).max() < 1e-9 * np.linalg.norm(left)
    # The cost with solved factors has the slope -2 S'e (Golub and Pereyra).
    for k in range(size):
        step = np.zeros(size)
        step[k] = 1e-5
        numeric = (problem.project(search + step).cost - problem.project(search - step).cost) / 2e-5
        assert -2.0 * stacked[:, k] @ left == pytest.approx(
            numeric, rel=2e-4, abs=1e-4 * found.cost
        )


def test_straight_lines_between_the_samples_are_what_scipy_simulates():
    u = np.cumsum(random_input(5, 2000)) * 0.1
    system = ([0.5 * OMEGA**2], [1.0, 2 * ZETA * OMEGA, OMEGA**2])
    y = lsim(system, u, TIME_S, interp=True)[1]
    noise = 1e-4 * np.random.default_rng(1).normal(size=y.size)
    fit = fit_transfer([Record.sampled(u, y + noise, 400.0, hold="first")])
    held = fit_transfer([Record.sampled(u, y + noise, 400.0)])
    for name, value in (("gain", 0.5), ("natural_frequency_rad_s", OMEGA), ("delay_s", 0.0)):
        assert abs(fit.parameters[name].value - value) < 4.0 * fit.parameters[name].std
    # Taken as held, half a sample is missing: that is the delay that comes out.
    assert held.parameters["delay_s"].value == pytest.approx(-0.5 / 400.0, rel=0.05)


def test_a_measured_band_limited_input_needs_no_hold():
    time_s = np.arange(1500) / 6.0
    tones = [(0.7, 1.0, 0.3), (0.81, 0.6, 1.0), (0.9, 0.6, 1.9), (2.2, 1.0, 2.0)]
    plant = Plant(0.5, OMEGA, ZETA)
    u = sum(a * np.sin(2 * np.pi * f * time_s + p) for f, a, p in tones)
    y = np.zeros(time_s.size)
    for f, a, p in tones:
        g = complex(plant.frequency_response(2 * np.pi * f))
        y += a * abs(g) * np.sin(2 * np.pi * f * time_s + p + np.angle(g))
    y = y + 1e-3 * np.random.default_rng(1).normal(size=y.size)
    limited = fit_transfer([Record.sampled(u, y, 6.0, hold="band-limited")])
    held = fit_transfer([Record.sampled(u, y, 6.0)])
    for name, value in (("natural_frequency_rad_s", OMEGA), ("damping_ratio", ZETA)):
        estimate = limited.parameters[name]
        # The polygon that stands for the input is 1e-5 off at the highest tone; the record's ends,
        # beyond which the input is not known, are within the noise.
        assert abs(estimate.value - value) < 4.0 * estimate.std
        assert abs(held.parameters[name].value - value) > 4.0 * held.parameters[name].std


def test_a_command_that_is_really_held_at_a_lower_rate_is_fitted_as_such():
    t = np.arange(4000) / 400.0
    command = np.sin(2 * np.pi * (0.1 * t + 0.495 * t**2))
    y = Plant(0.5, OMEGA, ZETA).simulate(command[::4], 100.0, t)
    y = y + 0.01 * np.random.default_rng(2).normal(size=y.size)
    right = fit_transfer([Record.sampled(command, y, 400.0, held_at_hz=100.0)])
    wrong = fit_transfer([Record.sampled(command, y, 400.0)])
    assert abs(right.parameters["delay_s"].value) < 4.0 * right.parameters["delay_s"].std
    # Three quarters of the hold are half a delay of three samples.
    assert wrong.parameters["delay_s"].value == pytest.approx(1.5 / 400.0, abs=6e-4)


def test_a_poor_first_start_is_mended_by_the_others():
    # Two close modes of which the first start sees one; noise keeps the residuals coloured.
    rng = np.random.default_rng(9)
    t = np.arange(4000) / 400.0
    u = rng.normal(size=1000)
    noise = lfilter([0.1], [1, -0.97], rng.normal(size=t.size))
    y = sum(Plant(0.4, w, 0.03).simulate(u, 100.0, t) for w in (20.0, 31.0)) + 0.05 * noise
    fit = fit_transfer([Record(u, 100.0, y, t)], TransferStructure(poles=4, zeros=2))
    found = sorted(e.value for n, e in fit.parameters.items() if n.startswith("natural"))
    assert found == pytest.approx([20.0, 31.0], rel=0.01)


@pytest.mark.long
def test_the_noise_behind_the_residuals_has_the_variance_that_the_fit_took_away():
    # Slow noise (pole 0.99) under a fit of eight smooth functions: residuals alone show too
    # little of it, the corrected model the right spread within its own scatter.
    rng = np.random.default_rng(4)
    t = np.linspace(-1.0, 1.0, 4000)
    shapes = np.polynomial.legendre.legvander(t, 7)
    inverse = np.linalg.inv(shapes.T @ shapes)
    padded = np.vstack([shapes[::-1], np.zeros_like(shapes)])
    filtered = lfilter([np.sqrt(1 - 0.99**2)], [1, -0.99], padded, axis=0)
    true = np.sqrt(np.diag(inverse @ filtered.T @ filtered @ inverse))
    ratios, raw = [], []
    for _ in range(60):
        e = lfilter([np.sqrt(1 - 0.99**2)], [1, -0.99], rng.normal(size=8000))[4000:]
        e = e - shapes @ (inverse @ (shapes.T @ e))
        ratios.append(np.sqrt(np.diag(coloured_covariance([shapes], [e], 8))) / true)
        polynomial, variance = autoregression([e])
        naive = lfilter([np.sqrt(variance)], polynomial, padded, axis=0)
        raw.append(np.sqrt(np.diag(inverse @ naive.T @ naive @ inverse)) / true)
    # 60 draws that scatter by 15 % each: 3 standard errors are 6 %.
    assert np.mean(ratios, axis=0) == pytest.approx(np.ones(8), abs=0.06)
    assert (np.mean(raw, axis=0) < 0.9).all()


def test_no_array_of_the_caller_changes():
    rng = np.random.default_rng(1)
    arrays = [rng.normal(size=400), rng.normal(size=800), np.arange(800) / 400.0]
    copies = [array.copy() for array in arrays]
    fit_transfer([Record(arrays[0], 200.0, arrays[1], arrays[2])])
    for array, copy in zip(arrays, copies, strict=True):
        assert np.array_equal(array, copy)


@pytest.mark.long
def test_more_poles_and_zeros_never_fit_the_hair_dryer_worse(shared_data):
    # PT326 hair dryer, SLICOT's IB01BD.dat: the published model of order 4 explains 88.97 %.
    u, y = np.loadtxt(
        shared_data / "identification" / "hair-dryer.csv", delimiter=",", skiprows=1
    ).T
    record = Record.sampled(u, y, 12.5)
    percent = {
        (poles, zeros): fit_transfer(
            [record], TransferStructure(poles=poles, zeros=zeros, delay=0.16)
        ).fit_percent
        for poles, zeros in [(1, 0), (2, 0), (3, 0), (4, 0), (3, 1), (4, 1), (4, 2)]
    }
    # A tenth of a per cent: a fast pole within the range of the search is no pole at all only
    # in the limit.
    for few, more in [((1, 0), (2, 0)), ((2, 0), (3, 0)), ((3, 0), (4, 0)), ((3, 1), (4, 1))]:
        assert percent[more] > percent[few] - 0.1
    assert percent[4, 2] > 88.97
