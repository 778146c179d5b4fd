"""Quantities of a model with the covariance of its numbers, against drawn plants."""

import numpy as np
import pytest

from haselab.control import PidGains, margins
from haselab.models.posterior import PlantPosterior

NAMES = ("natural_frequency_rad_s", "damping_ratio", "delay_s", "gain", "slow_time_constant_s",
         "slow_gain")  # fmt: skip
VALUES = np.array([30.0, 0.12, 0.006, 0.8, 6.0, 0.3])
STD = np.array([0.01, 0.05, 5e-4, 0.02, 0.1, 0.02])


def posterior(correlation):
    """Damping and gain go together, as they do in fits of a resonance."""
    matrix = np.diag(STD**2)
    matrix[1, 3] = matrix[3, 1] = correlation * STD[1] * STD[3]
    return PlantPosterior(NAMES, (True, True, False, False, True, False), VALUES, matrix)


def quantities(plant):
    found = margins(plant, PidGains(0.05, 3.0), loop_delay_s=0.007, rate_hz=100.0)
    return np.array([found.phase_margin_deg, found.gain_margin_db])


@pytest.mark.parametrize("correlation", [-0.9, 0.0, 0.9])
def test_propagated_margins_spread_as_those_of_drawn_plants(correlation):
    known = posterior(correlation)
    values, covariance = known.propagated(quantities)
    np.testing.assert_allclose(values, quantities(known.nominal))
    drawn = np.array([quantities(plant) for plant in known.draw(600, np.random.default_rng(2))])
    # A standard deviation of 600 draws is uncertain by 1 / sqrt(1200) of itself; 5 % for the bend.
    np.testing.assert_allclose(
        np.sqrt(np.diag(covariance)), drawn.std(axis=0), rtol=4 / np.sqrt(1200) + 0.05
    )


def test_the_correlation_counts():
    """The peak of a resonance is gain over damping: known better where they rise together."""
    together, apart = (posterior(r).propagated(quantities)[1][1, 1] for r in (0.9, -0.9))
    assert together < 0.5 * apart


def test_known_numbers_do_not_spread():
    none = PlantPosterior(NAMES, (True, True, False, False, True, False), VALUES, np.zeros((6, 6)))
    values, covariance = none.propagated(quantities)
    np.testing.assert_allclose(values, quantities(none.nominal))
    assert (covariance == 0.0).all()
