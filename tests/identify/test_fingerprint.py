"""Samples that a fit has used are recognised in any part of any record."""

import numpy as np
import pytest

from haselab.identify import Record, TransferStructure, fit_transfer
from haselab.identify.fingerprint import fingerprint, share_used
from haselab.models import Plant


def output(size, seed=1):
    return 0.0509 + 1e-4 * np.random.default_rng(seed).normal(size=size)


@pytest.mark.parametrize(("size", "start", "length"), [(400, 31, 40), (20_000, 7777, 2000)])
def test_a_part_cut_at_any_place_is_known(size, start, length):
    y = output(size)
    known = fingerprint([output(size, 2), y])
    assert share_used([y[start : start + length]], known) == 1.0
    assert share_used([output(length, 3)], known) == 0.0


def test_the_share_of_a_mixed_record_is_estimated():
    y = output(9000)
    mixed = np.concatenate([output(27_000, 2), y])
    # hashes below the limit: 256 of 9000 known windows, 768 of the others on average
    assert share_used([mixed], fingerprint([y])) == pytest.approx(0.25, abs=4 * 0.43 / 32)


def test_one_changed_sample_changes_the_windows_around_it_only():
    y = output(250)  # 235 windows: all of their hashes are kept
    known = fingerprint([y])
    y[100] += 1e-4
    assert share_used([y], known) == pytest.approx(1 - 16 / 235)


def test_rounding_of_a_conversion_does_not_hide_samples():
    y = output(2000)
    assert share_used([(100.0 * y) * 0.01], fingerprint([y])) == 1.0


def test_constant_and_short_outputs_have_no_fingerprint():
    steps = np.repeat([0.0, 1.0, 2.0], 100)  # the same in every record
    assert fingerprint([steps]).size == fingerprint([output(15)]).size == 0
    assert fingerprint([]).size == 0
    assert share_used([output(400)], []) == 0.0
    assert share_used([], fingerprint([output(400)])) == 0.0


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
    wrong = Record(-second.u, 100.0, second.y, time_s, None)
    assert fit.compare(wrong).status.startswith("the prediction is worse than the mean")
