"""Creep fits: truth recovered with correct intervals, the right verdict, forecasts that hold."""

from collections import Counter

import numpy as np
import pytest
from scipy.stats import binom

from haselab.base import InputError, ResultError
from haselab.identify import Record, fit_creep
from haselab.models import FractionalCreep, LogarithmicCreep, PowerCreep, PronyCreep

NOISE = 0.003
RATE_HZ = 50.0
HELD = np.r_[np.zeros(100), np.ones(1500), np.zeros(1400)]
TWO = PronyCreep(1.0, (0.2, 0.15), (0.8, 9.0))
TWO_TRUTH = {"instant": 1.0, "offset": 0.4, "gain_1": 0.2, "gain_2": 0.15,
             "time_constant_1_s": 0.8, "time_constant_2_s": 9.0}  # fmt: skip
FRACTIONAL = FractionalCreep(1.0, 0.3, 0.6, 3.0)
FRACTIONAL_TRUTH = {"instant": 1.0, "offset": 0.4, "gain_1": 0.3, "order": 0.6,
                    "time_constant_1_s": 3.0}  # fmt: skip


def answer(creep, u=HELD, seed=0, offset=0.4):
    noise = NOISE * np.random.default_rng(seed).normal(size=u.size)
    return offset + creep.simulate(u, RATE_HZ) + noise


@pytest.mark.long
@pytest.mark.parametrize(
    ("creep", "truth", "kind"),
    [(TWO, TWO_TRUTH, "prony"), (FRACTIONAL, FRACTIONAL_TRUTH, "fractional")],
)
def test_intervals_and_forecasts_hold_the_truth_as_often_as_they_say(creep, truth, kind):
    runs, inside = 24, Counter()
    later = 0.4 + creep.simulate(np.r_[HELD, np.zeros(1000)], RATE_HZ)[-1]
    for seed in range(runs):
        fit = fit_creep(Record.sampled(HELD, answer(creep, seed=seed), RATE_HZ), kind)
        for name, value in truth.items():
            low, high = fit.parameters[name].ci95
            inside[name] += low <= value <= high
        low, high = fit.forecast(20.0).ci95
        inside["forecast"] += low <= later <= high
    # Fewer than this in 24 has a probability below 1e-4 when 95 % are inside.
    assert min(inside[name] for name in [*truth, "forecast"]) >= binom.ppf(1e-4, runs, 0.95)


@pytest.mark.long
@pytest.mark.parametrize(
    ("creep", "verdict"),
    [
        (TWO, "prony"),
        (FRACTIONAL, "fractional"),
        (PowerCreep(1.0, 0.1, 0.3), "fractional"),
        (PronyCreep(1.0), "no creep visible"),
    ],
)
def test_the_verdict_names_the_law_that_made_the_record(creep, verdict):
    fit = fit_creep(Record.sampled(HELD, answer(creep), RATE_HZ))
    assert fit.verdict == verdict
    assert fit.residual_whiteness_p > 1e-3
    assert np.std(fit.residuals[0]) == pytest.approx(NOISE, rel=0.1)


def test_a_record_shorter_than_the_time_constant_leaves_it_open():
    u = HELD[:500]
    fit = fit_creep(
        Record.sampled(u, answer(PronyCreep(1.0, (0.2,), (300.0,)), u), RATE_HZ), "prony"
    )
    assert fit.succeeded
    for name in ("time_constant_1_s", "gain_1"):
        assert np.isnan(fit.parameters[name].value)
        assert fit.parameters[name].ci95 == (-np.inf, np.inf)
    assert "too short" in " ".join(fit.notes)
    assert fit.parameters["instant"].std < 0.01


def test_a_forecast_beyond_a_short_record_is_as_wide_as_the_laws_disagree():
    creep, u = PronyCreep(1.0, (0.2,), (30.0,)), HELD[:500]
    fit = fit_creep(Record.sampled(u, answer(creep, u), RATE_HZ))
    assert fit.verdict == "cannot tell"
    later = 0.4 + creep.simulate(np.r_[u, np.full(3000, u[-1])], RATE_HZ)[-1]
    low, high = fit.forecast(60.0).ci95
    assert low <= later <= high
    near_low, near_high = fit.forecast(1.0).ci95
    assert high - low > 5.0 * (near_high - near_low)


def test_a_step_at_the_first_sample_is_told_and_gives_the_same_creep():
    u = np.ones(1500)
    fit = fit_creep(Record.sampled(u, answer(TWO, u, offset=0.0), RATE_HZ), "prony")
    assert "offset" not in fit.parameters
    assert "Record the time before the step" in " ".join(fit.notes)
    for name, value in TWO_TRUTH.items():
        if name != "offset":
            assert abs(fit.parameters[name].value - value) <= 4.0 * fit.parameters[name].std, name


def test_swinging_after_the_step_can_be_left_out():
    time_s = np.maximum(np.arange(HELD.size) - 100, 0) / RATE_HZ
    swing = -0.5 * np.exp(-8.0 * time_s) * np.cos(30.0 * time_s) * (np.arange(HELD.size) >= 100)
    since = np.maximum(np.arange(HELD.size) - 1600, 0) / RATE_HZ
    swing = swing + 0.5 * np.exp(-8.0 * since) * np.cos(30.0 * since) * (np.arange(3000) >= 1600)
    creep = PronyCreep(1.0, (0.2,), (9.0,))
    fit = fit_creep(Record.sampled(HELD, answer(creep) + swing, RATE_HZ), "prony", leave_out_s=1.5)
    assert abs(fit.parameters["time_constant_1_s"].value - 9.0) <= (
        4.0 * fit.parameters["time_constant_1_s"].std
    )
    assert fit.residual_whiteness_p > 1e-3


def test_the_callers_arrays_are_left_as_they_are():
    u, y = HELD.copy(), answer(TWO)
    kept = y.copy()
    fit_creep(Record.sampled(u, y, RATE_HZ), "prony")
    assert np.array_equal(u, HELD)
    assert np.array_equal(y, kept)


def test_a_forecast_asks_for_a_time_after_the_record():
    fit = fit_creep(Record.sampled(HELD, answer(TWO), RATE_HZ), "prony")
    with pytest.raises(InputError, match="after_s = -1 s"):
        fit.forecast(-1.0)


def test_a_fit_without_a_result_has_no_model():
    fit = fit_creep(Record.sampled(HELD, answer(TWO), RATE_HZ), "prony")
    empty = type(fit)(status="no result: nothing", setting=fit.setting)
    for ask in (lambda: empty.model, lambda: empty.forecast(1.0)):
        with pytest.raises(ResultError, match="no result"):
            ask()


@pytest.mark.parametrize(
    ("u", "y", "options", "match"),
    [
        (np.ones(9), np.arange(9.0), {}, "24 are required"),
        (HELD, HELD[:-1], {}, "must be equally long"),
        (HELD, 0.0 * HELD, {}, "output is 0 throughout"),
        (0.0 * HELD, HELD, {}, "nothing creeps"),
        (HELD, np.where(HELD > 0, np.nan, 0), {}, "is nan"),
        (HELD, HELD, {"model": "burgers"}, "model = burgers"),
        (HELD, HELD, {"model": "prony", "leave_out_s": 1e6}, "leaves 0 samples"),
        (HELD, HELD, {"leave_out_s": -1.0}, "must be 0 s or more"),
    ],
)
def test_bad_input_is_refused_in_one_line(u, y, options, match):
    with pytest.raises(InputError, match=match):
        fit_creep(Record.sampled(u, y, 1.0), **options)


def test_logarithmic_creep_is_called_so_and_its_forecast_holds():
    # Exponentials fit it as well inside the record and level off behind it.
    rng = np.random.default_rng(5)
    u = np.r_[np.zeros(200), np.ones(2800)]
    law = LogarithmicCreep(1.0, 0.1, 0.05)
    y = law.simulate(u, 100.0) + 0.003 * rng.normal(size=u.size)
    fit = fit_creep(Record.sampled(u, y, 100.0))
    assert fit.verdict == "logarithmic"
    later = fit.forecast(100.0)
    truth = float(law.compliance((u.size - 200) / 100.0 + 100.0))
    assert abs(later.value - truth) < 4.0 * later.std


def test_a_drift_that_began_before_the_step_is_no_creep():
    rng = np.random.default_rng(6)
    t = np.arange(3000) / 100.0
    u = np.r_[np.zeros(500), np.ones(2500)]
    y = u + 0.02 * t + 0.003 * rng.normal(size=t.size)
    fit = fit_creep(Record.sampled(u, y, 100.0))
    assert "per second before the input changes" in fit.status


def test_swapped_columns_have_no_result():
    u = np.r_[np.zeros(250), np.ones(3000)]
    y = u * (1.3 - 0.3 * np.exp(-np.arange(3250) / 300.0))
    for noise in (0.0, 0.01):
        moved = y + noise * np.random.default_rng(43).normal(size=y.size)
        assert fit_creep(Record.sampled(u, moved, 50.0)).succeeded
        assert "swapped" in fit_creep(Record.sampled(moved, u, 50.0)).status


def test_an_input_that_is_not_held_is_noted():
    u = np.r_[np.zeros(100), np.ones(400)]
    y = PronyCreep(1.0, (0.2,), (1.0,)).simulate(u, 100.0)
    y = y + 0.002 * np.random.default_rng(1).normal(size=u.size)
    for hold in ("zero", "first"):
        fit = fit_creep(Record.sampled(u, y, 100.0, hold=hold), model="prony")
        assert any("treated as held" in note for note in fit.notes) == (hold == "first")


def test_a_noisy_measured_input_gives_no_result():
    rng = np.random.default_rng(1)
    u = np.r_[np.zeros(100), np.ones(400)]
    y = PronyCreep(1.0, (0.2,), (1.0,)).simulate(u, 100.0) + 0.002 * rng.normal(size=u.size)
    # With 2 % of noise, the interval of `instant` contained the truth in 0 of 6 records.
    fit = fit_creep(Record.sampled(u + 0.02 * rng.normal(size=u.size), y, 100.0), model="prony")
    assert fit.status.startswith("no result: the input is noisy")
    smooth = np.sin(np.linspace(0.0, 6.0, 500))
    answer = PronyCreep(1.0, (0.2,), (1.0,)).simulate(smooth, 100.0)
    assert fit_creep(Record.sampled(smooth, answer + 0.002 * rng.normal(size=500), 100.0),
                     model="prony").succeeded  # fmt: skip


def quantised(seed, step):
    """A creep of 0.02 after a step of 0.1, read by a converter that hides the noise."""
    rng = np.random.default_rng(seed)
    u = np.r_[np.zeros(60), np.ones(1200)]
    creep = PronyCreep(0.1 * rng.uniform(0.98, 1.02), (0.02 * rng.uniform(0.98, 1.02),), (5.0,))
    y = creep.simulate(u, 20.0) + rng.uniform(-0.5, 0.5) * step + 1e-5 * rng.normal(size=u.size)
    return Record.sampled(u, np.round(y / step) * step, 20.0), creep


@pytest.mark.long
@pytest.mark.parametrize("step", [5e-4, 2e-3])
def test_intervals_allow_for_the_steps_of_a_converter(step):
    runs, inside = 8, Counter()
    for seed in range(runs):
        record, creep = quantised(seed, step)
        fit = fit_creep(record, "prony")
        assert any("steps of" in note for note in fit.notes)
        truth = {"instant": creep.instant, "gain_1": creep.gains[0], "time_constant_1_s": 5.0}
        for name, value in truth.items():
            estimate = fit.parameters[name]
            low, high = estimate.ci95
            inside[name] += low <= value <= high
    # Fewer than this in 8 has a probability below 1e-3 when 95 % are inside.
    assert min(inside[name] for name in truth) >= binom.ppf(1e-3, runs, 0.95)


def test_a_creep_that_steps_hide_leaves_its_share_of_the_response_open():
    record, creep = quantised(1, 0.01)  # three levels after the step
    fit = fit_creep(record, "prony")
    assert fit.verdict == "cannot tell"
    low, high = fit.parameters["instant"].ci95
    assert low < creep.instant < high


def test_steps_that_the_noise_hides_change_nothing():
    y = answer(TWO)
    fine, coarse = (
        fit_creep(Record.sampled(HELD, each, RATE_HZ), "prony")
        for each in (y, np.round(y / NOISE) * NOISE)
    )
    assert not any("steps of" in note for note in coarse.notes)
    # Rounding adds 1/12 of the noise's variance, which is 4 % of the standard deviations.
    assert coarse.parameters["instant"].std < 1.2 * fine.parameters["instant"].std
