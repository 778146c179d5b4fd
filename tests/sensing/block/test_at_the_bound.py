"""Error over the bound in every condition of benchmarks/sensing/accuracy.py, with fewer blocks."""

import importlib

import pytest

BLOCKS = 480  # the rms of so many errors is known to 1 / sqrt(960) = 3.2 %


@pytest.fixture(scope="module")
def accuracy(benchmarks):
    return importlib.import_module("benchmarks.sensing.accuracy")


@pytest.mark.long
@pytest.mark.parametrize("number", range(21))
def test_error_and_its_stated_deviation_are_as_good_as_claimed(accuracy, number):
    case, goal = accuracy.cases()[number]
    ours, _, paper = accuracy.run(case, BLOCKS, 100 + number)
    assert ours.error <= goal + 0.05, case
    assert ours.reported == pytest.approx(1.0, abs=0.1 + 0.032), case
    assert ours.valid > 0.99, case
    if case.ramp_v_s > 0.0 or case.step_at is not None:
        assert paper.error > 3.0 * ours.error, case
