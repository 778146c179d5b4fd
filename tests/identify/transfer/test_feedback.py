"""Records of a closed loop: a disturbance that comes back through the input is noted."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from haselab.identify import Record, fit_transfer

RATE_HZ = 100.0


def recorded(seed, kp, ki, count=2500):
    """A resonance with a slow disturbance, in a loop with a PI controller; gains of 0: open."""
    rng = np.random.default_rng([5, seed])
    b, a, _ = cont2discrete(([100.0], [1.0, 4.0, 100.0]), 1.0 / RATE_HZ)
    b = b.ravel()
    reference = np.repeat(rng.choice([0.0, 1.0], count // 100), 100)
    disturbance = lfilter([0.3 * np.sqrt(1 - 0.99**2)], [1.0, -0.99], rng.normal(size=count))
    x, u, y, total = np.zeros(count), np.zeros(count), np.zeros(count), 0.0
    for k in range(count):
        if k > 1:
            x[k] = b[1] * u[k - 1] + b[2] * u[k - 2] - a[1] * x[k - 1] - a[2] * x[k - 2]
        y[k] = x[k] + disturbance[k]
        total += ki * (reference[k] - y[k]) / RATE_HZ
        u[k] = kp * (reference[k] - y[k]) + total if kp else reference[k]
    return Record.sampled(u, y, RATE_HZ, 0.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_disturbance_that_comes_back_through_the_input_is_noted(seed):
    closed, opened = (fit_transfer(recorded(seed, kp, 2.0)) for kp in (0.5, 0.0))
    noted = [
        any("residuals predict the input" in note for note in fit.notes) for fit in (closed, opened)
    ]
    assert noted == [True, False] or not closed.succeeded
    # Without a loop the same disturbance does not bias the gain.
    gain = opened.parameters["gain"]
    assert abs(gain.value - 1.0) < 4.0 * gain.std
