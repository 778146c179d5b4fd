"""A weighted fit of a response: bound, coverage, delays and slow branches without a guess."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.identify.frequency.fit import fit_response
from haselab.identify.frequency.response import estimate_frequency_response
from haselab.identify.record import Record
from haselab.identify.transfer.layout import TransferStructure
from haselab.models import Plant, SlowMode

OMEGA = float(np.sqrt(26.14))
PLANT = Plant(0.5, OMEGA, 0.93 / (2 * OMEGA), 0.012)
AT_HZ = np.linspace(0.1, 5.0, 50)
STD = 0.02 * (1.0 + AT_HZ)
NAMES = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
TRUTH = (0.5, OMEGA, PLANT.damping_ratio, 0.012)


def noisy(plant, seed, std=STD, at_hz=AT_HZ):
    parts = np.random.default_rng(seed).normal(size=(2, at_hz.size)) * std / np.sqrt(2.0)
    return plant.frequency_response(2 * np.pi * at_hz) + parts[0] + 1j * parts[1]


def bound(numbers, make, std=STD, at_hz=AT_HZ):
    """Cramer-Rao bound of complex normal lines, by differences."""
    step = 1e-6
    columns = []
    for k in range(len(numbers)):
        up, down = ([n + sign * step * (i == k) for i, n in enumerate(numbers)] for sign in (1, -1))
        gains = [make(*x).frequency_response(2 * np.pi * at_hz) for x in (up, down)]
        columns.append((gains[0] - gains[1]) / (2 * step) / std * np.sqrt(2.0))
    rows = np.array(columns)
    return np.sqrt(np.diag(np.linalg.inv((rows @ rows.conj().T).real)))


@pytest.mark.long
def test_independent_lines_are_fitted_at_the_bound_with_correct_intervals():
    runs = 100
    errors, inside, p = [], np.zeros(4), []
    for run in range(runs):
        fit = fit_response(AT_HZ, noisy(PLANT, [1, run]), STD)
        estimates = [fit.parameters[name] for name in NAMES]
        errors.append([e.value - t for e, t in zip(estimates, TRUTH, strict=True)])
        inside += [e.ci95[0] <= t <= e.ci95[1] for e, t in zip(estimates, TRUTH, strict=True)]
        p.append(fit.chi_squared_p)
    rmse = np.sqrt(np.mean(np.square(errors), axis=0))
    # The root mean square of 100 normal errors spreads by sqrt(1/200): 3 of it.
    assert (rmse <= (1 + 3 * np.sqrt(1 / (2 * runs))) * bound(TRUTH, Plant)).all()
    assert (inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()
    # A right chi-square is below 0.05 in 5 %: 4 binomial spreads.
    assert np.mean(np.array(p) < 0.05) <= 0.05 + 4 * np.sqrt(0.0475 / runs)


def test_wrong_deviations_are_reported_and_do_not_spoil_the_intervals():
    good = fit_response(AT_HZ, noisy(PLANT, 2), STD)
    for factor, word in ((0.5, "too small"), (2.0, "too large")):
        fit = fit_response(AT_HZ, noisy(PLANT, 2), factor * STD)
        assert fit.chi_squared_ratio == pytest.approx(good.chi_squared_ratio / factor**2)
        assert any(word in note for note in fit.notes)
        # Weights that are all wrong alike change nothing; the misfits set the size.
        for name in NAMES:
            assert fit.parameters[name].value == pytest.approx(
                good.parameters[name].value, rel=1e-6
            )
            assert fit.parameters[name].std == pytest.approx(good.parameters[name].std, rel=1e-3)
    assert not any("std are" in note for note in good.notes)


@pytest.mark.long
def test_one_sweep_by_local_models_gives_the_numbers_near_the_bound():
    time_s = np.arange(4000) / 400.0
    sweep = np.sin(2 * np.pi * (0.1 * time_s + 0.5 * 0.99 * time_s**2))
    clean = PLANT.simulate(sweep, 400.0, time_s)
    std = clean.std() / np.sqrt(1e3)

    def output(x):
        plant = Plant(*x[:4])
        return plant.simulate(sweep, 400.0, time_s, x[4:6]) + x[6]

    at, step = np.array([*TRUTH, 0.0, 0.0, 0.0]), 1e-5
    columns = np.array([(output(at + h) - output(at - h)) / (2 * step) for h in step * np.eye(7)])
    best = np.sqrt(np.diag(np.linalg.inv(columns @ columns.T)))[:4] * std
    runs = 25
    errors, inside = [], np.zeros(4)
    for run in range(runs):
        noise = std * np.random.default_rng([3, run]).normal(size=4000)
        response = estimate_frequency_response(Record.sampled(sweep, clean + noise, 400.0))
        estimates = [response.fit().parameters[name] for name in NAMES]
        errors.append([e.value - t for e, t in zip(estimates, TRUTH, strict=True)])
        inside += [e.ci95[0] <= t <= e.ci95[1] for e, t in zip(estimates, TRUTH, strict=True)]
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / best
    # Local models spend numbers on every line: a tenth is lost; 3 spreads of 25 runs on top.
    assert (ratio <= 1.1 * (1 + 3 * np.sqrt(1 / (2 * runs)))).all()
    assert (inside / runs >= 0.92 - 3 * np.sqrt(0.92 * 0.08 / runs)).all()


@pytest.mark.long
@pytest.mark.parametrize("delay_s", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("zeta", [0.01, 0.3, 1.2])
def test_no_guess_is_needed_for_frequency_damping_or_delay(delay_s, zeta):
    at_hz = np.geomspace(0.2, 20.0, 80)
    for omega in (3.0, 20.0, 60.0):
        plant = Plant(-2.0, omega, zeta, delay_s)
        std = np.full(80, 1e-3)
        fit = fit_response(at_hz, noisy(plant, 4, std, at_hz), std)
        assert fit.succeeded
        truth = dict(zip(NAMES, (-2.0, omega, zeta, delay_s), strict=True))
        for name, value in truth.items():
            estimate = fit.parameters[name]
            assert abs(estimate.value - value) <= 4.5 * estimate.std, (omega, name)
        assert np.abs(fit.modelled - plant.frequency_response(2 * np.pi * at_hz)).max() < 0.05


def test_a_slow_branch_beside_the_resonance_is_found():
    plant = Plant(0.5, OMEGA, 0.09, 0.012, (SlowMode(0.4, 4.7),))
    at_hz = np.geomspace(0.005, 5.0, 80)
    std = np.full(80, 3e-3)
    fit = fit_response(at_hz, noisy(plant, 5, std, at_hz), std, TransferStructure(slow_modes=1))
    gain, tau = fit.slow_modes[0]
    assert abs(gain.value - 0.4) <= 4 * gain.std
    assert abs(tau.value - 4.7) <= 4 * tau.std
    assert fit.plant.slow_modes[0].gain == gain.value


def test_what_is_not_identifiable_has_no_value():
    # A branch of 500 s below the lowest line of 0.1 Hz is only its constant, which is not seen.
    fit = fit_response(AT_HZ, noisy(PLANT, 6), STD, TransferStructure(slow_modes=1))
    assert fit.succeeded
    gain, tau = fit.slow_modes[0]
    assert np.isnan(tau.value)
    assert tau.ci95 == (-np.inf, np.inf)
    assert np.isnan(gain.value)
    assert any("slow_time_constant_s is not identifiable" in note for note in fit.notes)
    with pytest.raises(ResultError, match=r"Not identifiable from these lines: .*slow_gain"):
        _ = fit.plant


def test_known_numbers_are_kept_and_zeros_are_fitted():
    structure = TransferStructure(delay=0.012, fixed={"damping_ratio": PLANT.damping_ratio})
    fit = fit_response(AT_HZ, noisy(PLANT, 7), STD, structure)
    assert fit.parameters["delay_s"].std == 0.0
    assert fit.parameters["damping_ratio"].value == pytest.approx(PLANT.damping_ratio)
    s = 2j * np.pi * AT_HZ
    exact = (3.0 + 0.5 * s) / (s * s + 2.0 * s + 30.0)
    fit = fit_response(AT_HZ, exact, np.full(50, 1e-6), TransferStructure(zeros=1, delay=0.0))
    assert np.abs(fit.modelled - exact).max() < 1e-7
    assert fit.parameters["gain"].value == pytest.approx(0.1, rel=1e-5)


def test_noise_alone_gives_no_result():
    rng = np.random.default_rng(8)
    for _ in range(5):
        noise = rng.normal(size=50) + 1j * rng.normal(size=50)
        fit = fit_response(AT_HZ, noise, np.full(50, np.sqrt(2.0)))
        assert fit.status.startswith("no result"), fit.parameters
        with pytest.raises(ResultError, match="gives no model"):
            _ = fit.plant


@pytest.mark.parametrize(
    ("lines", "match"),
    [
        ((AT_HZ, np.ones(49), STD), "50 values, response 49"),
        ((AT_HZ[::-1], np.ones(50), STD), "rising frequencies above 0 Hz"),
        ((AT_HZ - 0.1, np.ones(50), STD), "begins at 0 Hz"),
        ((AT_HZ, np.ones(50), 0.0 * STD), "std contains 0; each value must be above 0"),
        ((AT_HZ, np.ones(50), np.full(50, np.inf)), "0 lines have a finite std; 4 parameters"),
        ((AT_HZ, np.full(50, np.nan), STD), "response is nan at index 0"),
    ],
)
def test_bad_lines_are_refused(lines, match):
    with pytest.raises(InputError, match=match):
        fit_response(*lines)


@pytest.mark.parametrize("snr_db", [12.0, 30.0])
@pytest.mark.parametrize("periods", [1.9, 2.5, 3.0])
def test_a_delay_of_periods_keeps_the_sign_of_the_gain(periods, snr_db):
    """From delays of up to two periods alone the fit ends at a gain of the wrong sign."""
    plant = Plant(0.5, OMEGA, 0.22, periods * 2 * np.pi / OMEGA)
    at_hz = np.linspace(0.05, 2.5, 80) * OMEGA / (2 * np.pi)
    peak = np.abs(plant.frequency_response(2 * np.pi * at_hz)).max()
    std = np.full(80, peak * 10 ** (-snr_db / 20))
    for seed in range(4):
        fit = fit_response(at_hz, noisy(plant, [31, seed], std, at_hz), std)
        if fit.status.startswith("ambiguous"):
            assert snr_db < 20.0
            continue
        assert fit.status == "ok"
        for name, value in zip(NAMES, (0.5, OMEGA, 0.22, plant.delay_s), strict=True):
            assert abs(fit.parameters[name].value - value) < 5.0 * fit.parameters[name].std


def test_two_delays_that_explain_the_lines_are_ambiguous():
    """Few noisy lines about one frequency hardly distinguish a delay from a later one."""
    plant = Plant(0.5, OMEGA, 0.5, 2 * np.pi / OMEGA)
    at_hz = np.linspace(0.6, 1.4, 12) * OMEGA / (2 * np.pi)
    std = np.full(12, 0.2)
    fits = [fit_response(at_hz, noisy(plant, [32, k], std, at_hz), std) for k in range(12)]
    assert any(fit.status.startswith("ambiguous: two models") for fit in fits)
    for fit in fits:
        if fit.succeeded:
            assert abs(fit.parameters["gain"].value - 0.5) < 5.0 * fit.parameters["gain"].std
