"""Figure 5: the curves through the peaks go through the peaks."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.identify.free.response import FreeTrial
from haselab.study.fits.free import fit_printed

CREEP_M, TAU_S = 5e-3, 4.0


@pytest.mark.parametrize(("omega", "decay"), [(5.3, 0.47), (33.0, 3.8)])
def test_an_envelope_passes_through_its_peaks(omega: float, decay: float) -> None:
    """Without creep the peaks lie on one exponential, and the curve on them.

    A peak is found to half a frame, so lower than the cosine's by (omega * dt / 2)^2 / 2.
    """
    t = np.arange(0.0, 8.0, 0.0025)
    x = -0.01 * np.exp(-decay * t) * np.cos(omega * t)
    fit = fit_printed(FreeTrial(x, t), omega, decay)
    low = 0.5 * (omega * 0.0025) ** 2 + 0.5 * (decay / omega) ** 2
    for envelope in fit.envelopes:
        assert envelope is not None
        assert envelope.decay == pytest.approx(decay, rel=1e-2)
        assert envelope.at(envelope.peak_s) == pytest.approx(envelope.peak_m, rel=low)


def test_with_creep_it_is_the_least_squares_of_the_logarithms() -> None:
    """Before, it had eq. 6's own amplitude: at the peaks it was off by a factor of up to two."""
    t = np.arange(0.0, 8.0, 0.0025)
    x = -0.01 * np.exp(-0.47 * t) * np.cos(5.3 * t) - CREEP_M * np.exp(-t / TAU_S)
    fit = fit_printed(FreeTrial(x, t), 5.3, 0.47)
    for envelope in fit.envelopes:
        assert envelope is not None
        left = np.log(envelope.at(envelope.peak_s) / envelope.peak_m)
        assert np.mean(left) == pytest.approx(0.0, abs=1e-9)
        assert np.sum(left * envelope.peak_s) == pytest.approx(0.0, abs=1e-8)


def test_nothing_is_drawn_beyond_the_peaks() -> None:
    t = np.arange(0.0, 8.0, 0.0025)
    x = -0.01 * np.exp(-0.47 * t) * np.cos(5.3 * t)
    envelope = fit_printed(FreeTrial(x, t), 5.3, 0.47).envelopes[0]
    assert envelope is not None
    drawn = t[np.isfinite(envelope.at(t))]
    assert (drawn[0], drawn[-1]) == pytest.approx((envelope.peak_s[0], envelope.peak_s[-1]))
