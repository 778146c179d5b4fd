"""The voltage plant: squares, ramps, polarity, and creep of either kind, against closed forms."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from haselab.base import InputError
from haselab.models.voltage_plant import VoltagePlant, delayed_square

RATE_HZ = 100.0
TIME_S = np.arange(2000) / RATE_HZ


def test_without_relaxation_only_the_square_of_the_voltage_counts():
    drive_v = np.random.default_rng(1).uniform(-2.0, 2.0, 50)
    np.testing.assert_array_equal(delayed_square(drive_v, RATE_HZ, 0.0, 3.0), drive_v**2)


def test_a_relaxing_voltage_goes_from_the_instant_part_to_all_of_it():
    """A step from 0 to V: ((1 - s) + s (1 - exp(-t/tau)))^2 V^2 at the middle of each update."""
    share, tau_s = 0.4, 3.0
    drive_v = np.concatenate([[0.0], np.full(1999, 1.5)])
    pull = delayed_square(drive_v, RATE_HZ, share, tau_s)
    middle_s = TIME_S[1:] - TIME_S[1] + 0.5 / RATE_HZ
    expected = (1.5 * (1.0 - share * np.exp(-middle_s / tau_s))) ** 2
    np.testing.assert_allclose(pull[1:], expected, rtol=1e-12)


def test_fast_alternation_takes_the_relaxing_part_away():
    """The relaxed voltage swings by V T / (4 tau) at most about its mean, which is zero."""
    share, tau_s, flips_s = 0.35, 5.0, 0.1
    drive_v = np.where((np.arange(20000) // 10) % 2, -1.5, 1.5)
    pull = delayed_square(drive_v, RATE_HZ, share, tau_s)[-1000:]
    swing_v = 1.5 * flips_s / (2.0 * tau_s)
    slack = 2.0 * (1.0 - share) * 1.5 * share * swing_v + (share * swing_v) ** 2
    assert np.abs(pull - ((1.0 - share) * 1.5) ** 2).max() <= slack


def test_a_limited_slew_loses_the_square_of_the_ramp():
    """From -1 V to 1 V in the whole update the mean square is 1/3; in half of it, 2/3."""
    drive_v = np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(delayed_square(drive_v, RATE_HZ, 0.0, 1.0, 200.0), [1, 1 / 3, 1])
    np.testing.assert_allclose(delayed_square(drive_v, RATE_HZ, 0.0, 1.0, 400.0), [1, 2 / 3, 1])


@pytest.mark.parametrize("creep", ["mechanical", "electrical"])
def test_the_output_is_that_of_the_differential_equations(creep):
    plant = VoltagePlant(creep, (0.05, 0.01), 5.11, 0.09, 0.0, 0.3, 2.0)
    levels_v = np.array([1.0, 1.6, -1.2, 0.4])
    drive_v = np.repeat(levels_v, 500)
    w, z, tau_s = 5.11, 0.09, 2.0

    def slopes(t, state):
        x, rate, slow, relaxed_v = state
        v = levels_v[min(int(t / 5.0), 3)]
        pull = v * v if creep == "mechanical" else (0.7 * v + 0.3 * relaxed_v) ** 2
        return [rate, w * w * (pull - x) - 2 * z * w * rate, (pull - slow) / tau_s,
                (v - relaxed_v) / tau_s]  # fmt: skip

    truth = solve_ivp(
        slopes, (0.0, 19.99), [1.0, 0.0, 1.0, 1.0], t_eval=TIME_S, rtol=1e-8, atol=1e-10,
        max_step=0.005,
    ).y  # fmt: skip
    x = truth[0] if creep == "electrical" else 0.7 * truth[0] + 0.3 * truth[2]
    expected = 0.05 * (x - 1.0) + 0.01 * (x**2 - 1.0)
    # The pull is held over an update; within one its relaxing part moves by T/tau at most.
    slack = 0.07 * 2.0 * 0.3 * 1.6 * 2.8 * (0.01 / tau_s) if creep == "electrical" else 0.0
    assert np.abs(plant.simulate(drive_v, RATE_HZ, TIME_S) - expected).max() < slack + 2e-5


def test_mechanical_creep_does_not_see_the_polarity_and_electrical_does():
    drive_v = np.repeat([1.0, 1.5, -1.5, 1.5], 500)
    for creep, sees in (("mechanical", False), ("electrical", True)):
        plant = VoltagePlant(creep, (0.05,), 5.11, 0.09, 0.0, 0.3, 4.0)
        signed = plant.simulate(drive_v, RATE_HZ, TIME_S)
        unsigned = plant.simulate(np.abs(drive_v), RATE_HZ, TIME_S)
        assert bool(np.abs(signed - unsigned).max() > 1e-3) is sees


def test_a_second_mode_rings_beside_the_first():
    one = VoltagePlant("mechanical", (0.05,), 5.11, 0.09)
    two = VoltagePlant("mechanical", (0.05,), 5.11, 0.09, second_mode=(40.0, 0.01, 0.2))
    drive_v = np.concatenate([np.ones(100), np.full(1900, 1.5)])
    at_end = [plant.simulate(drive_v, RATE_HZ, TIME_S)[-1] for plant in (one, two)]
    assert abs(at_end[0] - at_end[1]) < 0.05 * 1.25 * 0.2 * np.exp(-0.4 * 18.99)
    # Its frequency stands alone in what the first one leaves.
    rest = np.abs(np.fft.rfft(two.simulate(drive_v, RATE_HZ, TIME_S)[200:]))
    assert abs(2 * np.pi * RATE_HZ * (100 + rest[100:200].argmax()) / 1800 - 40.0) < 0.5


def test_a_plant_survives_its_file():
    plant = VoltagePlant("electrical", (0.05, 0.002), 5.1, 0.1, 0.01, 0.3, 4.0, (40.0, 0.1, 0.2))
    assert VoltagePlant.from_dict(plant.to_dict()) == plant
    with pytest.raises(InputError, match="wrong value: 'gains'"):
        VoltagePlant.from_dict({"creep": "electrical"})


@pytest.mark.parametrize(
    ("numbers", "match"),
    [
        (
            ("thermal", (0.05,), 5.0, 0.1),
            "creep = thermal; it must be one of mechanical, electrical",
        ),
        (("mechanical", (), 5.0, 0.1), "gains is empty"),
        (("mechanical", (0.05,), 5.0, 0.1, 0.0, 1.0), "creep_share = 1; it must be 0 to below 1"),
        (("mechanical", (0.05,), -5.0, 0.1), "natural_frequency_rad_s = -5"),
    ],
)
def test_numbers_out_of_range_are_refused(numbers, match):
    with pytest.raises(InputError, match=match):
        VoltagePlant(*numbers)
