"""Agreement of independent estimates: closed forms, false alarms, words."""

import math

import numpy as np
import pytest

from haselab.base import Estimate, InputError
from haselab.identify import compare_estimates


def about(value, std, unit="rad/s"):
    return Estimate.normal(value, std, unit)


def test_agreeing_estimates_give_their_weighted_mean():
    """Weights 1 and 1/4: mean 5.02, std 0.0894; difference 0.1 over root 0.05 is 0.447."""
    found = compare_estimates({"a": about(5.0, 0.1), "b": about(5.1, 0.2)})
    assert found.verdict == "agree"
    assert found.mean.value == pytest.approx(5.02, rel=1e-12)
    assert found.mean.std == pytest.approx(math.sqrt(0.008), rel=1e-12)
    assert found.birge_ratio == pytest.approx(0.1 / math.sqrt(0.05), rel=1e-12)
    assert found.pairs["a", "b"] == pytest.approx(-0.1 / math.sqrt(0.05), rel=1e-12)


def test_the_papers_chirp_and_free_decay_disagree():
    """Eq. 10 gives 5.11 rad/s; eq. 7 with the printed 5.1 and 4.2 gives 6.61."""
    found = compare_estimates(
        {"chirp": about(5.11, 0.05), "decay": about(6.61, 0.1), "step": about(5.2, 0.2)}
    )
    assert found.verdict == "disagree: chirp and decay; decay and step"
    assert found.mean.std > 0.05  # widened by the Birge ratio


def test_wide_or_missing_intervals_give_no_agreement():
    assert compare_estimates({"a": about(5.0, 0.1), "b": about(4.0, 3.0)}).verdict == "cannot tell"
    found = compare_estimates({"a": about(5.0, 0.1), "b": about(math.nan, math.inf)})
    assert found.verdict == "cannot tell"
    assert any(note.startswith("b is left out") for note in found.notes)


def test_correct_intervals_seldom_disagree():
    """1 % of false alarms by chi-square and 1 % by the pairs: 10 of 500, 22 is 1 in 1,000."""
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(500):
        drawn = {name: about(5.0 + 0.1 * rng.normal(), 0.1) for name in "abcd"}
        alarms += compare_estimates(drawn).verdict.startswith("disagree")
    assert alarms < 22


def test_estimates_that_cannot_be_compared_are_refused():
    with pytest.raises(InputError, match="1 estimate"):
        compare_estimates({"a": about(5.0, 0.1)})
    with pytest.raises(InputError, match=r"units \['Hz', 'rad/s'\]"):
        compare_estimates({"a": about(5.0, 0.1), "b": about(0.8, 0.1, "Hz")})
    with pytest.raises(InputError, match="matters = -1"):
        compare_estimates({"a": about(5.0, 0.1), "b": about(5.0, 0.1)}, matters=-1.0)
