"""Leakage is removed and intervals are valid; segment averages are refused for a sweep."""

import numpy as np
import pytest
from scipy.signal import csd, lfilter, max_len_seq, welch

from haselab.base import InputError
from haselab.identify.frequency.response import estimate_frequency_response
from haselab.identify.record import Record
from haselab.models import Plant, SlowMode

OMEGA = float(np.sqrt(26.14))
PLANT = Plant(0.5, OMEGA, 0.93 / (2 * OMEGA))
TIME_S = np.arange(4000) / 400.0
SWEEP = np.sin(2 * np.pi * (0.1 * TIME_S + 0.5 * 0.99 * TIME_S**2))
CLEAN = PLANT.simulate(SWEEP, 400.0, TIME_S)
# |error|^2/std^2 of a complex normal is exponential: 95 % below -ln 0.05 = 1.73^2.
INSIDE = float(np.sqrt(-np.log(0.05)))


def estimate(u, y, rate_hz, *, hold="zero", **how):
    """The response from vectors, or from lists with one vector for each record."""
    pairs = zip(u, y, strict=True) if np.ndim(u[0]) else [(u, y)]
    records = [Record.sampled(a, b, rate_hz, hold=hold) for a, b in pairs]
    return estimate_frequency_response(records, **how)


def truth(response):
    return PLANT.frequency_response(2 * np.pi * response.frequency_hz)


def multisine(rng, lines=100, size=4000):
    """Lines of 0.1 Hz at 400 Hz with random phases."""
    phase_rad = rng.uniform(0.0, 2.0 * np.pi, lines)
    turn = 2.0 * np.pi * np.outer(np.arange(1, lines + 1), np.arange(size)) / size
    return np.cos(turn + phase_rad[:, None]).sum(axis=0)


def calibration(runs, noisy_of, **how):
    """Errors over standard deviations on the lines that all runs give. Shape `(runs, K)`."""
    found = [noisy_of(run, how) for run in range(runs)]
    common_hz = set.intersection(*(set(r.frequency_hz.round(6)) for r in found))
    rows = []
    for response in found:
        kept = np.isin(response.frequency_hz.round(6), list(common_hz))
        rows.append(((response.response - truth(response)) / response.std)[kept])
    return np.sort(np.array(list(common_hz))), np.array(rows)


def test_one_sweep_without_noise_gives_the_plant():
    response = estimate(SWEEP, CLEAN, 400.0)
    swept = response.frequency_hz <= 9.0
    error = np.abs(response.response / truth(response) - 1)[swept]
    # What is left is aliasing of the held input's images at 400 Hz: (0.81/400)^2 of the gain.
    assert error.max() <= 5e-6


@pytest.mark.long
@pytest.mark.parametrize("level_db", [20, 30, 40])
def test_intervals_hold_on_all_lines_of_a_sweep_and_no_line_is_biased(level_db):
    def one(run, how):
        noise = np.random.default_rng([5, level_db, run]).normal(size=4000)
        return estimate(SWEEP, CLEAN + noise * CLEAN.std() / 10 ** (level_db / 20), 400.0, **how)

    runs = 40
    at_hz, ratio = calibration(runs, one)
    near = (at_hz > 0.2) & (at_hz < 1.5)
    inside = np.abs(ratio) <= INSIDE
    # 25 spare complex rows: F(2, 50) holds 94.1 % where the normal holds 95; lines share windows
    # of 33, so 100 lines are about 10 independent ones: four binomial spreads of 400 cases.
    assert inside.mean() >= 0.941 - 4 * np.sqrt(0.059 * 0.941 / (10 * runs))
    assert inside[:, near].mean() <= 0.995
    # The mean of 40 complex errors of one deviation spreads by sqrt(1/40).
    assert np.abs(ratio.mean(axis=0))[near].max() < 0.3 + 2.5 / np.sqrt(runs)


def test_print_shows_band_peak_and_coherence_on_one_line():
    found = estimate(SWEEP, CLEAN, 400.0)
    said = repr(found)
    assert said.startswith(f"FrequencyResponse: ok, {found.frequency_hz.size} lines from ")
    peak_hz = float(said.partition(" at ")[2].partition(" Hz")[0])
    # Of a resonance of damping z: omega sqrt(1 - 2 z^2); a line every 0.1 Hz.
    wanted_hz = OMEGA * np.sqrt(1.0 - 2.0 * PLANT.damping_ratio**2) / (2.0 * np.pi)
    assert abs(peak_hz - wanted_hz) <= 0.05 + 1e-3 and "\n" not in said


@pytest.mark.long
def test_several_sweeps_are_pooled_whatever_their_lengths():
    shorter = slice(0, 2800)

    def one(run, how):
        rng = np.random.default_rng([6, run])
        noisy = CLEAN + rng.normal(size=4000) * CLEAN.std() / np.sqrt(1e3)
        again = CLEAN + rng.normal(size=4000) * CLEAN.std() / np.sqrt(1e3)
        pair = [SWEEP, SWEEP[shorter]], [noisy, again[shorter]]
        return estimate(*pair, 400.0, **how)

    runs = 25
    at_hz, ratio = calibration(runs, one)
    inside = (np.abs(ratio) <= INSIDE)[:, at_hz < 6.0]
    assert inside.mean() >= 0.945 - 4 * np.sqrt(0.055 * 0.945 / (6 * runs))
    both = one(0, {})
    alone = estimate(SWEEP, CLEAN + 0 * SWEEP, 400.0)
    assert np.array_equal(both.frequency_hz[:80], alone.frequency_hz[:80])


def test_the_polynomial_form_and_welch_fail_where_the_rational_one_holds():
    near = (0.5, 1.2)

    def worst(method):
        response = estimate(SWEEP, CLEAN, 400.0, method=method)
        inside = (response.frequency_hz > near[0]) & (response.frequency_hz < near[1])
        return float(np.abs(response.response / truth(response) - 1)[inside].max())

    assert worst("rational") < 1e-5 < 0.3 < min(worst("polynomial"), worst("h1"))


DRIVES = {
    "noise": lambda rng: rng.normal(size=4000),
    "PRBS": lambda rng: np.repeat(2.0 * max_len_seq(10)[0] - 1.0, 4)[:4000],
    "multisine": multisine,
    "sparse multisine": lambda rng: multisine(rng, 7),
    "chirp": lambda rng: SWEEP,
    "chirp downwards": lambda rng: SWEEP[::-1],
    "step": lambda rng: np.repeat([0.0, 1.0], 2000),
}


@pytest.mark.parametrize("segment_s", [None, 2.5, 5.0])
@pytest.mark.parametrize("drive", DRIVES)
def test_the_warning_comes_for_a_sweep_or_step_and_for_nothing_else(drive, segment_s):
    u = DRIVES[drive](np.random.default_rng(1))
    response = estimate(
        u, PLANT.simulate(u, 400.0, TIME_S), 400.0, method="h1", segment_s=segment_s
    )
    warned = any("like a single sweep" in note for note in response.notes)
    assert warned == (drive.startswith("chirp") or drive == "step")


def test_h1_and_its_coherence_are_those_of_scipy():
    rng = np.random.default_rng(2)
    u, y = rng.normal(size=4000), rng.normal(size=4000)
    response = estimate(u, y, 400.0, method="h1", segment_s=1.25, hold="band-limited")
    at_hz, cross = csd(u, y, 400.0, nperseg=500)
    left, right = welch(u, 400.0, nperseg=500)[1], welch(y, 400.0, nperseg=500)[1]
    same = np.isin(at_hz.round(6), response.frequency_hz.round(6))
    assert np.allclose(response.response, (cross / left)[same], rtol=1e-9)
    assert np.allclose(response.coherence, (np.abs(cross) ** 2 / left / right)[same], rtol=1e-9)


@pytest.mark.parametrize(("method", "on"), [("h1", "y"), ("h2", "u"), ("hv", "both")])
def test_each_average_is_right_for_noise_on_its_side(method, on):
    # A gain of 2 without dynamics, so that only the noise matters.
    rng = np.random.default_rng(3)
    inside, gains = [], []
    for _ in range(30):
        u = rng.normal(size=8000)
        y = 2.0 * u + (on != "u") * 2.0 * rng.normal(size=8000)
        seen = u + (on != "y") * rng.normal(size=8000)
        response = estimate(seen, y, 100.0, method=method, segment_s=5.0,
                                               hold="band-limited")  # fmt: skip
        gains.append(np.abs(response.response).mean())
        inside.append(np.abs(response.response - 2.0) <= INSIDE * response.std)
        assert 0.2 < response.coherence.mean() < 0.7
    if method != "hv":  # the intervals of hv are those of one-sided noise
        assert np.mean(inside) >= 0.90
    # 31 half-overlapping segments leave H1 unbiased and the others within 1/(2 * 29) squared.
    assert np.mean(gains) == pytest.approx(2.0, rel=0.06)


def test_one_segment_says_that_it_has_no_spread():
    rng = np.random.default_rng(4)
    u = rng.normal(size=400)
    response = estimate(u, u, 100.0, method="h1", segment_s=4.0)
    assert np.isinf(response.std).all()
    assert "no standard deviation" in response.notes[0]


@pytest.mark.long
@pytest.mark.parametrize("periods", [2, 5])
def test_periods_are_averaged_without_waiting_for_the_transient(periods):
    drive = np.tile(multisine(np.random.default_rng(5)), periods)
    clean = PLANT.simulate(drive, 400.0, np.arange(drive.size) / 400.0)

    def one(run, how):
        noise = np.random.default_rng([7, run]).normal(size=drive.size) * clean.std() / np.sqrt(1e3)
        return estimate(drive, clean + noise, 400.0, method="periodic",
                                           period_s=10.0)  # fmt: skip

    runs = 25
    _, ratio = calibration(runs, one)
    # Lines of a periodic drive are independent but for the transient: 100 lines.
    inside = np.abs(ratio) <= INSIDE
    assert inside.mean() == pytest.approx(0.941, abs=5 * np.sqrt(0.059 * 0.941 / (20 * runs)))
    assert np.abs(ratio.mean(axis=0)).max() < 4.0 / np.sqrt(runs)


def test_several_realisations_show_nonlinear_distortion_and_one_drive_does_not():
    rng = np.random.default_rng(6)
    drives = [np.tile(multisine(rng), 2) for _ in range(6)]
    drives = [drive / drive.std() for drive in drives]
    time_s = np.arange(8000) / 400.0

    def answer(cubic, inputs):
        outputs = [PLANT.simulate(u + cubic * u**3, 400.0, time_s) for u in inputs]
        outputs = [y + 1e-4 * rng.normal(size=y.size) for y in outputs]
        return estimate(
            inputs, outputs, 400.0, method="periodic", period_s=10.0
        )  # fmt: skip

    linear, nonlinear = answer(0.0, drives), answer(0.05, drives)
    assert not any("Nonlinear" in note for note in linear.notes)
    assert any("Nonlinear distortion" in note for note in nonlinear.notes)
    share = np.median(nonlinear.distortion_std / np.abs(nonlinear.response))
    assert 5.0 * np.median(linear.distortion_std / np.abs(linear.response)) < share
    # The best linear gain of u + c u^3 under a Gaussian drive of unit variance is 1 + 3 c.
    gain = np.abs(nonlinear.response / linear.response)
    assert gain.mean() == pytest.approx(1.15, abs=4 * share / np.sqrt(6 * gain.size))
    inside = np.abs(nonlinear.response - 1.15 * truth(nonlinear)) <= INSIDE * nonlinear.std
    assert inside.mean() >= 0.85
    same = answer(0.05, drives[:1] * 3)
    assert np.isnan(same.distortion_std).all()
    assert any("same drive" in note for note in same.notes)


def test_a_measured_input_with_noise_of_its_own_keeps_the_intervals_of_periods():
    drive = np.tile(multisine(np.random.default_rng(8)), 4)
    y = 2.0 * drive
    inside = []
    for run in range(20):
        rng = np.random.default_rng([9, run])
        noisy = [x + rng.normal(size=x.size) for x in (drive, y)]
        response = estimate(*noisy, 400.0, method="periodic", period_s=10.0,
                                               hold="band-limited")  # fmt: skip
        driven = response.frequency_hz < 10.05
        inside += list(np.abs(response.response - 2.0)[driven] <= INSIDE * response.std[driven])
    assert np.mean(inside) == pytest.approx(0.945, abs=5 * np.sqrt(0.05 / 400))


def test_the_charts_agree_with_the_response():
    noise = 0.01 * np.random.default_rng(10).normal(size=4000)
    response = estimate(SWEEP, CLEAN + noise, 400.0)
    bode, nyquist, nichols = response.bode(), response.nyquist(), response.nichols()
    turned = bode.magnitude * np.exp(1j * bode.phase_rad)
    assert np.allclose(turned, response.response)
    assert np.allclose(nyquist.real + 1j * nyquist.imaginary, response.response)
    assert np.allclose(10 ** (nichols.magnitude_db / 20), bode.magnitude)
    assert np.allclose(np.radians(nichols.phase_deg), bode.phase_rad)
    assert np.abs(np.diff(bode.phase_rad)).max() <= np.pi
    width = (bode.magnitude_high - bode.magnitude_low)[:10]
    assert np.allclose(width, 2 * 1.96 * response.magnitude_std[:10], rtol=1e-3)
    assert np.allclose(nyquist.circle, INSIDE * response.std)
    assert (nichols.magnitude_low_db <= nichols.magnitude_db).all()
    assert ((bode.phase_high_rad - bode.phase_low_rad) <= 2 * np.pi + 1e-12).all()


def test_the_figure_has_the_response_the_fit_and_their_bands():
    response = estimate(SWEEP, CLEAN, 400.0)
    drawn = response.chart(0.5 * response.response)
    positive = response.frequency_hz > 0.0
    magnitude, phase, coherence = drawn.panels
    assert np.allclose(magnitude.curves[0].y, np.abs(response.response)[positive])
    assert np.allclose(magnitude.curves[0].std, response.magnitude_std[positive])
    assert np.allclose(magnitude.curves[1].y, 0.5 * magnitude.curves[0].y)
    assert np.allclose(phase.curves[0].y, phase.curves[1].y)
    assert np.allclose(coherence.curves[0].y, response.coherence[positive])
    axes = response.plot().axes
    assert [each.get_ylabel() for each in axes] == ["Magnitude", "Phase (°)", "Coherence"]
    assert axes[2].get_ylim() == (0.0, 1.05)  # all of its range, also where it is near 1


def test_a_line_far_above_the_band_is_a_band_of_its_own_and_no_curve_leads_to_it():
    u = SWEEP + np.sin(2 * np.pi * 150.0 * TIME_S)
    found = estimate(u, PLANT.simulate(u, 400.0, TIME_S), 400.0)
    assert len(found.bands) == 2 and found.bands[1].start == found.frequency_hz.size - 1
    (note,) = [each for each in found.notes if "separate bands" in each]
    top_hz = found.frequency_hz[-2]
    assert 9.0 < top_hz < 20.0 and f" to {top_hz:.4g}, 150 Hz. Between them" in note
    for panel in found.chart(found.response).panels:
        for curve in panel.curves:
            assert np.flatnonzero(np.isnan(curve.y)).tolist() == [curve.y.size - 2]
    magnitude, *_ = found.plot().axes
    alone = [line for line in magnitude.lines if line.get_marker() == "."]
    assert [line.get_xdata().tolist() for line in alone] == [[150.0]]


@pytest.mark.parametrize(
    "lines", [np.arange(1, 80, 2), np.unique(np.geomspace(1, 1000, 30).round().astype(int))]
)
def test_sparse_lines_without_a_gap_are_one_band(lines):
    """Odd lines alone, whose first step is an octave and a half, and lines a tenth of a decade."""
    turn = 2.0 * np.pi * np.outer(lines, np.arange(4000)) / 4000
    u = np.cos(turn + np.arange(lines.size)[:, None] ** 2).sum(axis=0)
    found = estimate(u, PLANT.simulate(u, 400.0, TIME_S), 400.0)
    assert len(found.bands) == 1 and not any("separate" in note for note in found.notes)
    assert all(np.isfinite(panel.curves[0].y).all() for panel in found.chart().panels)


@pytest.mark.long
def test_the_hold_of_the_input_is_taken_out_or_left_in():
    u = np.random.default_rng(3).normal(size=2000)
    held = estimate(u, u, 100.0)
    raw = estimate(u, u, 100.0, hold="band-limited")
    assert np.allclose(raw.response, 1.0)
    expected = 1.0 / np.sinc(held.frequency_hz / 100.0)
    assert np.abs(np.abs(held.response) / expected - 1).max() < 1e-3


def test_the_arrays_of_the_caller_stay_as_they_are():
    u, y = SWEEP.copy(), CLEAN.copy()
    for how in ({}, {"method": "h1"}, {"method": "periodic", "period_s": 10.0}):
        arrays = (np.tile(u, 2), np.tile(y, 2))
        kept = [x.copy() for x in arrays]
        estimate(*arrays, 400.0, **how)
        assert all(np.array_equal(a, b) for a, b in zip(arrays, kept, strict=True))


RAMP = np.arange(100.0)


@pytest.mark.parametrize(
    ("arguments", "how", "match"),
    [
        ((RAMP, RAMP[:99], 1.0), {}, "must be equally long"),
        ((np.ones(100), RAMP, 1.0), {}, "excites nothing"),
        ((RAMP, RAMP, 0.0), {}, "rate_hz = 0 Hz"),
        ((RAMP[:50], RAMP[:50], 1.0), {}, "A record has 50 samples; it must have 64 or more"),
        ((np.where(RAMP == 3, np.nan, RAMP), RAMP, 1.0), {}, "nan at index 3"),
        ((RAMP, RAMP, 1.0), {"hold": "first"}, "have the hold first; it must be zero for all"),
        ((RAMP, RAMP, 1.0), {"method": "etfe"}, "method = etfe; it must be one of rational"),
        ((RAMP, RAMP, 1.0), {"method": "periodic"}, "the method periodic requires a period"),
        ((RAMP, RAMP, 1.0), {"period_s": 2.0}, "and the other methods take none"),
        ((RAMP, RAMP, 1.0), {"segment_s": 2.0}, "only h1, h2 and hv take"),
        ((RAMP, RAMP, 1.0), {"method": "h1", "segment_s": 200.0}, "must be 16 to 100"),
        ((RAMP, RAMP, 1.0), {"method": "periodic", "period_s": 10.5}, "whole number of 8"),
        ((RAMP, RAMP, 1.0), {"method": "periodic", "period_s": 60.0}, "1.67 periods of 60 s"),
        ((RAMP, RAMP, 1.0), {"method": "periodic", "period_s": 20.0}, "does not repeat every 20 s"),
    ],
)
def test_bad_records_and_options_are_refused(arguments, how, match):
    with pytest.raises(InputError, match=match):
        estimate(*arguments, **how)


def test_one_record_is_as_good_as_a_list_of_one():
    record = Record.sampled(SWEEP, CLEAN, 400.0)
    one, several = estimate_frequency_response(record), estimate_frequency_response([record])
    assert np.array_equal(one.response, several.response)


def test_records_of_several_rates_or_other_times_are_refused():
    slow, fast = (Record.sampled(RAMP, RAMP, rate_hz) for rate_hz in (1.0, 2.0))
    with pytest.raises(InputError, match=r"rates of 1 to 2 Hz, but one estimate needs one rate"):
        estimate_frequency_response([slow, fast])
    with pytest.raises(InputError, match=r"100 inputs at 1 Hz and 100 outputs at other times"):
        estimate_frequency_response(Record(RAMP, 1.0, RAMP, RAMP + 0.3))


FAST = Plant(0.02, 32.0, 0.12, 0.012)
FAST_S = np.arange(4000) / 200.0
FAST_DRIVES = {
    "chirp": np.sin(2 * np.pi * (0.1 * FAST_S + 0.5 * 14.9 / 20.0 * FAST_S**2)),
    "PRBS": np.repeat(2.0 * max_len_seq(8)[0] - 1.0, 20)[:4000],
    "multisine": multisine(np.random.default_rng(11), 200),
}


@pytest.mark.parametrize("drive", FAST_DRIVES)
@pytest.mark.parametrize("more", [{}, {"method": "h1", "segment_s": 5.0}])
def test_a_clipped_output_has_no_result_and_an_unclipped_one_has(drive, more):
    u = FAST_DRIVES[drive]
    y = FAST.simulate(u, 200.0, FAST_S) + 1.0  # an offset as of a sensor
    half = 0.5 * float(np.abs(y - 1.0).max())
    noise = 0.02 * y.std() * np.random.default_rng(12).normal(size=y.size)
    for free in (y, y + half * np.linspace(-1.0, 1.0, y.size)):
        assert estimate(u, free + noise, 200.0, **more).status == "ok"
    response = estimate(u, np.minimum(y, 1.0 + half) + noise, 200.0, **more)
    assert not response.succeeded
    # The median of rows whose noise is normal: known to a tenth of its deviation with 100 of them.
    limit = float(response.status.split("stays at ")[1].split()[0])
    assert abs(limit - 1.0 - half) < 0.5 * float(noise.std()) + 1e-3


@pytest.mark.parametrize("level", [0.85, 0.9, 0.95])
def test_a_clipped_output_is_named_with_coloured_noise_too(level):
    """AR(1) noise of 3 % with the coefficient 0.95: its second differences are small."""
    rng = np.random.default_rng(3)
    y = FAST.simulate(FAST_DRIVES["multisine"], 200.0, FAST_S)
    white = rng.normal(size=y.size)
    noise = lfilter([1.0], [1.0, -0.95], white)
    noise *= 0.03 * y.std() / noise.std()
    clipped = np.minimum(y, np.quantile(y, level)) + noise
    assert "clipped" in estimate(FAST_DRIVES["multisine"], clipped, 200.0).status
    assert estimate(FAST_DRIVES["multisine"], y + noise, 200.0).status == "ok"


@pytest.mark.parametrize("seed", range(3))
def test_a_response_to_the_square_of_a_voltage_is_not_clipped(seed):
    """3 s at 0 V, a step to 3 V with creep, then a chirp: its troughs are flatter, but no limit."""
    time_s = np.arange(12500) / 250.0
    chirped_s = np.clip(time_s - 20.0, 0.0, None)
    rate = np.log(100.0) / 30.0
    phase = 2.0 * np.pi * 0.1 * (np.exp(rate * chirped_s) - 1.0) / rate
    u = np.where(time_s < 3.0, 0.0, 3.0) + 0.8 * np.sin(phase)
    plant = Plant(1.0, 2.0 * np.pi * 3.0, 0.12, 0.0, (SlowMode(0.7, 4.0),))
    y = 0.43e-3 * plant.simulate(u**2, 250.0, time_s)
    y += 1e-5 * np.random.default_rng(seed).normal(size=y.size)
    assert estimate(u, y, 250.0).status == "ok"


@pytest.mark.parametrize("drive", ["step", "sparse multisine"])
def test_an_output_that_rests_at_its_extremes_is_not_clipped(drive):
    rng = np.random.default_rng(13)
    u = DRIVES[drive](rng)
    y = PLANT.simulate(u, 400.0, TIME_S)
    response = estimate(u, y + 0.02 * rng.normal(size=y.size) * y.std(), 400.0)
    assert response.status == "ok"


@pytest.mark.long
def test_circles_hold_about_a_resonance_wider_than_the_narrow_window():
    # Half width of the resonance 0.6 Hz, of the narrow window 0.8 Hz; 40 dB of noise.
    sweep = FAST_DRIVES["chirp"]
    clean = FAST.simulate(sweep, 200.0, FAST_S)
    inside = []
    for run in range(24):
        noise = 5e-4 * np.random.default_rng([14, run]).normal(size=clean.size)
        response = estimate(sweep, clean + noise, 200.0)
        true = FAST.frequency_response(2 * np.pi * response.frequency_hz)
        near = np.abs(response.frequency_hz - 5.1) < 1.5
        inside.append(np.mean((np.abs(response.response - true) <= INSIDE * response.std)[near]))
    # 60 lines hang together as one or two do: the spread over runs is counted, not computed.
    assert np.mean(inside) + 2.0 * np.std(inside) / np.sqrt(24) >= 0.8
