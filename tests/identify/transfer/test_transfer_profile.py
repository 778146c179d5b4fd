"""Deviations where the likelihood is no parabola: random plants of the benchmarks."""

from importlib import import_module

import numpy as np
import pytest

from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models import Plant


@pytest.fixture
def plant(benchmarks):
    return import_module("benchmarks.identification.random_plants").case


def test_a_weak_resonance_gets_the_deviation_of_its_flat_likelihood(plant):
    """The parabola claims 19 +- 0.8 rad/s, and a delay that is wrong by 8.7 of its deviations."""
    one = plant(113)
    fit = fit_transfer([Record.sampled(one.u, one.y, one.rate_hz)], one.structure)
    assert fit.status == "ok"
    for name, value in one.truth().items():
        estimate = fit.parameters[name]
        if np.isfinite(estimate.std):
            assert abs(estimate.value - value) < 4.0 * estimate.std, name


def test_a_resonance_that_a_line_of_the_noise_replaces_is_ambiguous(plant):
    one = plant(53)
    fit = fit_transfer([Record.sampled(one.u, one.y, one.rate_hz)], one.structure)
    assert fit.status.startswith("ambiguous")
    assert fit.other_minima[0].possible
    assert fit.answer()["other_minima"][0]["log_likelihood_below"] < 8.0


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 0.1])
def test_where_the_likelihood_is_a_parabola_nothing_is_widened(noise):
    """Against the inverse of the information matrix, from differences of scipy's simulation."""
    rng = np.random.default_rng(4)
    u = np.repeat(rng.choice([-1.0, 1.0], 400), 10)
    truth = np.array([0.6, 9.0, 0.1, 0.013])

    def output(numbers):
        return Plant(*numbers).simulate(u, 100.0, np.arange(u.size) / 100.0)

    y = output(truth) + noise * rng.normal(size=u.size)
    fit = fit_transfer([Record.sampled(u, y, 100.0)], TransferStructure())
    steps = 1e-4 * truth
    slopes = [
        (output(truth + step) - output(truth - step)) / (2.0 * step.max())
        for step in np.diag(steps)
    ]
    slopes.append(np.ones(u.size))  # the offset that the fit leaves open
    bound = noise * np.sqrt(np.diag(np.linalg.inv(np.array(slopes) @ np.array(slopes).T)))
    names = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
    for name, least in zip(names, bound, strict=False):
        # The variance of 4,000 outputs is known to 2 %; the initial state costs a little.
        assert 0.9 < fit.parameters[name].std / least < 1.15, name
