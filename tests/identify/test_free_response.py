"""Equations 6 and 7: the bound of the estimator, envelopes, trials, identifiability."""

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError
from haselab.identify.free.response import FreeTrial, fit_free_response

TIME_S = np.arange(800) / 400.0
NOISE = 1e-4


def motion(omega, decay, phase=0.4, offset=0.02, creep=0.0):
    swing = 0.01 * np.exp(-decay * TIME_S) * np.cos(omega * TIME_S - phase)
    return offset + swing + creep * np.exp(-TIME_S / 0.9)


def noisy(clean, *seed):
    return FreeTrial(clean + NOISE * np.random.default_rng(seed).normal(size=clean.size), TIME_S)


def bound(omega, decay):
    """Cramer-Rao bound of omega and decay with amplitude, phase and offset unknown."""
    step = 1e-4
    columns = [
        (motion(omega + step, decay) - motion(omega - step, decay)) / (2 * step),
        (motion(omega, decay + step) - motion(omega, decay - step)) / (2 * step),
        (motion(omega, decay, 0.4 + step) - motion(omega, decay, 0.4 - step)) / (2 * step),
        motion(omega, decay, offset=0.0),
        np.ones(TIME_S.size),
    ]
    return np.sqrt(np.diag(np.linalg.inv(np.array(columns) @ np.array(columns).T / NOISE**2)))[:2]


@pytest.mark.long
@pytest.mark.parametrize("omega", [5.1, 2 * np.pi * 5.1], ids=["rad", "hz"])
def test_both_readings_reach_the_bound_with_correct_intervals(omega):
    decay, runs = 3.6, 50
    truth = {"damped_frequency_rad_s": omega, "decay_rate_per_s": decay}
    errors, inside = [], np.zeros(2)
    for run in range(runs):
        fit = fit_free_response([noisy(motion(omega, decay), 7, run)])
        estimates = [fit.parameters[name] for name in truth]
        errors.append([e.value - t for e, t in zip(estimates, truth.values(), strict=True)])
        inside += [e.ci95[0] <= t <= e.ci95[1]
                   for e, t in zip(estimates, truth.values(), strict=True)]  # fmt: skip
    rmse = np.sqrt(np.mean(np.square(errors), axis=0))
    # The root mean square of 50 normal errors spreads by sqrt(1/100): 3 of it.
    assert (rmse <= (1 + 3 * np.sqrt(1 / (2 * runs))) * bound(omega, decay)).all()
    assert (inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


def test_natural_frequency_and_damping_follow_equation_7():
    fit = fit_free_response([noisy(motion(5.1, 3.6), 1)])
    e = fit.parameters
    # D1: 5.1 rad/s and 3.6 give 6.24 rad/s, not 5.1; D2: damping 0.58.
    assert e["natural_frequency_rad_s"].value == pytest.approx(6.24, abs=4 * 0.03)
    assert (
        abs(e["natural_frequency_rad_s"].value - np.hypot(5.1, 3.6))
        <= 4 * e["natural_frequency_rad_s"].std
    )
    assert abs(e["damping_ratio"].value - 3.6 / np.hypot(5.1, 3.6)) <= 4 * e["damping_ratio"].std
    assert abs(e["amplitude"].value - 0.01) <= 4 * e["amplitude"].std
    assert abs(e["phase_rad"].value - 0.4) <= 4 * e["phase_rad"].std


def test_envelopes_through_the_peaks_agree_with_the_decay():
    fit = fit_free_response([noisy(motion(32.0, 4.2), 2), noisy(motion(32.0, 4.2, 1.1), 3)])
    for envelope in (fit.envelope_positive_decay_per_s, fit.envelope_negative_decay_per_s):
        assert envelope is not None
        assert abs(envelope.value - 4.2) <= 4 * envelope.std
        assert envelope.std < 0.1


def test_at_the_printed_reading_there_is_no_second_peak_and_no_envelope():
    # D3: at 5.1 rad/s each cycle decays to about 1 %, below five deviations of the noise.
    fit = fit_free_response([noisy(motion(5.1, 4.2), 4)])
    assert fit.envelope_positive_decay_per_s is None
    assert any("positive peaks" in note for note in fit.notes)
    assert fit.answer()["envelope_positive_decay_per_s"] is None


@pytest.mark.parametrize("creep", [0.0, 0.001, 0.01])
def test_creep_is_found_and_fitted_beside_the_oscillation(creep):
    clean = motion(32.0, 4.2, creep=creep)
    fit = fit_free_response([noisy(clean, 5)])
    decay = fit.parameters["decay_rate_per_s"]
    assert abs(decay.value - 4.2) <= 4 * decay.std
    assert fit.residual_whiteness_p > 1e-3
    if creep:
        without = fit_free_response([noisy(clean, 5)], creep=False)
        assert not without.succeeded or without.residual_whiteness_p < 1e-6


@pytest.mark.long
def test_the_spread_between_trials_widens_the_interval():
    trials = [noisy(motion(32.0, decay), 6, k) for k, decay in enumerate((3.6, 4.2))]
    fit = fit_free_response(trials)
    decay = fit.parameters["decay_rate_per_s"]
    # Two trials 0.6 apart: standard deviation of their mean 0.3.
    assert decay.std == pytest.approx(0.3, rel=0.1)
    assert decay.ci95[0] < 3.6 < 4.2 < decay.ci95[1]
    assert [round(t.parameters["decay_rate_per_s"].value, 1) for t in fit.trials] == [3.6, 4.2]


def test_rest_before_the_drop_is_left_out():
    fall = motion(32.0, 4.0, phase=np.pi, offset=0.01)
    x = np.concatenate([np.zeros(300), fall])
    x = x + NOISE * np.random.default_rng(8).normal(size=x.size)
    fit = fit_free_response([FreeTrial(x, np.arange(x.size) / 400.0)])
    omega = fit.parameters["damped_frequency_rad_s"]
    assert abs(omega.value - 32.0) <= 4 * omega.std
    assert fit.time_s[0][0] >= 0.74


@pytest.mark.long
def test_noise_alone_gives_no_result_and_bad_trials_are_refused():
    for run in range(5):
        noise = np.random.default_rng([9, run]).normal(size=800)
        assert fit_free_response([FreeTrial(noise, TIME_S)]).status.startswith("no result")
    with pytest.raises(InputError, match="trials is empty"):
        fit_free_response([])
    with pytest.raises(InputError, match="throughout"):
        FreeTrial(np.ones(20), np.arange(20.0))
    with pytest.raises(InputError, match="the times must rise"):
        FreeTrial(np.arange(20.0), np.zeros(20))


def coloured(rng, size, pole):
    """Autoregressive noise of unit variance."""
    drawn = rng.normal(size=size + 500)
    return lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], drawn)[500:]


@pytest.mark.long
@pytest.mark.parametrize("creep", [0.0, 0.003], ids=["level", "creeping"])
def test_intervals_and_envelopes_are_valid_in_coloured_noise(creep):
    runs, inside, envelopes = 40, [], []
    for run in range(runs):
        noise = NOISE * coloured(np.random.default_rng([10, run]), TIME_S.size, 0.9)
        fit = fit_free_response([FreeTrial(motion(32.0, 4.0, creep=creep) + noise, TIME_S)])
        truth = {"damped_frequency_rad_s": 32.0, "decay_rate_per_s": 4.0}
        inside += [
            fit.parameters[n].ci95[0] <= t <= fit.parameters[n].ci95[1] for n, t in truth.items()
        ]
        for envelope in (fit.envelope_positive_decay_per_s, fit.envelope_negative_decay_per_s):
            assert envelope is not None
            envelopes.append(
                ((envelope.value - 4.0) / envelope.std, envelope.ci95[0] <= 4.0 <= envelope.ci95[1])
            )
    # Binomial: 3 spreads below 95 % of 80 intervals, of which a pair shares its noise.
    least = 0.95 - 3 * np.sqrt(0.95 * 0.05 / (2 * runs))
    assert np.mean(inside) >= least
    assert np.mean([held for _, held in envelopes]) >= least
    # The mean of 80 normalised errors spreads by 0.11.
    assert abs(np.mean([error for error, _ in envelopes])) < 0.4


@pytest.mark.long
def test_coloured_noise_makes_no_envelope_where_no_second_peak_stands_out():
    # At 5.1 rad/s a second peak has 1 % of the first, which is one deviation of this noise.
    for run in range(15):
        noise = NOISE * coloured(np.random.default_rng([11, run]), TIME_S.size, 0.9)
        fit = fit_free_response([FreeTrial(motion(5.1, 3.6) + noise, TIME_S)], creep=False)
        assert fit.envelope_positive_decay_per_s is None
        assert fit.envelope_negative_decay_per_s is None


def test_frequencies_are_rad_per_s_by_name_and_unit():
    fit = fit_free_response([noisy(motion(2 * np.pi * 5.1, 4.0), 12)])
    for name, estimate in fit.parameters.items():
        assert ("frequency" in name) == (estimate.unit == "rad/s")
        assert not name.endswith("_hz")
    omega = fit.parameters["damped_frequency_rad_s"].value
    assert omega == pytest.approx(32.04, rel=1e-2)


@pytest.mark.parametrize("growth", [0.0, 0.002])
def test_a_swing_that_does_not_decay_has_no_damping_ratio(growth):
    time_s = np.arange(600) / 100.0
    noise = 0.01 * np.random.default_rng(4).normal(size=600)
    swing = np.exp(growth * time_s) * np.cos(12.0 * time_s + 1.0)
    fit = fit_free_response([FreeTrial(swing + noise, time_s)])
    assert fit.status.startswith("no result: no decay is visible")
