"""Blocks that the plain model does not explain: right within the stated deviation, or refused.

The records are those of `benchmarks/sensing/disturbance_cases.py`, made without the code under
test; the bound is Cramer-Rao's for the white noise and the converter's step alone.
"""

from dataclasses import replace

import numpy as np
import pytest

from haselab.sensing import Lockin

BLOCKS = 60


@pytest.fixture(scope="module")
def cases(benchmarks):
    from benchmarks.sensing.disturbance_cases import CASES

    return {case.name: case for case in CASES}


def sensed_of(case, blocks=BLOCKS, seed=3):
    readings, truth_f = case.record(blocks, seed)
    sensed = Lockin(case.scene.config()).sense(readings)
    return sensed, sensed.capacitance_f / truth_f - 1.0, sensed.capacitance_std_f / truth_f


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


# 60 blocks determine an rms to 9 %; segments left out for a step cost up to a fifth of the samples.
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


@pytest.mark.parametrize(
    "name",
    [
        "step 0.2 V, tau 0.5 ms, anywhere",
        "two steps 0.2 V anywhere",
        "step, tails of 0.1 and 1.5 ms",
        "step 2 V, rises in 1 ms",
        "hum 0.3 V, blocks of 2.5 ms",
    ],
)
def test_steps_anywhere_are_right_in_nearly_all_blocks(cases, name):
    case = cases[name]
    sensed, error, std = sensed_of(case, blocks=120)
    assert sensed.valid.mean() > 0.97
    assert rms(error) < 1.3 * case.scene.bound  # 120 blocks determine an rms to 6 %
    assert 0.75 < rms(std) / rms(error) < 1.33
    assert (np.abs(error[sensed.valid]) < 5.0 * std[sensed.valid]).all()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("step 0.2 V, rings at 1 kHz", ("fast drive", "transient", "step")),
        ("current lost for 60 %", ("current monitor lost", "amplitude lost")),
        ("current stuck for 60 %", ("current monitor stuck",)),
        ("current halved for 30 %", ("current monitor at",)),
    ],
)
def test_what_hits_a_part_of_a_block_is_left_out_or_refused_with_its_cause(cases, name, words):
    sensed, error, std = sensed_of(cases[name])
    valid = sensed.valid
    assert (np.abs(error[valid]) < 5.0 * std[valid]).all()
    refused = [sensed.reason_of(k) for k in np.flatnonzero(~valid)]
    assert len(refused) > 0.3 * BLOCKS
    named = [any(word in text for word in words) for text in refused]
    assert np.mean(named) > 0.9


def test_a_block_too_short_for_models_is_refused_where_it_is_not_plain(cases):
    """2.5 carrier periods under hum, against the same without it."""
    plain, hum = cases["plain"], cases["hum 1 V, 50 Hz"]
    short = replace(plain.scene, block=250, v_peak_v=0.25)
    clean, _ = replace(plain, scene=short).record(80, 2)
    loud, _ = replace(hum, scene=short).record(80, 2)
    assert Lockin(short.config()).sense(clean).valid.all()
    sensed = Lockin(short.config()).sense(loud)
    assert not sensed.valid.any()
    assert all("too few carrier periods" in sensed.reason_of(k) for k in range(80))
