"""Every vector unit gives the bits of the microcontroller's own C."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab import _sense


def sums(x, cosine, sine, bits):
    out = np.empty(-(-x.size // cosine.size), _sense.SUMS)
    _sense.sum_segments(x, cosine, sine, bits, out)
    return np.stack([out[name] for name in _sense.SUMS.names])


@pytest.mark.parametrize("bits", [128, 256, 512])
@given(
    samples=st.integers(1, 700),
    segment=st.integers(1, 300),
    seed=st.integers(0, 2**31),
    level=st.floats(-10.0, 10.0),
    spoiled=st.booleans(),
)
def test_any_width_gives_the_bits_of_the_core(bits, samples, segment, seed, level, spoiled):
    rng = np.random.default_rng(seed)
    x = (level + rng.standard_normal(samples)).astype(np.float32)
    if spoiled:
        x[rng.integers(samples)] = rng.choice([np.nan, np.inf, -np.inf])
    angle = rng.uniform(0.01, 2.0) * np.arange(segment)
    cosine, sine = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
    np.testing.assert_array_equal(sums(x, cosine, sine, bits), sums(x, cosine, sine, 0))
