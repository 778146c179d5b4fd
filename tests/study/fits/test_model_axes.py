"""The changes of a model's parameters along which its results are fitted again."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.pipelines.model_results import _axes

pytestmark = pytest.mark.unit


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 8), unknown=st.booleans())
def test_outer_products_of_the_changes_sum_to_the_covariance(seed, count, unknown):
    draw = np.random.default_rng(seed)
    root = draw.standard_normal((count, count)) * 10.0 ** draw.uniform(-6.0, 6.0, (count, 1))
    covariance, slopes = root @ root.T, 10.0 ** draw.uniform(-3.0, 3.0, count)
    if unknown:
        covariance[0, :] = covariance[:, 0] = 0.0
        covariance[0, 0] = np.inf
    changes = _axes(covariance, slopes) * slopes
    if unknown:
        assert not changes[:, 0].any()
        changes, covariance = changes[:, 1:], covariance[1:, 1:]
    std = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        changes.T @ changes / np.outer(std, std),
        covariance / np.outer(std, std),
        atol=1e-13 * count,
    )
