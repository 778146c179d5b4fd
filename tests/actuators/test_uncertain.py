"""Parameters vary by logarithm, power of the inverse or value, and are drawn jointly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.actuators import ADDED_INERTIA, DeaStack, PlanarHasel, Scales, draw_parameters
from haselab.base import Estimate

NAMES = ["dielectric.permittivity", "shell.locking_stretch", "viscosity.share[1]", ADDED_INERTIA]
SCALES = Scales.of(PlanarHasel(), NAMES)
VALUES = np.array([3.0, 3.9, 0.02, -1e-3])


def test_each_parameter_varies_by_its_own_scale() -> None:
    assert SCALES.by_logarithm.tolist() == [True, False, True, False]
    assert SCALES.inverse_exponent.tolist() == [0.0, 2.0, 0.0, 0.0]


@given(st.lists(st.floats(-0.01, 0.01), min_size=4, max_size=4))
def test_a_step_is_the_difference_of_what_varies(steps: list[float]) -> None:
    step = np.array(steps)
    moved = SCALES.moved(VALUES, step)
    found = SCALES.varying(moved) - SCALES.varying(VALUES)
    np.testing.assert_allclose(found, step, rtol=1e-9, atol=1e-12)


def test_the_limit_of_extension_varies_by_its_inverse() -> None:
    """Gent's stress is linear in 1/J where the stretch is small against J."""
    scales, values = Scales.of(DeaStack(), ["actuator.extension_limit"]), np.array([20.0])
    assert scales.moved(values, np.array([-0.03])) == pytest.approx([50.0])
    assert scales.slopes(values) == pytest.approx([-400.0])
    found = Estimate.inverse(20.0, 0.25, "", 1e6, 1.0)
    inverse = 1.0 / np.array(found.ci95)
    assert np.diff(inverse) == pytest.approx([-2.0 * 1.959964 * 0.25 / 20.0])
    assert inverse.mean() == pytest.approx(1.0 / 20.0)


def test_an_inverse_square_below_zero_is_no_number() -> None:
    assert np.isnan(SCALES.moved(VALUES, np.array([0.0, -1.0, 0.0, 0.0]))[1])


def test_without_uncertainty_the_values_are_drawn() -> None:
    drawn = draw_parameters(SCALES, VALUES, np.zeros((4, 4)), {}, np.random.default_rng(1))
    assert drawn == pytest.approx(VALUES, rel=1e-14)


def test_known_values_move_the_others_along_their_correlation() -> None:
    """The conditional normal distribution, by its mean and covariance over 1,000 draws."""
    rng = np.random.default_rng(5)
    half = np.diag([0.1, 2e-3, 0.2, 1e-4]) @ rng.normal(size=(4, 4))
    spread = half @ half.T  # of what varies
    slopes = SCALES.slopes(VALUES)
    drawn = np.array([
        SCALES.varying(draw_parameters(
            SCALES, VALUES, spread * np.outer(slopes, slopes), {0: 3.1}, rng
        ))
        for _ in range(1000)
    ])  # fmt: skip
    assert np.ptp(drawn[:, 0]) == 0.0
    gain = spread[1:, 0] / spread[0, 0]
    mean = SCALES.varying(VALUES)[1:] + gain * np.log(3.1 / 3.0)
    left = spread[1:, 1:] - np.outer(gain, spread[0, 1:])
    std = np.sqrt(np.diag(left))
    # errors of a mean and of a covariance over 1,000 draws, five times their standard deviations
    assert (np.abs(drawn[:, 1:].mean(axis=0) - mean) < 5.0 * std / np.sqrt(1000)).all()
    found = np.cov(drawn[:, 1:].T) / np.outer(std, std)
    assert np.abs(found - left / np.outer(std, std)).max() < 5.0 * np.sqrt(2.0 / 1000)


def test_an_infinite_variance_of_a_known_value_moves_nothing() -> None:
    spread = np.diag([np.inf, 1e-4, 1e-6, 1e-10])
    spread[0, 1] = spread[1, 0] = np.nan
    drawn = draw_parameters(SCALES, VALUES, spread, {0: 5.0}, np.random.default_rng(2))
    assert drawn[0] == 5.0 and abs(drawn[1] - 3.9) < 0.05
