"""Random changes of a model's parameters, from which the intervals of its results follow."""

import numpy as np
import pytest

from haselab.pipelines.model_results import _draws

pytestmark = pytest.mark.unit


def test_rounding_does_not_change_the_draws():
    """Eigenvectors of equal eigenvalues may turn by any angle; the draws must not."""
    covariance = np.diag([1.0, 1.0, 4.0, np.inf])
    rounded = covariance.copy()
    rounded[0, 1] = rounded[1, 0] = 1e-12
    slopes = np.array([1.0, 2.0, 0.5, 1.0])
    np.testing.assert_allclose(_draws(covariance, slopes), _draws(rounded, slopes), atol=1e-11)


def test_draws_have_the_covariance_and_leave_what_is_not_identifiable(monkeypatch):
    count = 40_000
    monkeypatch.setattr("haselab.pipelines.model_results._DRAWS", count)
    covariance = np.array([[4.0, -1.8, 0.0], [-1.8, 1.0, 0.0], [0.0, 0.0, np.inf]])
    slopes = np.array([2.0, 0.1, 1.0])
    drawn = _draws(covariance, slopes)
    found = np.cov(drawn[:, :2] * slopes[:2], rowvar=False)
    # of a sample's covariance, sqrt((c_ii c_jj + c_ij^2) / count)
    std = np.sqrt((np.outer([4.0, 1.0], [4.0, 1.0]) + covariance[:2, :2] ** 2) / count)
    assert (np.abs(found - covariance[:2, :2]) < 5.0 * std).all()
    assert not drawn[:, 2].any()
