"""Voltage maps: the paper's curve through noise and loops, limits of identifiability."""

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter

from haselab.base import InputError, ResultError
from haselab.identify.statics.voltage_map import fit_voltage_map
from haselab.models.maps import VoltageMap

PAPER = VoltageMap(1.324, 3.124, -0.2805, -26.92, -0.06, 0.2)
TRUTH = {"a1_v": 1.324, "b1": 3.124, "a2_v": -0.2805, "b2": -26.92}
RATE_HZ = 400.0


def triangle_v(cycles=4, rate_hz=RATE_HZ):
    """Triangle of 0 to 2 V at 0.25 Hz."""
    phase = np.arange(int(cycles * 4 * rate_hz)) / (4 * rate_hz) % 1.0
    return 2.0 * (1.0 - np.abs(2.0 * phase - 1.0))


def strain_of(voltage_v):
    """Inverse of the paper's curve, by a table of its own."""
    grid = np.linspace(-0.06, 0.16, 20001)
    return np.interp(voltage_v, PAPER.voltage_v(grid), grid)


def lagging(tau_s):
    """Loop of a strain that follows the paper's curve late; the settled cycles."""
    v = triangle_v(8)
    share = np.exp(-1.0 / (RATE_HZ * tau_s))
    return lfilter([1 - share], [1, -share], strain_of(v))[6400:], v[6400:]


@pytest.mark.long
@pytest.mark.parametrize("memory", [0.0, 0.95])
def test_the_intervals_hold_the_paper_s_coefficients_in_noise_of_any_colour(memory):
    e = strain_of(triangle_v(2, 200.0))
    inside, runs = np.zeros(4), 60
    for run in range(runs):
        white = np.random.default_rng([14, run]).normal(size=e.size + 400)
        noise = lfilter([np.sqrt(1 - memory**2)], [1, -memory], white)[400:]
        fit = fit_voltage_map(e, PAPER.voltage_v(e) + 0.01 * noise)
        limits = [fit.parameters[name].ci95 for name in TRUTH]
        inside += [lo <= t <= hi for (lo, hi), t in zip(limits, TRUTH.values(), strict=True)]
    # Binomial: 3 spreads below 95 %.
    assert (inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


@pytest.mark.long
def test_the_curve_s_spread_is_that_of_repeated_fits():
    e, runs = strain_of(triangle_v(1, 100.0)), 80
    at = np.linspace(-0.04, 0.14, 7)
    curves, spreads = [], []
    for run in range(runs):
        noise = np.random.default_rng([15, run]).normal(size=e.size)
        fit = fit_voltage_map(e, PAPER.voltage_v(e) + 0.02 * noise)
        curves.append(fit.map.voltage_v(at))
        spreads.append(fit.curve_std(at))
    ratio = np.std(curves, axis=0, ddof=1) / np.mean(spreads, axis=0)
    # A standard deviation of 80 runs has a relative spread of 1/sqrt(2 * 79): 3.5 of it.
    assert np.abs(ratio - 1.0).max() < 3.5 / np.sqrt(2 * (runs - 1))


def test_a_loop_about_the_paper_s_curve_gives_its_width_and_its_coefficients():
    v = triangle_v()
    e, rising = strain_of(v), np.arange(v.size) % 1600 < 800
    e = e + 1e-5 * np.random.default_rng(3).normal(size=v.size)
    looped = PAPER.voltage_v(e) + np.where(rising, 0.05, -0.05)
    fit = fit_voltage_map(e, looped)
    # The branch of the few samples next to the turning points is uncertain.
    assert fit.hysteresis_width == pytest.approx(0.1, rel=0.02)
    for name, value in TRUTH.items():
        low, high = fit.parameters[name].ci95
        assert low <= value <= high, name
    # The interval counts the loop as noise, yet stays far below the loop itself.
    assert 0.0 < fit.curve_std(0.05) < 0.05
    assert fit.r_squared == pytest.approx(1.0 - 0.05**2 / looped.var(), abs=1e-3)


def test_the_map_has_an_inverse_in_its_whole_range():
    e, v = lagging(0.05)
    chart = fit_voltage_map(e, v).map
    span = np.ptp(e)
    assert chart.strain_low == pytest.approx(e.min() - 0.2 * span)
    assert chart.strain_high == pytest.approx(e.max() + 0.2 * span)
    strain = np.linspace(chart.strain_low, chart.strain_high, 50)
    # Newton stops at 1e-15 of strain; the voltage is rounded at 1e-16, divided by its slope.
    np.testing.assert_allclose(chart.strain(chart.voltage_v(strain)), strain, atol=1e-13)


def slopes_at(numbers, x):
    """Derivative of the sum of two exponentials in centred, scaled strain."""
    a1, b1, a2, b2 = numbers
    return a1 * b1 * np.exp(b1 * x) + a2 * b2 * np.exp(b2 * x)


@pytest.mark.long
def test_a_fat_loop_gets_the_best_monotone_curve_and_no_coefficients():
    e, v = lagging(0.8)
    fit = fit_voltage_map(e, v)
    assert fit.succeeded and fit.monotone
    assert any("best monotone one" in note for note in fit.notes)
    chart = fit.map
    assert (
        np.diff(chart.voltage_v(np.linspace(chart.strain_low, chart.strain_high, 500))) > 0
    ).all()
    assert np.isfinite(fit.map.voltage_v(e)).all()
    assert all(estimate.ci95 == (-np.inf, np.inf) for estimate in fit.parameters.values())
    # Sequential quadratic programming on the four numbers finds nothing better.
    x = (e - 0.5 * (e.max() + e.min())) / (0.5 * np.ptp(e))
    least = 1e-3 * 0.5 * np.ptp(v)

    def cost(n):
        return float(np.mean((v - n[0] * np.exp(n[1] * x) - n[2] * np.exp(n[3] * x)) ** 2))

    limits = [
        {"type": "ineq", "fun": lambda n, at=at: slopes_at(n, at) - least} for at in (-1.4, 1.4)
    ]
    others = [
        minimize(cost, start, method="SLSQP", constraints=limits, options={"maxiter": 500})
        for start in ([1, 0.3, -0.3, -2.5], [0.5, 1, 0.5, 0.1], [1, 1, -0.1, 2], [-0.1, 3, 1, 1])
    ]
    best = min(
        o.fun for o in others if o.success and min(slopes_at(o.x, s) for s in (-1.4, 1.4)) > 0
    )
    assert float(np.mean(fit.residuals[0] ** 2)) <= best * (1.0 + 1e-5)


def test_rates_that_meet_leave_the_curve_identifiable_and_the_coefficients_not():
    x = np.linspace(-1.0, 1.0, 400)
    # Below the confluent pair: a growing cosine, which no two real rates give.
    v = np.exp(0.5 * x) * np.cos(0.25 * x - 0.4) + 1e-4 * np.random.default_rng(4).normal(size=400)
    fit = fit_voltage_map(0.1 * x, v)
    assert any("Not identifiable from this loop: a1_v, b1, a2_v, b2, " in n for n in fit.notes)
    assert all(np.isnan(e.value) and e.std == np.inf for e in fit.parameters.values())
    assert np.isinf(fit.covariance).all()
    assert "not identifiable" in fit.summary() and "nan" not in fit.summary()
    assert fit.r_squared > 0.9999
    assert fit.map.voltage_v(0.0) == pytest.approx(np.cos(0.4), abs=0.01)


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_a_curve_that_one_exponential_describes_has_no_coefficients(noise):
    # The second amplitude is 0, so the second rate can be anything: intervals of the linearised
    # problem would exclude the true amplitude in half of the records.
    e = 0.03 - 0.07 * np.cos(np.linspace(0.0, 6 * np.pi, 120))
    v = np.exp(8.0 * e)
    noise = noise * np.random.default_rng(7).normal(size=e.size)
    fit = fit_voltage_map(e, v + noise)
    assert fit.succeeded and all(np.isnan(p.value) for p in fit.parameters.values())
    assert np.abs(fit.map.voltage_v(e) - v).max() < 4.0 * fit.curve_std(e).max()


@pytest.mark.long
def test_a_falling_curve_is_fitted_as_well_as_a_rising_one():
    e = np.linspace(-0.045, 0.147, 400)
    noise = 0.005 * np.random.default_rng(5).normal(size=400)
    up, down = (
        fit_voltage_map(e, PAPER.voltage_v(e) + noise),
        fit_voltage_map(e, 3.0 * (-PAPER.voltage_v(e) - noise)),
    )
    assert down.monotone and up.monotone
    for name, factor in (("a1_v", -3.0), ("a2_v", -3.0), ("b1", 1.0), ("b2", 1.0)):
        pair = down.parameters[name], up.parameters[name]
        # The search rests at a relative gain of 1e-10 of the cost: 1e-5 spreads.
        assert abs(pair[0].value - factor * pair[1].value) <= 1e-3 * pair[0].std, name
        assert pair[0].std == pytest.approx(abs(factor) * pair[1].std, rel=1e-3)
    assert up.hysteresis_width == 0.0


def test_what_does_not_follow_has_no_result_and_bad_columns_are_refused():
    rng = np.random.default_rng(6)
    fit = fit_voltage_map(rng.normal(size=500), rng.normal(size=500))
    assert fit.status.startswith("no result") and not fit.succeeded
    assert fit.answer()["a1_v"] is None
    with pytest.raises(ResultError, match="does not depend"):
        _ = fit.map
    with pytest.raises(ResultError, match="does not depend"):
        fit.curve_std(0.0)
    with pytest.raises(InputError, match="must be equally long"):
        fit_voltage_map(np.arange(9.0), np.arange(10.0))
    with pytest.raises(InputError, match="voltage_v is 1 throughout"):
        fit_voltage_map(np.arange(9.0), np.ones(9))
    with pytest.raises(InputError, match="at least 8"):
        fit_voltage_map(np.arange(7.0), np.arange(7.0))


@pytest.mark.long
@pytest.mark.parametrize("case", [2, 10, 18, 26])
def test_no_random_start_finds_a_better_curve(case):
    rng = np.random.default_rng([3, case])
    x = np.linspace(-1.0, 1.0, 60)
    a, b = rng.normal(size=2), rng.uniform(-4.0, 4.0, 2)
    v = np.exp(np.outer(x, b)) @ a
    v = v + 0.02 * np.ptp(v) * rng.normal(size=60)

    def errors(rates):
        shapes = np.exp(np.outer(x, rates))
        return v - shapes @ np.linalg.lstsq(shapes, v, rcond=None)[0]

    found = [
        least_squares(errors, start, bounds=(-10.0, 10.0), max_nfev=40).cost
        for start in rng.uniform(-8.0, 8.0, (60, 2))
    ]
    fit = fit_voltage_map(0.1 * x, v)
    assert not any("best monotone one" in note for note in fit.notes)
    # The search rests at a relative gain of 1e-10.
    assert float(fit.residuals[0] @ fit.residuals[0]) <= 2.0 * min(found) * (1.0 + 1e-8)
