"""Transfer functions: the bound of the estimator, nuisances, measured data, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError, ResultError
from haselab.identify.transfer.fit import Record, TransferStructure, fit_transfer
from haselab.models import Plant, SlowMode

OMEGA = float(np.sqrt(26.14))
ZETA = 0.93 / (2.0 * OMEGA)
PAPER = Plant(0.5, OMEGA, ZETA)
TIME_S = np.arange(4000) / 400.0


def chirp(rate_hz):
    """Linear chirp from 0.1 to 10 Hz in 10 s, as the reference study's."""
    t = np.arange(int(10 * rate_hz)) / rate_hz
    return np.sin(2 * np.pi * (0.1 * t + 0.5 * 0.99 * t**2))


def bound(plant, u, rate_hz, std, state):
    """Cramer-Rao bound of gain, frequency, damping and delay, with state and offset unknown."""

    def output(x):
        moved = Plant(x[0], x[1], x[2], x[3])
        return moved.simulate(u, rate_hz, TIME_S, [x[4], x[5]]) + x[6]

    x = np.array([plant.gain, plant.natural_frequency_rad_s, plant.damping_ratio, plant.delay_s,
                  *state, 0.0])  # fmt: skip
    steps = np.array([1e-5, 1e-5, 1e-6, 1e-5, 1e-5, 1e-5, 1e-5])
    columns = [(output(x + h) - output(x - h)) / (2 * h.max()) for h in np.diag(steps)]
    information = np.array(columns) @ np.array(columns).T / std**2
    return np.sqrt(np.diag(np.linalg.inv(information)))[:4]


def test_the_fit_reaches_the_cramer_rao_bound_with_correct_intervals():
    plant, u, state = replace(PAPER, delay_s=0.01), chirp(100), [0.1, 0.0]
    clean = plant.simulate(u, 100.0, TIME_S, state) + 0.05
    std = float(np.sqrt(np.mean((clean - clean.mean()) ** 2) / 1e3))
    names = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
    truth = np.array([plant.gain, OMEGA, ZETA, plant.delay_s])
    runs = 60
    errors, inside = [], np.zeros(4)
    for run in range(runs):
        noise = std * np.random.default_rng([20181001, 30, run]).normal(size=TIME_S.size)
        fit = fit_transfer([Record(u, 100.0, clean + noise, TIME_S)])
        estimates = [fit.parameters[name] for name in names]
        errors.append([e.value for e in estimates] - truth)
        inside += [e.ci95[0] <= t <= e.ci95[1] for e, t in zip(estimates, truth, strict=True)]
    rmse = np.sqrt(np.mean(np.square(errors), axis=0))
    # The mean square of 60 normal errors has a relative spread of sqrt(2/60): 3 of it, halved.
    assert (rmse <= (1 + 1.5 * np.sqrt(2 / runs)) * bound(plant, u, 100.0, std, state)).all()
    # Binomial: 3 spreads below 95 %.
    assert (inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


@pytest.mark.long
def test_coloured_noise_keeps_the_intervals_correct():
    u = chirp(100)
    clean = PAPER.simulate(u, 100.0, TIME_S)
    inside, runs = 0, 40
    for run in range(runs):
        rng = np.random.default_rng([99, run])
        noise = lfilter([np.sqrt(1 - 0.99**2)], [1, -0.99], rng.normal(size=8000))[4000:]
        fit = fit_transfer([Record(u, 100.0, clean + 0.03 * noise, TIME_S)])
        low, high = fit.parameters["damping_ratio"].ci95
        inside += low <= ZETA <= high
    assert inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)


@pytest.mark.parametrize("omega", [OMEGA, 2 * np.pi * 5.11])
def test_a_chirp_and_a_step_together_identify_the_slow_branch(omega):
    rng = np.random.default_rng(8)
    plant = Plant(0.5, omega, 0.1, 0.012, (SlowMode(0.4, 4.7),))
    u, long_s = chirp(100), np.arange(8000) / 400.0
    step = np.concatenate([np.zeros(200), np.ones(100)])
    sweep = plant.simulate(u, 100.0, TIME_S) + 0.01 * rng.normal(size=4000)
    rise = plant.simulate(step, 100.0, long_s, [0.1, 0.0, 0.0]) + 0.01 * rng.normal(size=8000)
    records = [Record(u, 100.0, sweep, TIME_S), Record(step, 100.0, rise + 0.05, long_s)]
    fit = fit_transfer(records, TransferStructure(slow_modes=1))
    expected = {"gain": 0.5, "slow_gain": 0.4, "slow_time_constant_s": 4.7, "delay_s": 0.012}
    for name, value in expected.items():
        estimate = fit.parameters[name]
        assert abs(estimate.value - value) <= 3.3 * estimate.std, name
        assert estimate.std < 0.06 * value, name
    assert fit.residual_whiteness_p > 1e-3
    assert fit.plant.static_gain == pytest.approx(0.9, rel=0.02)
    # Without the branch the residuals say so.
    assert fit_transfer(records).residual_whiteness_p < 1e-6


def test_fixed_numbers_stay_and_have_no_spread():
    rng = np.random.default_rng(5)
    y = PAPER.simulate(chirp(100), 100.0, TIME_S) + 0.01 * rng.normal(size=4000)
    fixed = {"natural_frequency_rad_s": OMEGA, "gain": 0.5}
    structure = TransferStructure(delay=0.0, fixed=fixed)
    fit = fit_transfer([Record(chirp(100), 100.0, y, TIME_S)], structure)
    assert fit.parameters["gain"].value == 0.5
    assert fit.parameters["natural_frequency_rad_s"].std == 0.0
    assert (
        abs(fit.parameters["damping_ratio"].value - ZETA) <= 4 * fit.parameters["damping_ratio"].std
    )


def test_the_hair_dryer_is_predicted_on_data_that_the_fit_has_not_seen(shared_data):
    table = np.loadtxt(shared_data / "identification/hair-dryer.csv", delimiter=",", skiprows=1)
    fit = fit_transfer([Record.sampled(table[:, 0], table[:, 1], 12.5)])
    assert fit.validation_fit_percent >= 85.0
    # SLICOT's order-4 subspace models: static gain 0.9994; two poles leave a drift.
    assert fit.plant.static_gain == pytest.approx(0.9994, rel=0.1)
    # ARX of the same data: 3 samples of delay, one of which is the hold.
    assert 0.08 < fit.parameters["delay_s"].value < 0.24
    assert fit.residual_whiteness_p < 0.05


def test_zeros_are_found():
    rng = np.random.default_rng(6)
    # (1 + 0.5 s) in the numerator: the response plus half its derivative.
    fine_s, step = TIME_S, 1e-5
    u = chirp(100)
    rate = (PAPER.simulate(u, 100.0, fine_s + step) - PAPER.simulate(u, 100.0, fine_s)) / step
    y = PAPER.simulate(u, 100.0, fine_s) + 0.5 * rate + 0.01 * rng.normal(size=4000)
    fit = fit_transfer([Record(u, 100.0, y, fine_s)], TransferStructure(zeros=1, delay=0.0))
    assert fit.zeros[0].real == pytest.approx(-2.0, rel=0.01)
    with pytest.raises(ResultError, match="needs 2 and 0"):
        _ = fit.plant


def test_an_output_that_does_not_follow_gives_no_result():
    rng = np.random.default_rng(11)
    for _ in range(5):
        fit = fit_transfer([Record(chirp(100), 100.0, rng.normal(size=4000), TIME_S)])
        assert fit.status.startswith("no result")
        with pytest.raises(ResultError, match="no result"):
            _ = fit.plant


def test_one_step_from_rest_is_fitted_and_the_assumption_is_reported():
    rng = np.random.default_rng(12)
    y = PAPER.simulate(np.ones(1), 100.0, TIME_S) + 0.005 * rng.normal(size=4000)
    fit = fit_transfer([Record(np.ones(1), 100.0, y, TIME_S)])
    assert abs(fit.parameters["gain"].value - 0.5) <= 4 * fit.parameters["gain"].std
    assert any("time before the step" in note for note in fit.notes)


def test_bad_records_and_structures_are_refused():
    with pytest.raises(InputError, match="excites nothing"):
        Record(np.zeros(10), 10.0, np.arange(10.0), np.arange(10.0))
    with pytest.raises(InputError, match="does not rise"):
        Record(np.arange(10.0), 10.0, np.arange(10.0), np.zeros(10))
    with pytest.raises(InputError, match="nan at index 3"):
        Record.sampled(np.arange(9.0), np.where(np.arange(9) == 3, np.nan, np.arange(9)), 10.0)
    with pytest.raises(InputError, match="must be equally long"):
        Record(np.arange(9.0), 10.0, np.arange(9.0), np.arange(10.0))
    with pytest.raises(InputError, match="zeros = 3"):
        TransferStructure(zeros=3)
    with pytest.raises(InputError, match="must be among natural_frequency_rad_s"):
        fit_transfer(
            [Record.sampled(np.arange(50.0), np.arange(50.0), 1.0)],
            TransferStructure(fixed={"omega": 1.0}),
        )
    with pytest.raises(InputError, match="parameters need"):
        fit_transfer([Record.sampled(np.arange(9.0), np.arange(9.0), 1.0)])
