"""Samples that a fit has used are recognised in any part of any record."""

import numpy as np
import pytest

from haselab.identify import Record, TransferStructure, fit_transfer
from haselab.identify.training_output import TrainingOutput, hash_output, is_comparable, share_used
from haselab.models import Plant
from haselab.models.actuator.model_tables import TrainingOutputTable


def output(size, seed=1):
    return 0.0509 + 1e-4 * np.random.default_rng(seed).normal(size=size)


@pytest.mark.parametrize(("size", "start", "length"), [(400, 31, 40), (20_000, 7777, 2000)])
def test_a_part_cut_at_any_place_is_known(size, start, length):
    y = output(size)
    known = hash_output([output(size, 2), y])
    assert share_used([y[start : start + length]], known) == 1.0
    assert share_used([output(length, 3)], known) == 0.0


def test_the_share_of_a_mixed_record_is_estimated():
    y = output(9000)
    mixed = np.concatenate([output(27_000, 2), y])
    # of 1024 windows with hashes below the limit, those well inside their cells: 0.78
    assert share_used([mixed], hash_output([y])) == pytest.approx(0.25, abs=4 * 0.43 / 28)


def test_a_changed_sample_changes_the_windows_around_it_only():
    y = output(250)  # 235 windows: all of their hashes are kept
    known = hash_output([y])
    y[100] += 1e-4
    # 0.78 of the windows well inside their cells; 16 of 235 see the sample
    assert share_used([y], known) == pytest.approx(1 - 16 / 235, abs=4 * 0.25 / 13.5)


def significant(y, digits):
    return np.array([float(f"{value:.{digits}g}") for value in y])


def vibration(rng):
    """Output of a resonance of 4.5 Hz at 100 Hz, as a test of a small actuator has it."""
    time_s, u = np.arange(3000) / 100.0, np.repeat(rng.choice([-0.01, 0.01], 300), 10)
    return Plant(0.8, 28.0, 0.15).simulate(u, 100.0, time_s)


@pytest.mark.parametrize(
    ("copied", "least"),
    [
        (lambda y: y.astype(np.float32), 1.0),
        (lambda y: significant(y, 8), 1.0),
        (lambda y: significant(y, 6), 1.0),
        # The last digit is 1/20 of a cell, so 0.9 % of the samples change theirs: 0.86 of the
        # windows stay, less 4 standard deviations of 126 windows that do not overlap.
        (lambda y: significant(y, 4), 0.74),
        (lambda y: np.round(y, 5), 0.74),
        (lambda y: np.round(1e3 * y, 3) * 1e-3, 0.99),  # mm with three decimals
        (lambda y: significant(y[1000:2500], 6), 1.0),
    ],
    ids=["float32", "8", "6", "4", "5 decimals", "millimetres", "part"],
)
def test_a_copy_with_fewer_digits_is_known(copied, least):
    rng = np.random.default_rng(7)
    y = vibration(rng) + 2e-4 * rng.normal(size=3000)
    assert share_used([copied(y)], hash_output([y])) >= least


@pytest.mark.parametrize("noise", [2e-3, 2e-4, 2e-5, 2e-6])
def test_a_repetition_with_its_own_noise_is_new(noise):
    rng = np.random.default_rng(11)
    clean, noises = vibration(rng), noise * rng.normal(size=(2, 3000))
    known = hash_output([clean + noises[0]], [noises[0]])
    assert share_used([clean + noises[0]], known) == 1.0
    assert share_used([clean + noises[1]], known) == 0.0
    assert share_used([significant(clean + noises[1], 4)], known) == 0.0


def test_residuals_show_the_noise_of_an_output_that_changes_in_every_sample():
    rng = np.random.default_rng(13)
    clean, noise = rng.normal(size=3000), 1e-3 * rng.normal(size=(2, 3000))
    known = hash_output([clean + noise[0]], [noise[0]])
    assert known.cell == pytest.approx(np.sqrt(2.0) * 1e-3, rel=0.1)
    assert share_used([clean + noise[1]], known) == 0.0
    assert share_used([significant(clean + noise[0], 6)], known) > 0.95


QUANTISED = {
    "random steps": vibration,
    "steady sine": lambda rng: 0.02 * np.sin(2 * np.pi * np.arange(3000) / 100.0),
    "sine": lambda rng: 0.02 * np.sin(2 * np.pi * 7.3 * np.arange(3000) / 100.0),
    "chirp": lambda rng: 0.02 * np.sin(2e-5 * np.pi * np.arange(3000) ** 2.0),
}


@pytest.mark.parametrize("lsb", [1e-3, 1e-4])
@pytest.mark.parametrize("noise_lsb", [0.01, 0.03, 0.1, 0.2, 0.3, 1.0])
@pytest.mark.parametrize("kind", list(QUANTISED))
def test_a_repetition_in_steps_of_a_coarse_converter_is_no_copy(kind, noise_lsb, lsb):
    rng = np.random.default_rng(3)
    clean = QUANTISED[kind](rng)
    first, second = lsb * np.round(clean / lsb + noise_lsb * rng.normal(size=(2, clean.size)))
    known = hash_output([first], [first - clean])
    share = share_used([second], known)
    assert share <= 0.05 or np.isnan(share)
    if noise_lsb >= 0.3:  # the noise shows
        assert share <= 0.05
    elif noise_lsb >= 0.1:  # where nothing is hidden by periods that repeat
        assert known.quantised
        for copy in (first, significant(first, 8), first.astype(np.float32), first + 0.1234):
            assert share_used([copy], known) >= 0.99


@pytest.mark.parametrize(
    "processed",
    [
        lambda y, rng: y - np.linspace(0.0, 0.01 * rng.normal(), y.size),  # another slope each time
        lambda y, rng: 0.1 * np.sqrt(0.05 + y),
        lambda y, rng: y + 20.0 * y**2,
    ],
    ids=["slope", "root", "square"],
)
@pytest.mark.parametrize("noise_lsb", [0.01, 0.1, 0.2, 1.0])
def test_processing_of_coarse_steps_makes_no_copy_of_a_repetition(noise_lsb, processed):
    rng, lsb = np.random.default_rng(3), 1e-3
    clean = vibration(rng)
    first, second = (
        processed(lsb * np.round(clean / lsb + noise_lsb * rng.normal(size=clean.size)), rng)
        for _ in range(2)
    )
    known = hash_output([first])
    assert known.quantised or noise_lsb > 0.4
    share = share_used([second], known)
    assert np.isnan(share) or share <= 0.05
    assert share_used([first], known) >= 0.99


def test_a_copy_in_which_another_level_is_zero_is_known():
    y = output(2000)
    assert share_used([y - y[0]], hash_output([y])) == 1.0


def test_two_windows_of_independent_noise_rarely_agree():
    # cells as wide as the noise of the differences: P(same cell) = 2 Phi-integral = 0.27, to the
    # 16th 8e-10
    steps = np.abs(
        np.diff(np.floor(np.random.default_rng(5).normal(size=(2, 10**6)) + 0.5), axis=0)
    )
    assert np.mean(steps == 0) == pytest.approx(0.27, abs=0.005)
    y = 0.05 + 1e-4 * np.random.default_rng(6).normal(size=200_000)  # at rest, noise alone
    assert share_used([y[100_000:]], hash_output([y[:100_000]])) == 0.0


def test_rounding_of_a_conversion_does_not_hide_samples():
    y = output(2000)
    assert share_used([(100.0 * y) * 0.01], hash_output([y])) == 1.0


def test_constant_and_short_outputs_have_no_training_output():
    steps = np.repeat([0.0, 1.0, 2.0], 100)  # the same in every record
    assert hash_output([steps]).hashes.size == hash_output([output(15)]).hashes.size == 0
    assert hash_output([]).hashes.size == hash_output([np.ones(400)]).hashes.size == 0
    assert np.isnan(share_used([output(400)], TrainingOutput(0.0, np.zeros(0, np.uint64))))
    assert np.isnan(share_used([], hash_output([output(400)])))


@pytest.mark.parametrize("other", [np.zeros(500), np.linspace(0.0, 1.0, 12)])
def test_a_record_without_comparable_windows_is_neither_new_nor_known(other):
    known = hash_output([output(400)])
    assert np.isnan(share_used([other], known)) and not is_comparable([other], known)
    assert is_comparable([output(400, 3)], known)


def test_a_scaled_copy_counts_as_new():
    y = output(400)
    assert share_used([1.7 * y], hash_output([y])) == 0.0


def test_compare_in_python_knows_half_of_the_record():
    plant, rng = Plant(0.5, 9.0, 0.15, 0.02), np.random.default_rng(5)
    held = np.repeat(rng.normal(size=(2, 30)), 50, axis=1)
    time_s = np.arange(1500) / 100.0
    first, second = (
        Record(u, 100.0, plant.simulate(u, 100.0, time_s) + 0.002 * rng.normal(size=1500), time_s)
        for u in held
    )
    fit = fit_transfer(first, TransferStructure())
    half = Record(first.u[:750], 100.0, first.y[:750], time_s[:750])
    found = fit.compare(half)
    assert found.used_for_fit == 1.0
    assert found.status.startswith("not a validation: 100 % of the samples were used for the fit")
    assert (fit.compare(second).status, fit.compare(second).used_for_fit) == ("ok", 0.0)
    assert str(fit.compare(second)).startswith("Prediction: ok\nfit_percent ")
    wrong = Record(-second.u, 100.0, second.y, time_s, None)
    assert fit.compare(wrong).status.startswith("the prediction is worse than the mean")


def test_hashes_of_cells_without_width_are_refused():
    with pytest.raises(ValueError, match=r"cell is 0, but hashes need cells above 0"):
        TrainingOutputTable(cell=0.0, hashes=[1])
    assert TrainingOutputTable(cell=0.0, hashes=[]).cell == 0.0  # of a constant output
