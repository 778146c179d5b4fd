"""Difference equations against scipy's discretisation and response."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, freqz

from haselab.base import InputError, ResultError
from haselab.models import ArxModel

RATE_HZ = 50.0


def held(numerator, denominator, delay):
    """Samples of a continuous plant behind a hold, by scipy."""
    top, bottom, _ = cont2discrete((numerator, denominator), 1.0 / RATE_HZ)
    return ArxModel(bottom[1:], top.ravel()[1:], 1 + delay, RATE_HZ)


@pytest.mark.parametrize(
    ("numerator", "denominator"),
    [
        ([13.07], [1.0, 0.93, 26.14]),
        ([2.0, 5.0], [1.0, 4.0, 3.0]),
        ([1.0], [1.0, 2.0, 1.0]),
        ([4.0], np.polymul([1.0, 0.93, 26.14], [1.0, 0.2])),
    ],
)
def test_the_continuous_plant_comes_back_from_its_samples(numerator, denominator):
    top, bottom, delay_s = held(numerator, denominator, 3).continuous()
    # The logarithm amplifies rounding by the rate: (50/0.2)^3 of 1e-16 at most.
    assert bottom == pytest.approx(np.asarray(denominator), rel=1e-8, abs=1e-8)
    full = np.concatenate([np.zeros(len(denominator) - len(numerator)), numerator])
    assert top == pytest.approx(full, rel=1e-7, abs=1e-7)
    assert delay_s == pytest.approx(3 / RATE_HZ)


def test_the_response_is_scipys_and_the_step_ends_at_the_static_gain():
    model = held([2.0, 5.0], [1.0, 4.0, 3.0], 2)
    omega = np.linspace(0.1, 100.0, 40)
    expected = freqz(model.numerator, model.denominator, omega / RATE_HZ)[1]
    np.testing.assert_allclose(model.frequency_response(omega), expected, rtol=1e-12)
    assert model.simulate(np.ones(2000))[-1] == pytest.approx(5.0 / 3.0, rel=1e-9)
    assert model.static_gain == pytest.approx(5.0 / 3.0, rel=1e-12)


def test_what_has_no_continuous_counterpart_says_so():
    with pytest.raises(ResultError, match="z <= 0 has no continuous counterpart"):
        ArxModel([0.5], [1.0], 1, 1.0).continuous()
    with pytest.raises(ResultError, match="uses more inputs than outputs"):
        ArxModel([-0.5], [1.0, 1.0, 1.0], 1, 1.0).continuous()
    with pytest.raises(InputError, match="all must be finite"):
        ArxModel([np.nan], [1.0], 1, 1.0)
    with pytest.raises(InputError, match="nk = -1"):
        ArxModel([-0.5], [1.0], -1, 1.0)
    assert not ArxModel([-1.5], [1.0], 1, 1.0).is_stable
