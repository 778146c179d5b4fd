"""Long delays: the right minimum is found, and a second one that explains as much is reported."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, dlsim, tf2ss

from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models import Plant

RATE_HZ = 200.0


def prbs(rng, count, held):
    return np.repeat(rng.choice([-1.0, 1.0], size=-(-count // held)), held)[:count]


def recorded(plant, u, noise, rng):
    y = plant.simulate(u, RATE_HZ, np.arange(u.size) / RATE_HZ)
    return Record.sampled(u, y + noise * np.std(y) * rng.normal(size=y.size), RATE_HZ)


def test_a_delay_of_half_a_period_is_not_taken_for_a_negative_gain():
    # 81/(s^2 + 1.8 s + 81) with 0.3 s: a search from 0 s ends at a gain of -0.61 and -0.02 s.
    rng = np.random.default_rng(1)
    plant = Plant(1.0, 9.0, 0.1, 0.3)
    fit = fit_transfer([recorded(plant, prbs(rng, 4000, 10), 0.03, rng)])
    assert fit.status == "ok"
    truth = {"gain": 1.0, "natural_frequency_rad_s": 9.0, "damping_ratio": 0.1, "delay_s": 0.3}
    for name, value in truth.items():
        assert abs(fit.parameters[name].value - value) < 5.0 * fit.parameters[name].std


@pytest.mark.parametrize("seed", range(8))
def test_delays_of_up_to_three_periods_are_found_or_refused(seed):
    rng = np.random.default_rng([3, seed])
    omega, zeta = rng.uniform(4.0, 20.0), rng.uniform(0.05, 0.9)
    plant = Plant(rng.choice([-1.0, 1.0]), omega, zeta, rng.uniform(0.0, 3.0) * 2 * np.pi / omega)
    fit = fit_transfer([recorded(plant, prbs(rng, 3000, 8), 0.1, rng)])
    if fit.succeeded:
        for name, value in (("gain", plant.gain), ("delay_s", plant.delay_s)):
            assert abs(fit.parameters[name].value - value) < 5.0 * fit.parameters[name].std
    else:
        assert fit.status.startswith("ambiguous")


def test_one_steady_tone_determines_two_numbers():
    # One frequency gives one gain and one phase: delays a period apart explain them alike.
    rng = np.random.default_rng(5)
    t = np.arange(4000) / RATE_HZ
    plant = Plant(1.0, 9.0, 0.1, 0.3)
    u = np.sin(2 * np.pi * 1.0 * t)
    y = plant.simulate(u, RATE_HZ, t)[2000:] + 0.02 * rng.normal(size=2000)
    record = Record.sampled(u[2000:], y, RATE_HZ)
    assert "steady tones of 1 Hz, which determine 2 parameters" in fit_transfer([record]).status


def test_resonances_come_in_order_of_their_frequency():
    rng = np.random.default_rng(4)
    t = np.arange(3000) / RATE_HZ
    u = rng.normal(size=t.size)
    y = sum(Plant(0.4, w, 0.05).simulate(u, RATE_HZ, t) for w in (50.0, 12.0))
    y = y + 0.01 * rng.normal(size=t.size)
    fit = fit_transfer([Record.sampled(u, y, RATE_HZ)], TransferStructure(4, 2))
    first, second = (fit.parameters[f"natural_frequency{mark}_rad_s"].value for mark in ("", "_2"))
    assert first == pytest.approx(12.0, rel=0.01)
    assert second == pytest.approx(50.0, rel=0.01)


def test_an_acceleration_is_fitted_with_as_many_zeros_as_poles():
    # y = g s^2/(s^2 + 2 zeta w s + w^2) u: the second derivative of a resonance, at the samples
    # after each update. Oracle: a fine simulation of scipy's state space.
    rng = np.random.default_rng(6)
    omega, zeta = 12.0, 0.15
    u = np.repeat(rng.choice([-1.0, 1.0], size=600), 5)
    system = cont2discrete(
        tf2ss([0.7, 0.0, 0.0], [1.0, 2 * zeta * omega, omega**2]), 1.0 / RATE_HZ
    )[:4]
    y = dlsim((*system, 1.0 / RATE_HZ), u)[1].ravel() + 0.01 * rng.normal(size=u.size)
    fit = fit_transfer([Record.sampled(u, y, RATE_HZ)], TransferStructure(2, 2))
    assert fit.status == "ok"
    for name, value in (("natural_frequency_rad_s", omega), ("damping_ratio", zeta)):
        assert abs(fit.parameters[name].value - value) < 4.0 * fit.parameters[name].std
    direct = fit.parameters["numerator_2"]
    assert abs(direct.value - 0.7) < 4.0 * direct.std
    assert fit.rational.numerator[0] == pytest.approx(0.7, rel=0.02)


def test_more_poles_never_fit_a_hardening_spring_worse():
    # A cubic spring leaves coloured residuals, where searches from rational starts mislead.
    rng = np.random.default_rng(2)
    t = np.arange(4000) / RATE_HZ
    lines = np.arange(1, 120)
    u = np.sin(2 * np.pi * lines[:, None] * t / 20.0 + rng.uniform(0, 6.28, (lines.size, 1))).sum(0)
    u /= u.std()
    x, v, y = 0.0, 0.0, np.zeros(t.size)
    for k in range(t.size):
        y[k] = x
        for _ in range(10):
            v += (400.0 * (u[k] - x) - 4.0 * v - 40.0 * x**3) / (10 * RATE_HZ)
            x += v / (10 * RATE_HZ)
    record = Record.sampled(u, y + 1e-3 * rng.normal(size=t.size), RATE_HZ)
    percent = [fit_transfer([record], TransferStructure(poles)).fit_percent for poles in (2, 3, 4)]
    assert percent[1] > percent[0] - 0.1
    assert percent[2] > percent[1] - 0.1
