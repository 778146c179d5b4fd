"""What a user reads if the errors of a prediction are larger than its band."""

import numpy as np
import pytest

from haselab.identify import Record
from haselab.identify.band import BandCheck
from haselab.identify.prediction import predict
from haselab.models import Plant

COUNT, STD = 4000, 0.01
TIME_S = np.arange(COUNT) / 100.0
HALF = np.full(COUNT, 1.959963984540054 * STD)


def noise(seed=1):
    return STD * np.random.default_rng(seed).standard_normal(COUNT)


def judged(error, noise_std=STD):
    return BandCheck.of([error[:1500], error[1500:]], HALF, noise_std)


@pytest.mark.parametrize("seed", range(8))
def test_white_and_coloured_noise_of_the_stated_size_are_no_remark(seed):
    white = noise(seed)
    coloured = np.convolve(white, np.exp(-np.arange(400) / 80.0), "same")
    for error in (white, coloured * STD / np.std(coloured)):
        found = judged(error)
        assert (found.error, found.note) == ("", "")


@pytest.mark.parametrize(
    ("added", "words"),
    [
        (STD + 0.0 * TIME_S, " above the predicted one. The zero of the sensor"),
        (-STD + 0.0 * TIME_S, " below the predicted one. The zero of the sensor"),
        (3.0 * STD * (TIME_S / 40.0 - 0.5), "slow disturbances are larger"),
        (1.5 * STD * np.sin(0.37 * TIME_S), "slow disturbances are larger"),
        (1.5 * noise(2), "The noise is "),
    ],
)
def test_a_small_excess_is_a_note_with_its_cause(added, words):
    found = judged(noise() + added)
    assert found.error == "" and words in found.note, found.note
    assert found.note.startswith("Only ")


def test_an_excess_of_few_independent_errors_is_not_silent():
    found = judged(2.1 * STD * np.sin(0.25 * TIME_S) + 0.1 * noise())
    assert found.error == "" and 0.6 < found.inside < 0.85
    assert "of them are independent, so this may be chance" in found.note


def test_a_large_excess_is_a_model_error_but_larger_white_noise_is_not():
    swing = 4.0 * STD * np.sin(28.0 * TIME_S)
    assert judged(noise() + swing).error.startswith("model error: the rms error is ")
    # the mean square of the swing is 4^2 / 2, that of the noise 1
    assert judged(noise() + swing).rms == pytest.approx(3.0, rel=4.0 / np.sqrt(2.0 * COUNT))
    noisy = judged(5.0 * noise())
    assert noisy.error == "" and "The noise is " in noisy.note


def test_an_error_that_uncertain_parameters_share_is_larger_by_chance():
    shared = 2.5 * STD + 0.01 * noise()
    assert judged(shared, 0.01 * STD).error == ""
    assert "model error" in judged(shared).error


@pytest.mark.parametrize("last", [10, COUNT])
def test_a_record_that_its_initial_state_explains_is_no_validation(last):
    plant = Plant(0.8, 28.0, 0.15)
    u = 1.0 + 0.0 * TIME_S[:last] if last == COUNT else np.sin(TIME_S[:last])
    y = plant.simulate(u, 100.0, TIME_S[:last]) + noise()[:last]
    found = predict(plant, Record(u, 100.0, y, TIME_S[:last]), rng=np.random.default_rng(1))
    assert found.status.startswith("not a validation: the initial state and the constant")
