"""What records determine: variances of what acts only together, and the segments that matter."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import PlanarHasel
from haselab.identify.noise import coloured_covariance
from haselab.identify.physical.information import (
    covariance_of,
    determined_by,
    largest_std,
    vague_information,
)
from haselab.identify.physical.model_error import hidden_std
from haselab.identify.physical.unknowns import Unknowns

UNKNOWNS = replace(
    Unknowns.of(PlanarHasel(), added_inertia_kg=0.0, mass_kg=0.25),
    names=("shell.shear_modulus_pa", "shell.locking_stretch", "dielectric.permittivity"),
    values=np.array([12e3, 3.9, 3.0]),
)


def test_parameters_that_act_only_together_are_all_undetermined():
    """Two columns that differ by 1e-9 of their size: their sum is known, neither alone."""
    rng = np.random.default_rng(1)
    first, third = 1e4 * rng.standard_normal((2, 50))
    ratio = UNKNOWNS.widths[0] / UNKNOWNS.widths[1]
    second = ratio * (first + 1e-5 * rng.standard_normal(50))
    jacobian = np.column_stack([first, second, third])
    prior = vague_information(UNKNOWNS)
    covariance = covariance_of([jacobian, np.diag(np.sqrt(prior))])
    std = np.sqrt(np.diag(covariance))
    assert (std > largest_std(UNKNOWNS)).tolist() == [True, True, False]
    # each has the half of the ten widths' variance that their sum does not take
    np.testing.assert_allclose(std[:2], 10.0 / np.sqrt(2.0) * UNKNOWNS.widths[:2], rtol=1e-3)
    assert std[2] == pytest.approx(1.0 / np.linalg.norm(third), rel=0.05)
    both = np.array([1.0, ratio])
    assert both @ covariance[:2, :2] @ both < 1e-6 * std[0] ** 2


def test_white_residuals_give_the_covariance_of_the_joint_information():
    rng = np.random.default_rng(2)
    columns = [100.0 * rng.standard_normal((400, 3)), rng.standard_normal((300, 3))]
    residuals = [rng.standard_normal(400), rng.standard_normal(300)]
    prior = vague_information(UNKNOWNS)
    found = coloured_covariance(columns, residuals, 3, prior=prior)
    expected = covariance_of([*columns, np.diag(np.sqrt(prior))])
    # the variance of 700 residuals is known to 5 %; one of a million deviates by five times that
    np.testing.assert_allclose(found, expected, rtol=0.27, atol=0.02 * expected.max())


def test_without_effect_a_parameter_keeps_its_ten_widths():
    jacobian = np.zeros((20, 3))
    jacobian[:, 2] = 1.0
    prior = vague_information(UNKNOWNS)
    found = coloured_covariance([jacobian], [np.tile([1.0, -1.0], 10)], 1, prior=prior)
    np.testing.assert_allclose(np.sqrt(np.diag(found))[:2], 10.0 * UNKNOWNS.widths[:2])
    hidden = hidden_std(jacobian, 4.0, prior)
    assert hidden[2] == pytest.approx(2.0 / np.sqrt(20.0 + prior[2]))
    np.testing.assert_allclose(hidden[:2], 20.0 * UNKNOWNS.widths[:2])


def test_the_segment_that_determines_a_parameter_is_named():
    chirp, triangle = np.zeros((2, 4, 3))
    chirp[:, 0], triangle[0, 0], triangle[1:, 2] = 30.0, 20.0, 100.0
    parts = {("chirp", "length"): chirp, ("triangle", "capacitance"): triangle}
    found = determined_by(UNKNOWNS, parts)
    modulus = found["shell.shear_modulus_pa"]
    assert [source.text for source in modulus] == ["chirp length", "triangle capacitance"]
    variance = (UNKNOWNS.widths[0] * 10.0) ** -2.0  # information before the records
    both, one = 4.0 * 900.0 + 400.0 + variance, 400.0 + variance
    assert modulus[0].variance_growth == pytest.approx(both / one, rel=1e-9)
    assert found["shell.locking_stretch"] == ()
    (only,) = found["dielectric.permittivity"]
    assert only.answer()["experiment"] == "triangle" and only.channel == "capacitance"
