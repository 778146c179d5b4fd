"""Hysteresis fits: truth recovered with correct intervals, the right verdict, loops of the twin."""

from collections import Counter

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom

from haselab.base import InputError, ResultError
from haselab.identify import LoopRecord, fit_hysteresis
from haselab.identify.hysteresis.loops import band_widths
from haselab.models import BoucWen, DeadZones, PrandtlIshlinskii
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, native_bench
from haselab.signals import triangle

NOISE = 0.005
PLAYS = PrandtlIshlinskii(1.0, (0.15, 0.5), (0.4, 0.3), 0.2)
PLAYS_TRUTH = {"gain": 1.0, "offset": 0.2, "threshold_1": 0.15, "threshold_2": 0.5,
               "weight_1": 0.4, "weight_2": 0.3}  # fmt: skip
BOUC_WEN = BoucWen(1.0, -0.1, 3.0, 0.8)
BOUC_WEN_TRUTH = {"gain": 1.0, "offset": 0.0, "weight": -0.1, "sharpness": 3.0, "sigma": 0.8}


def drive(frequency_hz=0.25):
    """Three cycles of different height: the smaller loops identify the thresholds."""
    cycle = triangle(0.0, 2.0, frequency_hz, 1, 100.0)
    return np.concatenate([cycle, 0.6 * cycle, 0.8 * cycle])


def record(model, frequency_hz=0.25, seed=0, noise=NOISE):
    u = drive(frequency_hz)
    y = model.simulate(u, 100.0, u[0])
    return LoopRecord(u, y + noise * np.random.default_rng(seed).normal(size=y.size), 100.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("model", "truth", "kind"),
    [(PLAYS, PLAYS_TRUTH, "prandtl-ishlinskii"), (BOUC_WEN, BOUC_WEN_TRUTH, "bouc-wen")],
)
def test_intervals_hold_the_truth_as_often_as_they_say(model, truth, kind):
    runs, inside = 24, Counter()
    for seed in range(runs):
        fit = fit_hysteresis([record(model, seed=seed)], kind)
        assert fit.verdict == kind
        for name, value in truth.items():
            low, high = fit.parameters[name].ci95
            inside[name] += low <= value <= high
    # Fewer than this in 24 has a probability below 1e-4 when 95 % are inside.
    assert min(inside.values()) >= binom.ppf(1e-4, runs, 0.95)


@pytest.mark.long
@pytest.mark.parametrize("model", [PLAYS, BOUC_WEN, PrandtlIshlinskii(1.0, (0.3,), (-0.4,))])
def test_the_verdict_names_the_model_that_made_the_loops(model):
    kind = "bouc-wen" if isinstance(model, BoucWen) else "prandtl-ishlinskii"
    fit = fit_hysteresis([record(model)])
    assert (fit.verdict, fit.kind) == (kind, kind)
    assert fit.residual_whiteness_p > 1e-3
    # What is left is noise: 1 - noise / spread, at most a few parts in a thousand from it.
    expected = 100.0 * (1.0 - NOISE / np.std(record(model).y))
    assert abs(fit.fit_percent - expected) < 0.5
    assert abs(fit.validation_fit_percent - expected) < 0.5


@pytest.mark.long
def test_a_curve_within_the_noise_shows_no_hysteresis():
    saturating = PrandtlIshlinskii(1.0, dead_zones=DeadZones((0.8,), (-0.5,)))
    fit = fit_hysteresis([record(saturating)])
    assert fit.verdict == "no hysteresis visible"
    assert abs(fit.width.value) <= 4.0 * fit.width.std
    assert fit.model.obstacle() == ""


@pytest.mark.long
def test_records_at_several_rates_identify_the_rate_dependence():
    truth = PrandtlIshlinskii(1.0, (0.15, 0.5), (0.4, 0.3), 0.2, 0.1, 0.04)
    fit = fit_hysteresis([record(truth, f, seed=k) for k, f in enumerate((0.1, 0.5, 2.0))])
    assert fit.verdict == "prandtl-ishlinskii"
    estimate = fit.parameters["rate_dependence_s"]
    assert abs(estimate.value - 0.1) <= 4.0 * estimate.std
    assert estimate.std < 0.002
    exact = band_widths([record(truth, f, noise=0.0) for f in (0.1, 0.5, 2.0)])
    for got, expected in zip(fit.cycles, exact, strict=True):
        assert abs(got.width.value - expected.width.value) <= 4.0 * got.width.std
    assert len({round(cycle.width.value, 2) for cycle in exact}) > 5


@pytest.mark.long
def test_one_rate_leaves_the_rate_dependence_open():
    u = np.tile(triangle(0.0, 2.0, 0.25, 1, 100.0), 3)
    y = PLAYS.simulate(u) + NOISE * np.random.default_rng(3).normal(size=u.size)
    fit = fit_hysteresis([LoopRecord(u, y, 100.0)])
    estimate = fit.parameters["rate_dependence_s"]
    assert np.isnan(estimate.value)
    assert estimate.ci95 == (-np.inf, np.inf)
    assert "one rate of the input" in " ".join(fit.notes)


@pytest.mark.long
def test_saturating_and_falling_loops_are_fitted_with_their_dead_zones():
    u = drive()
    for sign in (1.0, -1.0):
        y = sign * np.tanh(PLAYS.simulate(u) - 1.5)
        y = y + 0.002 * np.random.default_rng(4).normal(size=y.size)
        fit = fit_hysteresis([LoopRecord(u, y, 100.0)], "prandtl-ishlinskii")
        assert fit.model.obstacle() == ""
        # Straight segments of a quarter unit miss a bend of 0.77 by at most 0.77 / 8 / 16.
        assert np.abs(fit.residuals[0][fit.residuals[0].size // 3 :]).max() < 0.012 + 5 * 0.002
        assert fit.width.value > 0.0  # the output lags, whatever the sign of the gain


def test_the_width_is_that_of_the_operator():
    """A full loop of one play: its branches are 2 r w apart, but for the ends."""
    u = np.tile(triangle(-1.0, 1.0, 0.25, 1, 100.0), 3)
    y = PrandtlIshlinskii(1.0, (0.1,), (0.5,)).simulate(u, 100.0, u[0])
    y = y + 1e-4 * np.random.default_rng(5).normal(size=y.size)
    widths = band_widths([LoopRecord(u, y, 100.0)])
    assert len(widths) == 3
    # Over the first 2 r after each reversal the width grows from 0: a tenth of the span, by half.
    assert widths[2].width.value == pytest.approx(0.1 * (1.0 - 0.1), rel=0.02)


@pytest.mark.long
def test_the_inverse_narrows_the_loop_that_the_twin_really_makes():
    """Played on the twin, not predicted: slow triangles at 0.05 Hz, hz reading."""
    config = twin_of_reading("hz")
    load_n = config.load.mass_kg * GRAVITY_M_S2

    def play(drive_v):
        bench = native_bench(config, 1, noise=False)
        bench.move(np.zeros(1), 600_000, load_n, np.empty(600_000))
        lengths_m = np.empty(drive_v.size * 200)
        bench.move(np.ascontiguousarray(drive_v), 200, load_n, lengths_m)
        return lengths_m[199::200]

    drive_v = triangle(0.0, 2.0, 0.05, 3, 50.0)
    length_m = play(drive_v)
    strain = length_m / length_m[0] - 1.0
    strain = strain + 2e-5 * np.random.default_rng(6).normal(size=strain.size)
    fit = fit_hysteresis([LoopRecord(drive_v, strain, 50.0, 20.0)])
    before = fit.relative_width.value
    low, high = np.quantile(strain[1000:], [0.05, 0.95])
    wanted = triangle(low, high, 0.05, 3, 50.0)
    command_v = fit.model.invert(wanted, 50.0)
    assert 0.0 <= command_v.min() < command_v.max() <= 2.0
    made = play(command_v) / length_m[0] - 1.0
    after = band_widths([LoopRecord(wanted, made, 50.0, 20.0)])
    after = np.mean([cycle.relative_width.value for cycle in after])
    assert before > 0.08
    assert abs(after) < before / 5.0


@pytest.mark.long
def test_an_output_that_does_not_follow_gives_no_result():
    y = np.random.default_rng(7).normal(size=drive().size)
    fit = fit_hysteresis([LoopRecord(drive(), y, 100.0)])
    assert fit.status.startswith("no result: the output does not follow")
    with pytest.raises(ResultError, match="no result"):
        _ = fit.model


@pytest.mark.long
@pytest.mark.parametrize(
    "u",
    [
        np.where(np.arange(200) // 10 % 2, 1.0, 0.0),  # two levels
        np.linspace(0.0, 1.0, 40),  # no loop
        np.random.default_rng(8).normal(size=100),  # no edges
        1e-6 * triangle(0.0, 2.0, 1.0, 3, 12.0),  # few samples, small numbers
    ],
)
@pytest.mark.parametrize("model", ["prandtl-ishlinskii", "bouc-wen"])
def test_odd_records_without_noise_have_an_answer_too(u, model):
    fit = fit_hysteresis([LoopRecord(u, 1e3 * np.round(4.0 * u / np.ptp(u)), 50.0)], model)
    assert fit.succeeded
    assert np.isfinite(fit.fit_percent)
    assert fit.cycles or "no whole cycles" in " ".join(fit.notes)


def test_the_callers_arrays_are_left_as_they_are():
    u, y = drive(), PLAYS.simulate(drive())
    kept = u.copy(), y.copy()
    fit_hysteresis([LoopRecord(u, y, 100.0)], "prandtl-ishlinskii", operators=2)
    assert np.array_equal(u, kept[0])
    assert np.array_equal(y, kept[1])


GOOD = drive()


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: LoopRecord(GOOD[:10], GOOD[:10], 1.0), "at least 24 are needed"),
        (lambda: LoopRecord(GOOD, GOOD[:-1], 1.0), "must be equally long"),
        (lambda: LoopRecord(GOOD, 0.0 * GOOD, 1.0), "y is 0 throughout"),
        (lambda: LoopRecord(np.full(30, 2.0), GOOD[:30], 1.0), "u is 2 throughout"),
        (lambda: LoopRecord(np.where(GOOD > 1, np.nan, GOOD), GOOD, 1.0), "is nan"),
        (lambda: LoopRecord(GOOD, GOOD, 0.0), "rate_hz = 0 Hz"),
        (lambda: LoopRecord(GOOD, GOOD, 1.0, 1e9), "counted_from_s"),
        (lambda: fit_hysteresis([]), "records is empty"),
        (lambda: fit_hysteresis([LoopRecord(GOOD, GOOD, 1.0)], "preisach"), "model = preisach"),
        (lambda: fit_hysteresis([LoopRecord(GOOD, GOOD, 1.0)], operators=0), "operators = 0"),
    ],
)
def test_bad_input_is_refused_in_one_line(make, match):
    with pytest.raises(InputError, match=match):
        make()


def test_a_butterfly_is_fitted_against_the_square_of_the_drive():
    # Strain of a dielectric actuator: V^2 through a play, under a bipolar triangle.
    rng = np.random.default_rng(11)
    rise = np.linspace(-1.0, 1.0, 200)
    u = np.tile(np.concatenate([rise, rise[::-1]]), 4) * 5000.0
    y = PrandtlIshlinskii(1.0, (0.1,), (0.5,)).simulate((u / 5000.0) ** 2)
    y = y + 0.004 * rng.normal(size=u.size)
    fit = fit_hysteresis([LoopRecord(u, y, 100.0)])
    assert fit.status == "ok"
    assert fit.drive == "u squared"
    # 0.4 % of noise on a span of 1.5 with a standard deviation of 0.45.
    assert fit.fit_percent > 98.5
    assert any("butterfly" in note for note in fit.notes)


def test_a_square_wave_of_both_signs_says_nothing_about_its_square():
    u = np.where(np.arange(400) % 40 < 20, 1.0, -1.0)
    y = 0.3 * u + 0.01 * np.random.default_rng(3).normal(size=400)
    fit = fit_hysteresis([LoopRecord(u, y, 100.0)], "prandtl-ishlinskii", operators=2)
    assert fit.drive == "u"


@pytest.mark.long
def test_a_loop_smaller_than_its_model_is_no_hysteresis():
    """A straight line with noise on its input, which bends the ends."""
    rng = np.random.default_rng(3)
    drive = np.concatenate([np.linspace(0.0, 1.0, 200), np.linspace(1.0, 0.0, 200)] * 4)
    record = LoopRecord(drive + 0.015 * rng.normal(size=drive.size), drive, 100.0)
    assert fit_hysteresis([record]).verdict not in ("bouc-wen", "prandtl-ishlinskii")


TRIANGLES = np.concatenate([np.interp(np.arange(400) / 400, [0, 0.5, 1], [0, a, 0]) for a in
                            (2.0, 1.0, 1.5, 2.0)])  # fmt: skip


def test_a_relative_width_is_free_of_noise_and_spikes_and_keeps_its_sign():
    clean = PrandtlIshlinskii(1.0, (0.1, 0.4), (0.5, 0.4)).simulate(TRIANGLES)
    rng = np.random.default_rng(41)
    exact = fit_hysteresis([LoopRecord(TRIANGLES, clean, 100.0)]).relative_width.value
    spiked = clean + 1e-3 * rng.normal(size=clean.size)
    spiked[::97] += 0.5
    noisy = clean + 0.1 * rng.normal(size=clean.size)
    for y in (spiked, noisy, -clean + 1e-3 * rng.normal(size=clean.size)):
        found = fit_hysteresis([LoopRecord(TRIANGLES, y, 100.0)]).relative_width
        assert abs(found.value - exact) < 4.0 * found.std + 0.01 * exact


@pytest.mark.long
@pytest.mark.parametrize("tau_s", [0.05, 0.3])
def test_a_linear_lag_is_named_and_hysteresis_is_not_one(tau_s):
    share = 1.0 - np.exp(-0.01 / tau_s)
    lagging = lfilter([share], [1.0, share - 1.0], TRIANGLES)
    noise = 1e-3 * np.random.default_rng(42).normal(size=lagging.size)
    fit = fit_hysteresis([LoopRecord(TRIANGLES, lagging + noise, 100.0)])
    assert fit.verdict == "linear lag"
    assert any("linear first-order lag" in note for note in fit.notes)
    clean = PrandtlIshlinskii(1.0, (0.1, 0.4), (0.5, 0.4)).simulate(TRIANGLES)
    assert fit_hysteresis([LoopRecord(TRIANGLES, clean + noise, 100.0)]).verdict != "linear lag"


@pytest.mark.parametrize("digits", [2, 3, 5])
def test_the_last_digit_of_an_output_decides_no_structure(digits):
    # Rounding errors repeat with the loop, so they looked like evidence for a further operator.
    exact = record(PLAYS, noise=0.0)
    rounded = LoopRecord(exact.u, np.round(exact.y, digits), exact.rate_hz)
    fit = fit_hysteresis([rounded], "prandtl-ishlinskii")
    assert sum(name.startswith("threshold") for name in fit.parameters) == 2
    assert any("rounding of the output" in note for note in fit.notes)
    assert not any("coloured" in note for note in fit.notes)
    # An error of a digit at each end of a play moves its threshold by no more than this.
    assert fit.parameters["threshold_1"].value == pytest.approx(0.15, abs=10.0**-digits)


def test_an_approximation_of_loops_of_another_form_is_said_to_be_one():
    """Sixty operators: the fitted ones are no property of what made the loops."""
    u = np.concatenate([high * triangle(0.0, 1.0, 0.25, 1, 50.0) for high in (2.0, 2.0, 1.0)])
    thresholds = np.linspace(0.02, 1.0, 60)
    many = PrandtlIshlinskii(0.3, tuple(thresholds), tuple(0.02 * np.exp(-thresholds)))
    few = PrandtlIshlinskii(0.6, (0.2, 0.5), (0.5, 0.3))
    noise = 1e-3 * np.random.default_rng(1).normal(size=u.size)
    for made_by, is_other in ((many, True), (few, False)):
        y = made_by.simulate(u) + (0.0 if is_other else noise)
        notes = fit_hysteresis([LoopRecord(u, y, 50.0)], "prandtl-ishlinskii").notes
        assert any("only approximate" in note for note in notes) == is_other
