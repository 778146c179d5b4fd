"""The leakage of a single sweep is removed; averaged segments are told to be wrong for it."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.identify.frequency_response import estimate_frequency_response
from haselab.models import Plant

OMEGA = float(np.sqrt(26.14))
PLANT = Plant(0.5, OMEGA, 0.93 / (2 * OMEGA))
TIME_S = np.arange(4000) / 400.0
SWEEP = np.sin(2 * np.pi * (0.1 * TIME_S + 0.5 * 0.99 * TIME_S**2))
CLEAN = PLANT.simulate(SWEEP, 400.0, TIME_S)


def truth(response):
    return PLANT.frequency_response(2 * np.pi * response.frequency_hz)


def test_one_sweep_without_noise_gives_the_plant():
    response = estimate_frequency_response(SWEEP, CLEAN, 400.0)
    swept = response.frequency_hz <= 9.0
    error = np.abs(response.response / truth(response) - 1)[swept]
    # What is left is aliasing of the held input's images at 400 Hz: (0.81/400)^2 of the gain.
    assert error.max() <= 5e-6


def test_noise_at_30_db_leaves_honest_deviations_at_the_resonance():
    inside, errors = [], []
    for run in range(30):
        noise = np.random.default_rng([5, run]).normal(size=4000) * CLEAN.std() / np.sqrt(1e3)
        response = estimate_frequency_response(SWEEP, CLEAN + noise, 400.0)
        near = (response.frequency_hz > 0.2) & (response.frequency_hz < 1.5)
        error = np.abs(response.response - truth(response))[near]
        # |error|^2 / std^2 is exponential: 95 % below sqrt(-ln 0.05) = 1.73.
        inside.append(error <= 1.73 * response.std[near])
        errors.append(error / np.abs(truth(response)[near]))
    assert np.mean(inside) >= 0.88  # the local denominator is fitted too, to noisy output
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_the_polynomial_form_and_welch_fail_where_the_rational_one_holds():
    near = (0.5, 1.2)

    def worst(method):
        response = estimate_frequency_response(SWEEP, CLEAN, 400.0, method=method)
        inside = (response.frequency_hz > near[0]) & (response.frequency_hz < near[1])
        return float(np.abs(response.response / truth(response) - 1)[inside].max())

    assert worst("rational") < 1e-5 < 0.3 < min(worst("polynomial"), worst("h1"))
    assert (
        "single sweep" in estimate_frequency_response(SWEEP, CLEAN, 400.0, method="h1").notes[0]
    )


def test_welch_is_quiet_and_right_for_long_noise():
    rng = np.random.default_rng(2)
    u = rng.normal(size=40000)
    y = PLANT.simulate(u, 20.0, np.arange(40000) / 20.0) + 0.01 * rng.normal(size=40000)
    response = estimate_frequency_response(u, y, 20.0, method="h1")
    assert response.notes == ()
    inside = (response.frequency_hz > 0.2) & (response.frequency_hz < 2.0)
    error = np.abs(response.response - truth(response))[inside]
    assert np.median(error / np.abs(truth(response)[inside])) < 0.02
    assert (response.coherence[inside] > 0.9).mean() > 0.9


def test_the_hold_of_the_input_is_taken_out_or_left_in():
    u = np.random.default_rng(3).normal(size=2000)
    held = estimate_frequency_response(u, u, 100.0)
    raw = estimate_frequency_response(u, u, 100.0, held=False)
    assert np.allclose(raw.response, 1.0)
    expected = 1.0 / np.sinc(held.frequency_hz / 100.0)
    assert np.abs(np.abs(held.response) / expected - 1).max() < 1e-3


def test_bad_records_are_refused():
    with pytest.raises(InputError, match="equal lengths"):
        estimate_frequency_response(np.arange(100.0), np.arange(99.0), 1.0)
    with pytest.raises(InputError, match="excites nothing"):
        estimate_frequency_response(np.ones(100), np.arange(100.0), 1.0)
    with pytest.raises(InputError, match="method = etfe; allowed are rational"):
        estimate_frequency_response(np.arange(100.0), np.arange(100.0), 1.0, method="etfe")
