"""Blocks that the plain model does not explain: right within the stated deviation, or refused.

The records are those of the sensing board (`benchmarks/sensing_cases.py`), made without the code
under test; the bound is Cramer-Rao's for the white noise and the converter's step alone.
"""

from dataclasses import replace

import numpy as np
import pytest

from haselab.sensing import Lockin

BLOCKS = 60


@pytest.fixture(scope="module")
def cases(benchmarks):
    from sensing_cases import CASES

    return {case.name: case for case in CASES}


def sensed_of(case, blocks=BLOCKS, seed=3):
    readings, truth_f = case.record(blocks, seed)
    sensed = Lockin(case.scene.config()).sense(readings)
    return sensed, sensed.capacitance_f / truth_f - 1.0, sensed.capacitance_std_f / truth_f


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


# 60 blocks tell an rms to 9 %; pieces left out for a step cost up to a fifth of the samples.
@pytest.mark.parametrize(
    ("name", "words", "over_bound"),
    [
        ("sine drive 4 V, 10 Hz", "drive of degree", 1.3),
        ("hum 0.1 V, 50 Hz, voltage only", "hum of 0.1 V at 50 Hz", 1.3),
        ("hum 1 V, 50 Hz", "hum of 1 V at 50 Hz", 1.3),
        ("hum 5 V, 60 Hz, 5 kHz", "at 60 Hz", 1.3),
        ("step 0.2 V, tau 0.5 ms, at 3 ms", "tail of 0.", 1.4),
        ("third harmonic 3 %, 0.25 V", "harmonics of the carrier", 1.3),
        ("amplitude modulation 20 %, 35 Hz", "modulated carrier", 1.4),
        ("second tone 10 mV, 2.37 kHz", "tone at 2370 Hz", 1.3),
        ("tone 50 mV, 31 kHz", "tone at 31000 Hz", 1.3),
    ],
)
def test_a_disturbance_is_modelled_named_and_costs_little(cases, name, words, over_bound):
    case = cases[name]
    sensed, error, std = sensed_of(case)
    assert sensed.valid.mean() > 0.95
    assert rms(error) < over_bound * case.scene.bound
    assert 0.7 < rms(std) / rms(error) < 1.4
    assert (np.abs(error[sensed.valid]) < 5.0 * std[sensed.valid]).all()
    assert np.mean([words in sensed.model(k) for k in np.flatnonzero(sensed.valid)]) > 0.8


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("current flat at 80 %", "flat top"),
        ("current flat at 95 %", "flat top"),
        ("current flat at 80 %, one side", "flat top"),
        ("voltage flat at 80 %, 0.25 V", "flat top"),
        ("current saturates softly", "flat top"),
        ("converter step 10 mV, 5 steps", "step of the converter (0.01 V)"),
        ("converter step 10 mV, 2.5 steps", "step of the converter (0.01 V)"),
    ],
)
def test_what_cannot_be_known_is_refused_with_its_cause(cases, name, words):
    sensed, *_ = sensed_of(cases[name])
    assert not sensed.valid.any()
    assert all(words in sensed.reason_of(k) for k in range(BLOCKS))


@pytest.mark.parametrize("name", ["pink noise", "brown noise", "noise common to both, 70 %"])
def test_noise_that_is_not_white_has_an_honest_deviation(cases, name):
    sensed, error, std = sensed_of(cases[name], blocks=120)
    assert sensed.valid.mean() > 0.9
    assert 0.7 < rms(std) / rms(error) < 1.45


def test_plain_blocks_keep_the_numbers_of_the_plain_model(cases):
    """A record of plain blocks with a few disturbed ones: the others do not feel them."""
    plain, step = cases["plain"], cases["step 0.2 V, tau 0.5 ms, at 3 ms"]
    clean, _ = plain.record(BLOCKS, 5)
    mixed = clean.copy()
    mixed[10:20] = step.record(10, 5)[0]
    lockin = Lockin(plain.scene.config())
    alone, among = lockin.sense(clean), lockin.sense(mixed)
    others = np.r_[0:10, 20:BLOCKS]
    assert np.array_equal(alone.capacitance_f[others], among.capacitance_f[others])
    assert alone.model(0) == "plain"


def test_columns_and_blocks_give_the_same(cases):
    case = cases["hum 1 V, 50 Hz"]
    readings, _ = case.record(12, 1)
    lockin = Lockin(case.scene.config())
    columns = np.ascontiguousarray(readings.reshape(-1, 2).T)
    one, other = lockin.sense(readings), lockin.sense_channels(columns[0], columns[1])
    assert np.array_equal(one.capacitance_f, other.capacitance_f)
    assert one.seen == other.seen


def test_a_spike_costs_nothing(cases):
    case = cases["one reading of 0.5 V off"]
    readings, truth_f = case.record(BLOCKS, 1)
    lockin = Lockin(replace(case.scene.config(), search_updates=False))
    sensed = lockin.sense(readings)
    assert sensed.valid.all()
    assert "spike" in sensed.model(3)
    assert rms(sensed.capacitance_f / truth_f - 1.0) < 1.3 * case.scene.bound
