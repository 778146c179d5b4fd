"""Recursive estimates against one weighted least squares over all readings so far."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.sensing import Recursive

BLOCK = 200  # two carrier periods: a result every millisecond


@pytest.fixture
def fast(scene):
    return scene.but(block_samples=BLOCK)


def weighted(record, case, memory_s, blocks):
    """numpy's least squares, weights constant in a block and fading from block to block."""
    n = blocks * BLOCK
    time_s = np.arange(n) / case.rate_hz
    omega = 2 * np.pi * case.carrier_hz
    age = blocks - 1 - np.arange(n) // BLOCK
    root = np.exp(-0.5 * age * BLOCK / case.rate_hz / memory_s)
    basis = np.stack(
        [np.cos(omega * time_s), np.sin(omega * time_s), np.ones(n), time_s - time_s[-1]], axis=1
    )
    solution = np.linalg.lstsq(basis * root[:, None], record[:n] * root[:, None], rcond=None)[0]
    return solution[0] - 1j * solution[1], solution[2], solution[3]


@pytest.mark.parametrize("memory_s", [1e-3, 5e-3, 30e-3])
@pytest.mark.parametrize("carrier_hz", [2000.0, 1731.0])
def test_every_result_is_the_least_squares_of_all_readings_with_fading_weights(
    fast, rng, memory_s, carrier_hz
):
    case = fast.but(carrier_hz=carrier_hz, ramp_v_s=2.0)
    readings = case.readings(60, rng)
    sensed = Recursive(case.config(), memory_s).sense(readings)
    record = readings.reshape(-1, 2)
    for blocks in (2, 3, 10, 60):
        phasors, _, _ = weighted(record, case, memory_s, blocks)
        z = case.ohm_per_ratio * phasors[0] / phasors[1]
        exact_f = -1 / (2 * np.pi * carrier_hz * z.imag)
        assert sensed.capacitance_f[blocks - 1] == pytest.approx(exact_f, rel=2e-5)
    assert sensed.time_s[-1] == pytest.approx(60 * BLOCK / case.rate_hz)


def test_calls_go_on_where_the_last_one_ended(fast, rng):
    readings = fast.readings(30, rng)
    whole = Recursive(fast.config(), 5e-3).sense(readings)
    parts = Recursive(fast.config(), 5e-3)
    joined = [parts.sense(part) for part in (readings[:7], readings[7:8], readings[8:])]
    np.testing.assert_array_equal(
        np.concatenate([part.capacitance_f for part in joined]), whole.capacitance_f
    )
    np.testing.assert_array_equal(np.concatenate([part.time_s for part in joined]), whole.time_s)


@pytest.mark.long
def test_reported_standard_deviation_is_the_true_scatter(fast):
    ends = []
    for seed in range(300):
        readings = fast.readings(25, np.random.default_rng(seed))
        sensed = Recursive(fast.config(), 3e-3).sense(readings)
        ends.append((sensed.capacitance_f[-1], sensed.capacitance_std_f[-1]))
    values, stds = np.array(ends).T
    # 300 values tell a standard deviation to 1 / sqrt(600) = 4 %.
    assert stds.mean() == pytest.approx(values.std(), rel=0.15)
    assert abs(values.mean() - fast.capacitance_f) < 5 * values.std() / np.sqrt(300)


def test_a_step_of_capacitance_is_met_with_the_memorys_time_constant(fast):
    before, after = fast, fast.but(capacitance_f=1.6e-9)
    readings = np.concatenate([before.readings(100, None), after.readings(40, None)])
    sensed = Recursive(fast.config(), 5e-3).sense(readings)
    left = (1.6e-9 - sensed.capacitance_f[100:]) / 0.1e-9
    elapsed_s = 1e-3 * np.arange(1, 41)
    # The current's phasor is a weighted mean of both: exact but for the bend of C over it.
    np.testing.assert_allclose(left, np.exp(-elapsed_s / 5e-3), atol=0.04)


@pytest.mark.parametrize("spoil", ["clipped", "nan"])
def test_a_spoiled_block_only_lets_time_pass(fast, rng, spoil):
    readings = fast.readings(40, rng)
    readings[20, 50, 1] = {"clipped": 30.0, "nan": np.nan}[spoil]
    sensed = Recursive(fast.config(full_scale=10.0), 5e-3).sense(readings)
    assert np.flatnonzero(~sensed.valid).tolist() == [20]
    off = (sensed.capacitance_f - fast.capacitance_f) / sensed.capacitance_std_f
    assert np.abs(off[21:]).max() < 5.0
    # What is left of the memory knows less for a while.
    assert sensed.capacitance_std_f[21] > sensed.capacitance_std_f[19]


@pytest.mark.parametrize(
    ("changes", "memory_s", "words"),
    [
        ({"blank": (0, 10)}, 5e-3, "no blanking"),
        ({"search_updates": True}, 5e-3, "no blanking"),
        ({}, 0.5e-3, "shorter than a block"),
        ({"block_samples": 80}, 5e-3, "at least one"),
    ],
)
def test_what_it_cannot_do_is_refused(fast, changes, memory_s, words):
    with pytest.raises(InputError, match=words):
        Recursive(fast.config(**changes), memory_s)
