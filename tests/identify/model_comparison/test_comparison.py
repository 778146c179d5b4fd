"""Verdicts: right where models can be distinguished, "cannot tell" where they cannot."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError
from haselab.identify import (
    Record,
    TransferStructure,
    compare,
    creep_hypotheses,
    linear_mode_hypotheses,
    mode_hypotheses,
    reading_hypotheses,
)
from haselab.identify.model_comparison.comparison import Explanation, noise_shape
from haselab.identify.model_comparison.hypotheses import TransferHypothesis, hypotheses_of
from haselab.models import Plant, VoltagePlant
from haselab.signals import constant, linear_chirp, square

RATE_HZ = 100.0


def record(plant, drive_v, noise=1e-3, seed=1):
    time_s = np.arange(drive_v.size) / RATE_HZ
    y = plant.simulate(drive_v, RATE_HZ, time_s)
    return Record(
        drive_v, RATE_HZ, y + noise * np.random.default_rng(seed).normal(size=y.size), time_s
    )


def alternating():
    held = constant(1.5, 6.0, RATE_HZ)
    turns = 1.5 * square(1.0, 6.0, RATE_HZ)
    rest = constant(1.0, 6.0, RATE_HZ)
    return np.concatenate([rest[:100], held, turns, rest, turns])


def plant_of(creep="mechanical", omega_rad_s=5.11, second=None):
    return VoltagePlant(creep, (0.05, 0.004), omega_rad_s, 0.1, 0.01, 0.35, 3.0, second)


@dataclass(frozen=True)
class Line:
    """A hypothesis without numbers of its own: the output is this."""

    name: str
    says: str
    output: np.ndarray
    parameters: int = 1

    def explain(self, records, near=None):
        residuals = tuple(r.y - self.output for r in records)
        return Explanation("ok", self.parameters, (self.output,), residuals, {}, {})


def noisy(output, noise, seed=3):
    y = output + noise * np.random.default_rng(seed).normal(size=output.size)
    return Record(np.ones(output.size), RATE_HZ, y, np.arange(output.size) / RATE_HZ)


@pytest.mark.long
@pytest.mark.parametrize("truth", ["mechanical", "electrical"])
def test_alternating_polarity_identifies_the_kind_of_creep(truth):
    found = compare(creep_hypotheses(), [record(plant_of(truth), alternating())])
    assert found.verdict == f"supports {truth}"
    assert found.candidates[0].probability > 0.99
    assert found.candidates[0].model["voltage_plant"]["creep"] == truth


@pytest.mark.long
@pytest.mark.parametrize("truth", ["mechanical", "electrical"])
def test_small_steps_of_one_polarity_cannot_identify_the_kind_of_creep(truth):
    """About a level both creeps are one slow exponential.

    They differ by the square of a step of 2 %, times gain and share: 0.05 * 4e-4 * 0.35^2, far
    below the noise over the root of 4,000 samples, 1.6e-5.
    """
    drive_v = 1.0 + 0.02 * square(0.05, 40.0, RATE_HZ)
    found = compare(creep_hypotheses(), [record(plant_of(truth), drive_v, 1e-3)])
    assert found.verdict == "cannot tell"
    assert any(note.startswith("Not excluded") for note in found.notes)


@pytest.mark.long
@pytest.mark.parametrize(("omega_rad_s", "expected"), [
    (5.3, "supports rad"), (31.0, "supports hz"), (13.0, "supports neither"),
])  # fmt: skip
def test_a_chirp_identifies_the_unit_of_the_frequency(omega_rad_s, expected):
    drive_v = 1.0 + 0.4 * linear_chirp(0.1, 10.0, 10.0, RATE_HZ)
    found = compare(reading_hypotheses(), [record(plant_of(omega_rad_s=omega_rad_s), drive_v)])
    assert found.verdict == expected


@pytest.mark.long
def test_noise_without_motion_identifies_no_unit_of_the_frequency():
    rng = np.random.default_rng(8)
    silent = Record(1.0 + 0.01 * rng.normal(size=600), RATE_HZ, rng.normal(size=600),
                    np.arange(600) / RATE_HZ)  # fmt: skip
    found = compare(reading_hypotheses(), [silent])
    assert found.supported == ""
    assert any("hardly depends on the drive" in note for note in found.notes)


@pytest.mark.long
@pytest.mark.parametrize(("second", "expected"), [(None, "one"), ((19.0, 0.05, 0.15), "two")])
def test_a_second_resonance_is_found_where_there_is_one(second, expected):
    rng = np.random.default_rng(5)
    drive_v = np.repeat(rng.uniform(0.6, 1.4, 100), 15)
    found = compare(mode_hypotheses(), [record(plant_of(second=second), drive_v, 5e-4)])
    assert found.verdict == f"supports {expected}"


@pytest.mark.parametrize("two", [False, True])
def test_modes_are_identified_from_a_proportional_input_too(two):
    u = np.random.default_rng(6).normal(size=1500)
    time_s = np.arange(1500) / RATE_HZ
    y = Plant(0.5, 5.11, 0.09, 0.01).simulate(u, RATE_HZ, time_s)
    if two:
        y = y + Plant(0.1, 20.0, 0.05, 0.01).simulate(u, RATE_HZ, time_s)
    y = y + 0.005 * np.random.default_rng(7).normal(size=1500)
    found = compare(linear_mode_hypotheses(), [Record(u, RATE_HZ, y, time_s)])
    assert found.verdict == ("supports two" if two else "supports one")


def test_a_fit_without_a_result_excludes_nothing():
    rng = np.random.default_rng(9)
    unrelated = Record(rng.normal(size=400), RATE_HZ, rng.normal(size=400), np.arange(400) / 100.0)
    hypotheses = [TransferHypothesis(n, n, TransferStructure()) for n in ("a", "b")]
    found = compare(hypotheses, [unrelated])
    assert not found.succeeded
    assert "fewer than two hypotheses could be fitted" in found.status
    known = Line("c", "c", np.zeros(400))
    mixed = compare([known, Line("d", "d", np.ones(400)), hypotheses[0]], [unrelated])
    assert mixed.verdict == "cannot tell"
    assert any("has no fit and is not excluded" in note for note in mixed.notes)


def test_in_white_noise_the_odds_are_those_of_known_gaussians():
    """BIC difference: N ln(SSE_b / SSE_a), computed here from the residuals."""
    base = np.sin(np.arange(400) / 9.0)
    seen = noisy(base, 0.1)
    wrong = base + 0.02 * np.cos(np.arange(400) / 30.0)
    found = compare([Line("a", "a", base), Line("b", "b", wrong)], [seen])
    costs = {"a": ((seen.y - base) ** 2).sum(), "b": ((seen.y - wrong) ** 2).sum()}
    best = min(costs, key=costs.get)
    other = max(costs, key=costs.get)
    assert found.candidates[0].name == best
    assert found.effective_samples == 400.0
    assert math.isclose(found.candidates[1].bic, 400 * math.log(costs[other] / costs[best]),
                        rel_tol=1e-9)  # fmt: skip


def test_two_models_equally_far_from_the_truth_are_seldom_distinguished():
    """The truth lies half-way: a verdict either way is wrong, allowed in 1 % of runs each.

    Of 300 runs 6 are expected at most; 15 or more would come up in 1 of 1,000.
    """
    base, apart = np.sin(np.arange(500) / 9.0), 0.05 * np.cos(np.arange(500) / 15.0)
    hypotheses = [Line("a", "a", base + apart), Line("b", "b", base - apart)]
    records = ([noisy(base, 0.1, seed)] for seed in range(300))
    decided = sum(compare(hypotheses, record).supported != "" for record in records)
    assert decided < 15


def test_what_all_candidates_leave_out_does_not_decide():
    """Both miss the same slow wave; one of them happens to lean towards it by a third."""
    base, wave = np.sin(np.arange(2000) / 9.0), np.cos(np.arange(2000) / 150.0)
    hypotheses = [Line("a", "a", base + 0.03 * wave), Line("b", "b", base)]
    found = compare(hypotheses, [noisy(base + 0.1 * wave, 0.01)])
    assert found.candidates[1].bic > 0.0
    assert found.verdict == "cannot tell"


def test_none_explains_what_none_follows():
    wave = np.cos(np.arange(2000) / 100.0)
    hypotheses = [Line("a", "a", 0.0 * wave), Line("b", "b", 0.1 * np.sin(np.arange(2000) / 3.0))]
    found = compare(hypotheses, [noisy(wave, 0.05)])
    assert found.verdict == "none explains the data"


def test_the_shape_of_coloured_noise_is_that_of_the_closed_form():
    """AR(1), pole a: samples N (1 - a^2)/(1 + a^2), strongest (1 + a)/(1 - a), white 1 - a^2.

    A pole of 0.9 is known to root(0.19 / 40000) = 0.002; that moves 1 - a by 2 % and 1 - a^2 alike.
    """
    noise = np.random.default_rng(2).normal(size=40000)
    shape = noise_shape([lfilter([1.0], [1.0, -0.9], noise)])
    assert abs(shape.samples / 40000 * 1.81 / 0.19 - 1.0) < 0.1
    assert abs(shape.strongest / 19.0 - 1.0) < 0.1
    assert abs(shape.white / 0.19 - 1.0) < 0.1


def test_bad_questions_are_refused():
    hypotheses = creep_hypotheses()
    seen = noisy(np.arange(50.0), 0.1)
    with pytest.raises(InputError, match="1 hypotheses; at least two are required"):
        compare(hypotheses[:1], [seen])
    with pytest.raises(InputError, match=r"risk = 0\.7; it must be above 0 and below 0\.5"):
        compare(hypotheses, [seen], risk=0.7)
    with pytest.raises(InputError, match="unexplained = 2"):
        compare(hypotheses, [seen], unexplained=2.0)
    with pytest.raises(
        InputError, match="question = colour; it must be one of reading, creep, modes"
    ):
        hypotheses_of("colour")
    with pytest.raises(InputError, match="spread = 3"):
        reading_hypotheses(spread=3.0)
