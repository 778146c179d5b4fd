"""Held plants against the matrix exponential of their differential equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from haselab.control.plants.held import HeldPlants
from haselab.models.plant import Plant, SlowMode

FINE = 8  # parts of a period


def continuous(plant):
    """State matrix, input column and output row in physical coordinates: y, dy/dt, branches."""
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    size = 2 + len(plant.slow_modes)
    a, b, c = np.zeros((size, size)), np.zeros(size), np.ones(size)
    a[0, 1], a[1, 0], a[1, 1] = 1.0, -wn * wn, -2.0 * zeta * wn
    b[1], c[1] = plant.gain * wn * wn, 0.0
    for row, mode in enumerate(plant.slow_modes, start=2):
        a[row, row], b[row] = -1.0 / mode.time_constant_s, mode.gain / mode.time_constant_s
    return a, b, c


def fine_output(plant, u, period_s, delay_parts):
    """Output at the samples by the matrix exponential on a grid of FINE parts a period."""
    a, b, c = continuous(plant)
    size = b.size
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a, b
    step = expm(block * period_s / FINE)
    held, x = np.repeat(u, FINE), np.zeros(size)
    y = np.zeros(held.size + delay_parts)
    for k, value in enumerate(held):
        y[k + delay_parts] = c @ x
        x = step[:size, :size] @ x + step[:size, size] * value
    return y[: held.size : FINE]


def stepped_output(plant, u, period_s, measurement_delay_s):
    held = HeldPlants.of([plant], period_s=period_s, measurement_delay_s=measurement_delay_s)
    free, push, samples = held.free[0].reshape(2, 2), held.push[0], int(held.samples[0])
    z, slow, y = np.zeros(2), np.zeros(held.slow_decay.shape[1]), np.zeros(u.size + samples)
    for k, value in enumerate(u):
        y[k + samples] = z[0] + slow.sum() + held.feed[0] * value
        z = free @ z + push * value
        slow = held.slow_decay[0] * slow + held.slow_push[0] * value
    return y[: u.size]


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(
    gain=st.floats(-2.0, 2.0),
    omega=st.floats(1.0, 500.0),
    zeta=st.one_of(st.floats(0.0, 5.0), st.sampled_from([0.0, 1.0 - 1e-9, 1.0, 1.0 + 1e-9])),
    slow=st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(0.01, 50.0)), max_size=3),
    delay_parts=st.integers(0, 5 * FINE),
)
def test_a_held_plant_equals_the_matrix_exponential(gain, omega, zeta, slow, delay_parts):
    period_s = 2.0**-10
    plant = Plant(
        gain,
        omega,
        zeta,
        delay_s=period_s / FINE * (delay_parts // 2),
        slow_modes=tuple(SlowMode(*pair) for pair in slow),
    )
    u = np.random.default_rng(1).uniform(-1.0, 1.0, 200)
    rest_s = period_s / FINE * (delay_parts - delay_parts // 2)
    found = stepped_output(plant, u, period_s, rest_s)
    expected = fine_output(plant, u, period_s, delay_parts)
    # 1600 steps of the oracle, each rounding by 2^-53 of a state up to (1 + omega) times the
    # output, which the coordinate dy/dt carries.
    largest = np.abs(expected).max() + abs(gain) + sum(abs(pair[0]) for pair in slow)
    # Denormal gains round by the smallest normal number.
    rounding = 1600 * 2.0**-53 * 8 * largest * (1.0 + omega) + np.finfo(float).tiny
    assert np.abs(found - expected).max() <= rounding


def test_a_plant_at_rest_on_an_input_stays_there():
    plant = Plant(0.5, 5.11, 0.09, 0.0123, (SlowMode(0.4, 4.7), SlowMode(-0.1, 0.5)))
    held = HeldPlants.of([plant], period_s=0.001, measurement_delay_s=0.0021)
    z, slow = held.rest[0, :2], held.rest[0, 2:]
    output = z[0] + slow.sum() + held.feed[0]
    assert output == pytest.approx(plant.static_gain, rel=1e-14)
    # The step's own rounding, 2^-53 of the largest state in each of its five terms.
    assert np.abs(held.free[0].reshape(2, 2) @ z + held.push[0] - z).max() < 5 * 2.0**-53
    assert np.abs(held.slow_decay[0] * slow + held.slow_push[0] - slow).max() < 5 * 2.0**-53


def test_plants_with_fewer_branches_are_filled_up_with_none():
    plants = [Plant(1.0, 5.0, 0.1), Plant(1.0, 5.0, 0.1, 0.0, (SlowMode(0.4, 4.7),))]
    held = HeldPlants.of(plants, period_s=0.001, measurement_delay_s=0.0)
    assert held.slow_decay.shape == (2, 1)
    assert held.slow_decay[0, 0] == held.slow_push[0, 0] == held.rest[0, 2] == 0.0


@pytest.mark.parametrize(("delay_s", "samples"), [(0.0, 1), (0.001, 2), (0.0005, 1), (0.0021, 3)])
def test_the_delay_in_samples_is_the_next_whole_one_above(delay_s, samples):
    held = HeldPlants.of([Plant(1.0, 5.0, 0.1)], period_s=0.001, measurement_delay_s=delay_s)
    assert held.samples.tolist() == [samples]


def test_an_overdamped_plant_with_a_very_fast_pole_stays_finite():
    held = HeldPlants.of([Plant(1.0, 100.0, 1e6)], period_s=1.0, measurement_delay_s=0.3)
    assert np.isfinite(held.free).all() and np.isfinite(held.push).all()
    # The slow pole alone is left: omega / (2 zeta) = 5e-5 per second.
    assert held.free[0, 0] == pytest.approx(np.exp(-5e-5), rel=1e-9)
