"""The plant against independent routes: matrix exponential, python-control, an ODE solver."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from haselab.base import InputError
from haselab.models import HeldInput, Plant, SlowMode

TIME_S = np.sort(np.random.default_rng(3).uniform(0.0, 2.0, 60))
INPUT = np.random.default_rng(4).normal(size=20)
RATE_HZ = 13.0


def by_matrix_exponential(plant, u, rate_hz, time_s, state):
    """Step by step through every edge, each branch a companion block."""
    wn, zeta = plant.natural_frequency_rad_s, plant.damping_ratio
    size = 2 + len(plant.slow_modes)
    a, b = np.zeros((size, size)), np.zeros(size)
    a[:2, :2] = [[0, 1], [-(wn**2), -2 * zeta * wn]]
    b[1] = plant.gain * wn**2
    for i, mode in enumerate(plant.slow_modes, start=2):
        a[i, i], b[i] = -1 / mode.time_constant_s, mode.gain / mode.time_constant_s
    c = np.ones(size)
    c[1] = 0.0
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a, b
    edges = plant.delay_s + np.arange(len(u)) / rate_hz
    out = []
    for t in time_s:
        x, now, held = np.array(state, float), 0.0, 0.0
        for edge, value in zip(edges, u, strict=True):
            if edge > t:
                break
            x = (expm(block * (edge - now)) @ np.append(x, held))[:size]
            now, held = edge, value
        x = (expm(block * (t - now)) @ np.append(x, held))[:size]
        out.append(c @ x)
    return np.array(out)


@pytest.mark.parametrize("zeta", [0.0, 0.09, 1.0, 1.6])
def test_simulation_equals_the_matrix_exponential_between_the_edges(zeta):
    plant = Plant(0.5, 5.1, zeta, 0.0137, (SlowMode(0.4, 4.7), SlowMode(-0.1, 0.3)))
    state = [0.2, -1.0, 0.05, 0.3]
    got = plant.simulate(INPUT, RATE_HZ, TIME_S, state)
    expected = by_matrix_exponential(plant, INPUT, RATE_HZ, TIME_S, state)
    # The pair of poles at damping 1 is moved apart by 1e-9 of the damping ratio.
    assert np.abs(got - expected).max() < (1e-7 if zeta == 1.0 else 1e-11)


def test_frequency_response_is_the_transfer_function():
    control = pytest.importorskip("control")
    plant = Plant(0.5, 5.1, 0.09, 0.02, (SlowMode(0.4, 4.7),))
    omega_rad_s = np.geomspace(0.1, 100.0, 40)
    fast = control.tf([0.5 * 5.1**2], [1, 2 * 0.09 * 5.1, 5.1**2])
    system = fast + control.tf([0.4], [4.7, 1])
    expected = system(1j * omega_rad_s) * np.exp(-0.02j * omega_rad_s)
    assert np.allclose(plant.frequency_response(omega_rad_s), expected, rtol=1e-12)


def test_the_papers_plant_peaks_where_the_reference_data_say():
    plant = Plant(0.5, np.sqrt(26.14), 0.93 / (2 * np.sqrt(26.14)))
    assert abs(plant.frequency_response([5.0703])[0]) == pytest.approx(2.7602, abs=5e-5)
    assert plant.static_gain == 0.5
    assert plant.poles[0] == pytest.approx(-0.465 + 5.0916j, abs=1e-4)


def test_sensitivities_of_a_pole_are_its_differences():
    held, pole, step = HeldInput(INPUT, RATE_HZ), -0.4 + 5.0j, 1e-6
    centre = held.response(pole, TIME_S)
    up = held.response(pole + step, TIME_S).state
    down = held.response(pole - step, TIME_S).state
    assert np.allclose(centre.by_pole, (up - down) / (2 * step), atol=1e-8)
    later = held.response(pole, TIME_S + step).state
    earlier = held.response(pole, TIME_S - step).state
    edge_free = np.abs((TIME_S * RATE_HZ + 0.5) % 1.0 - 0.5) > 1e-4
    assert np.allclose(centre.by_time[edge_free], ((later - earlier) / (2 * step))[edge_free])


def test_simulation_agrees_with_an_ode_solver_for_one_held_step():
    plant = Plant(1.0, 3.0, 0.2)
    time_s = np.linspace(0.0, 4.0, 50)
    solved = solve_ivp(
        lambda t, x: [x[1], 9.0 * (1.0 - x[0]) - 1.2 * x[1]],
        (0.0, 4.0), [0.0, 0.0], t_eval=time_s, rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    assert np.abs(plant.simulate(np.ones(1), 1.0, time_s) - solved.y[0]).max() < 1e-8


def test_a_plant_survives_the_model_file():
    plant = Plant(0.5, 5.1, 0.09, 0.012, (SlowMode(0.4, 4.7),))
    assert Plant.from_dict(plant.to_dict()) == plant


def test_impossible_plants_and_inputs_are_refused():
    with pytest.raises(InputError, match="natural_frequency_rad_s = -1"):
        Plant(1.0, -1.0, 0.1)
    with pytest.raises(InputError, match="is incomplete or has a wrong value"):
        Plant.from_dict({"gain": 1.0})
    with pytest.raises(InputError, match="initial_state has 1"):
        Plant(1.0, 1.0, 0.1).simulate(np.ones(2), 1.0, np.ones(1), [0.0])
    with pytest.raises(InputError, match="contains NaN"):
        Plant(1.0, 1.0, 0.1).simulate(np.array([np.nan]), 1.0, np.ones(1))
