"""Capacitance maps: the paper's line through noise, loops and unequal dwell."""

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError, ResultError
from haselab.identify.statics.capacitance_map import fit_capacitance_map

SLOPE, OFFSET = 4.923e6, -0.276
TIME_S = np.arange(1600) / 100.0
STRAIN = 0.05 - 0.095 * np.cos(2 * np.pi * 0.25 * TIME_S)


def capacitance(strain):
    return (strain - OFFSET) / SLOPE


@pytest.mark.long
@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_the_intervals_hold_the_paper_s_line_in_noise_of_any_colour(memory):
    inside, runs = np.zeros(2), 80
    for run in range(runs):
        white = np.random.default_rng([16, run]).normal(size=TIME_S.size + 400)
        noise = lfilter([np.sqrt(1 - memory**2)], [1, -memory], white)[400:]
        # One hundredth of the span: what is left after averaging does not flatten the line.
        fit = fit_capacitance_map(capacitance(STRAIN + 0.002 * noise), STRAIN)
        for i, (name, truth) in enumerate((("slope", SLOPE), ("offset", OFFSET))):
            low, high = fit.parameters[name].ci95
            inside[i] += low <= truth <= high
    # Binomial: 3 spreads below 95 %.
    assert (inside / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


def test_both_edges_count_alike_although_one_takes_three_times_as_long():
    up = np.linspace(-0.045, 0.145, 1200)
    strain = np.tile(np.concatenate([up, up[::-3]]), 4)
    rising = np.tile(np.concatenate([np.ones(1200, bool), np.zeros(400, bool)]), 4)
    sensed = capacitance(strain + np.where(rising, 0.01, -0.01))
    fit = fit_capacitance_map(sensed, strain)
    at = capacitance(0.05)
    # The loop is 0.02 wide; a plain regression is off by a quarter of it.
    assert fit.map.strain(at) == pytest.approx(0.05, abs=0.02 * 0.01)
    plain = np.polyfit(sensed, strain, 1)
    assert abs(np.polyval(plain, at) - 0.05) > 0.02 * 0.2
    assert fit.map.slope == pytest.approx(SLOPE, rel=0.005)


def test_a_nonlinear_characteristic_widens_the_interval_by_its_misfit():
    nonlinear = capacitance(STRAIN) * (1.0 + 0.5 * (STRAIN - 0.05))
    straight = fit_capacitance_map(capacitance(STRAIN), STRAIN)
    fit = fit_capacitance_map(nonlinear, STRAIN)
    tangents = np.gradient(STRAIN[:200], nonlinear[:200])[20:180]
    low, high = fit.parameters["slope"].ci95
    assert tangents.min() < fit.parameters["slope"].value < tangents.max()
    assert (high - low) > 1e3 * np.diff(straight.parameters["slope"].ci95)[0]


def test_one_edge_is_fitted_and_told():
    strain = np.linspace(-0.045, 0.145, 300)
    fit = fit_capacitance_map(capacitance(strain), strain)
    assert fit.succeeded and any("one edge only" in note for note in fit.notes)
    assert fit.map.slope == pytest.approx(SLOPE, rel=1e-9)
    assert fit.r_squared == pytest.approx(1.0, abs=1e-12)


def test_what_does_not_follow_has_no_result_and_bad_columns_are_refused():
    rng = np.random.default_rng(17)
    fit = fit_capacitance_map(rng.normal(size=1600), STRAIN)
    assert fit.status.startswith("no result") and fit.answer()["slope"] is None
    with pytest.raises(ResultError, match="does not depend"):
        _ = fit.map
    with pytest.raises(InputError, match="must be equally long"):
        fit_capacitance_map(np.arange(9.0), np.arange(10.0))
    with pytest.raises(InputError, match="strain is 0 throughout"):
        fit_capacitance_map(np.arange(9.0), np.zeros(9))
