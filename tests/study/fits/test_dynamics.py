"""The plant of chirp and steps."""

import numpy as np
import pytest
from scipy.linalg import expm

from haselab.identify.record import Record
from haselab.study.definition import builtin_study
from haselab.study.fits import dynamics

pytestmark = pytest.mark.unit

RATE_HZ, GAIN, OMEGA_N, ZETA = 100.0, 1.0, 33.0, 0.15
NOISE = 1e-5


def played(u, seed):
    """A plant without a slow branch, and the noise of a camera."""
    a = np.array([[0.0, 1.0], [-(OMEGA_N**2), -2.0 * ZETA * OMEGA_N]])
    step = expm(a / RATE_HZ)
    x, y, rest = np.zeros(2), [], np.array([GAIN, 0.0])
    for value in u:  # towards its rest at the held input
        y.append(x[0])
        x = rest * value + step @ (x - rest * value)
    noise = NOISE * np.random.default_rng(seed).standard_normal(u.size)
    return Record.sampled(u, np.array(y) + noise, RATE_HZ)


def test_steps_without_a_slow_branch_leave_the_second_order(monkeypatch):
    time_s = np.arange(0.0, 10.0, 0.01)
    chirp = played(0.01 * np.sin(2.0 * np.pi * time_s * (0.1 + time_s)), 1)
    step = played(np.r_[np.zeros(100), np.full(600, 0.04)], 2)
    monkeypatch.setattr(dynamics, "_record", lambda seen, *_: seen)
    monkeypatch.setattr(dynamics, "_feedthrough", lambda *_: None)  # of the sensing, not of a fit
    found = dynamics.fit_chirp_and_steps(chirp, [step], None, builtin_study(quick=True), None)
    assert found.plant.slow_modes == ()
    assert not any("slow" in key for key in found.quantities)
    for key, known in (("S20.gain", GAIN), ("S20.omega_n", OMEGA_N), ("S20.zeta", ZETA)):
        estimate = found.quantities[key]
        assert estimate.value == pytest.approx(known, abs=5.0 * estimate.std), key
    assert not any("slow" in name for name in found.posterior.names)
