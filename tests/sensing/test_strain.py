"""Strain from farads: known curves, known loops, coverage counted on cycles to come, drift."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import InputError, LimitError, ResultError
from haselab.models.actuator.strain_map import StrainMap
from haselab.sensing.strain import drift_check, fit_strain_map

KINDS = ["line", "quadratic", "cubic", "auto"]
LOW_F, HIGH_F = 1.0e-9, 1.4e-9


def cycles(count: int, per_cycle: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Capacitance over triangles from low to high and back, and the way: 1 up, -1 down."""
    phase = np.arange(count * per_cycle) / per_cycle % 1.0
    c = LOW_F + (HIGH_F - LOW_F) * (1 - np.abs(2 * phase - 1))
    return c, np.where(phase < 0.5, 1, -1)


def straight(c: np.ndarray) -> np.ndarray:
    return 3e8 * c - 0.25


def curved(c: np.ndarray) -> np.ndarray:
    return (c / LOW_F) ** (1 / 3.3) - 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_straight_line_comes_back_whatever_the_kind(kind):
    c, _ = cycles(3)
    fitted = fit_strain_map(c, straight(c), kind)
    inside = np.linspace(LOW_F, c.max(), 57)
    np.testing.assert_allclose(fitted.strain(inside), straight(inside), atol=1e-8)
    assert fitted.slope_at(1.2e-9) == pytest.approx(3e8, rel=1e-6)
    assert max(np.abs(fitted.band)) < 1e-8
    assert fitted.hysteresis_strain < 1e-8


@pytest.mark.parametrize(("kind", "degree"), [("line", 1), ("quadratic", 2), ("cubic", 3)])
def test_the_map_follows_a_curve_up_to_its_next_derivative(kind, degree):
    c, _ = cycles(3)
    fitted = fit_strain_map(c, curved(c), kind)
    # The best polynomial of degree n misses a smooth curve by f^(n+1) h^(n+1) / (2^n (n+1)!) at the
    # most (Chebyshev, h half the range); least squares by no more than three times that.
    half, power = (c.max() - LOW_F) / 2, 1 / 3.3
    factors = np.abs(power - np.arange(degree + 1))
    bound = np.prod(factors) * (half / LOW_F) ** (degree + 1)
    bound /= 2**degree * math.factorial(degree + 1)
    assert np.abs(fitted.strain(c) - curved(c)).max() < 3 * bound
    assert fitted.coefficients[degree + 1 :] == (0.0,) * (3 - degree)


def test_auto_takes_the_highest_degree_that_rises():
    c, _ = cycles(3)
    assert fit_strain_map(c, curved(c)) == fit_strain_map(c, curved(c), "cubic")


def test_a_map_ends_where_the_strain_turns():
    """The strain turns at 0.71 of the record: no loop may use the map beyond, on either side."""
    c, _ = cycles(3)
    turn_f = c.min() + np.ptp(c) / 1.4
    x = (c - c.min()) / np.ptp(c)
    bend = x - 0.7 * x**2
    for sign, way in ((1.0, "rise"), (-1.0, "fall")):
        for kind in ("quadratic", "cubic"):
            words = rf"does not {way} with the capacitance everywhere.*Fit a lower degree"
            with pytest.raises(ResultError, match=words):
                fit_strain_map(c, sign * bend, kind)
        fitted = fit_strain_map(c, sign * bend)
        assert fitted.range_f[0] == c.min()
        # within a cell of 1/24 of the record, beyond which the strain is almost constant
        assert fitted.range_f[1] == pytest.approx(turn_f, abs=np.ptp(c) / 24)
        assert fitted.usable_f[1] <= turn_f + np.ptp(c) / 24
        grid = np.linspace(fitted.range_f[0], fitted.usable_f[1], 200)
        assert (sign * np.diff(fitted.strain(grid)) > -1e-12).all()


@pytest.mark.parametrize("onset", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("side", ["low", "high"])
def test_a_map_is_limited_to_the_part_that_it_follows(onset, side):
    """A slack pouch zips without motion up to an onset. The oracle is the kinked line itself."""
    c, way = cycles(4)
    x = (c - c.min()) / np.ptp(c)
    x = x if side == "low" else 1.0 - x
    still = -0.05 * np.maximum(0.0, (x - onset) / (1.0 - onset))
    noise = 2e-5 * np.random.default_rng(1).standard_normal(c.size)
    fitted = fit_strain_map(c, still + 2e-4 * way + noise)
    inside = fitted.inside(c)
    low, high = fitted.interval(c[inside])
    share = np.mean((still[inside] >= low) & (still[inside] <= high))
    assert share >= 0.93  # 95 %, and the error of a share of some 1000 samples with hysteresis
    assert max(np.abs(fitted.band)) < 0.1 * 0.05  # a line over everything: up to 0.4
    assert np.ptp(still[inside]) > 0.9 * 0.05
    if onset >= 0.5:  # a cubic follows a short flat part
        limit_f = fitted.usable_f[0] if side == "low" else fitted.usable_f[1]
        flat_f = c.min() if side == "low" else c.max()
        assert abs(limit_f - flat_f) > 0.5 * onset * np.ptp(c)


def test_a_record_that_no_curve_follows_gives_no_map():
    c, _ = cycles(3)
    x = (c - c.min()) / np.ptp(c)
    stairs = 0.05 * (np.floor(5.0 * x) / 5.0 + 0.02 * x)
    with pytest.raises(ResultError, match="No line, parabola or cubic follows the strain"):
        fit_strain_map(c, stairs)


def test_a_map_that_turns_is_refused_or_ends_there():
    """strain = (c - 1 nF)^2 / nF^2 turns at 1 nF."""
    turning = {"slope_per_f": -2e9, "offset": 1.0, "curvature_per_f2": 1e18}
    with pytest.raises(InputError, match=r"turns at 1e-09 F, within its range .* narrow range_f"):
        StrainMap(**turning, range_f=(0.9e-9, 1.2e-9))
    assert StrainMap(**turning, range_f=(1.1e-9, 1.4e-9)).usable_f == pytest.approx((1e-9, 1.7e-9))
    assert StrainMap(**turning, range_f=(0.6e-9, 0.9e-9)).usable_f == pytest.approx((3e-10, 1e-9))
    cubic = StrainMap(2e9, 0.0, 0.0, -0.5e27 / 3.0, range_f=(0.5e-9, 1.8e-9))  # turns at 2 nF
    assert cubic.turns_f == pytest.approx((-2e-9, 2e-9)) and cubic.usable_f[1] == 2e-9
    limited = StrainMap(4e8, 0.0, range_f=(5e-10, 6e-10), limits_f=(5e-10, 7e-10))
    assert limited.usable_f == (5e-10, 7e-10)


def test_the_covariance_is_that_of_maps_of_other_cycles():
    """Cycles that differ in offset and slope: maps of 10 cycles, and what one of them says."""
    rng = np.random.default_rng(8)

    def fitted():
        c, _ = cycles(10, 100)
        shift = np.repeat(0.002 * rng.standard_normal(10), 100)
        turn = np.repeat(0.02 * rng.standard_normal(10), 100)
        return fit_strain_map(c, straight(c) * (1 + turn) + shift, "line")

    maps = [fitted() for _ in range(150)]
    seen = np.std([one.strain(1.25e-9) for one in maps], ddof=1)
    said = np.sqrt(np.mean([one.std(1.25e-9) ** 2 for one in maps]))
    # 150 maps: 1 / sqrt(300) of the standard deviation; so many variances of 9 degrees: as much.
    assert said == pytest.approx(seen, rel=4 * np.sqrt(1 / 300 + 2 / (9 * 150) / 4))
    assert maps[0].covariance[0][2:] == (0.0, 0.0)


@pytest.mark.parametrize("kind", KINDS)
def test_neither_dwell_nor_the_time_on_one_branch_moves_the_map(kind):
    c, way = cycles(4)
    e = straight(c) + 0.004 * way
    even = fit_strain_map(c, e, kind)
    counts = np.where(way > 0, 1, 3) + np.where(c > 1.35e-9, 10, 0)
    slow = fit_strain_map(np.repeat(c, counts), np.repeat(e, counts), kind)
    grid = np.linspace(LOW_F, c.max(), 40)
    # A cell's mean moves within the cell where the dwell begins: 1/24 of the range, 0.12 of strain.
    np.testing.assert_allclose(slow.strain(grid), even.strain(grid), atol=0.12 / 24 / 2)


@pytest.mark.parametrize("kind", KINDS)
def test_the_loop_is_measured_and_the_band_holds_it(kind):
    c, way = cycles(6)
    e = straight(c) + 0.005 * way
    fitted = fit_strain_map(c, e, kind)
    assert fitted.hysteresis_strain == pytest.approx(0.01, rel=0.05)
    low, high = fitted.interval(c)
    np.testing.assert_allclose(fitted.band, [-0.005, 0.005], rtol=0.1)
    assert fitted.residual_std == pytest.approx(0.005, rel=0.05)
    assert ((high - low) > 0.0095).all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_band_holds_its_share_of_cycles_to_come(kind):
    """Loops whose height varies from cycle to cycle, with noise: 600 cycles after fits on 8."""
    rng = np.random.default_rng(4)

    def record(count: int) -> tuple[np.ndarray, np.ndarray]:
        c, way = cycles(count, 200)
        height = np.repeat(0.004 + 0.001 * rng.standard_normal(count), 200)
        return c, straight(c) + height * way + 0.001 * rng.standard_normal(c.size)

    shares, claims = [], []
    for _ in range(30):
        fitted = fit_strain_map(*record(8), kind, coverage=0.9)
        c, e = record(20)
        c = np.clip(c, *fitted.range_f)
        low, high = fitted.interval(c)
        shares.append(np.mean((e >= low) & (e <= high)))
        claims.append(fitted.held_out_coverage)
    # A share of the samples of 8 cycles, which differ, scatters by no more than that of 8 draws.
    spread = np.sqrt(0.9 * 0.1 / 8)
    assert np.mean(shares) == pytest.approx(0.9, abs=3 * spread / np.sqrt(30))
    # Bands of seven cycles, unwidened, hold less, and say so.
    assert 0.9 - 3 * spread / np.sqrt(30) < np.mean(claims) < 0.9


def test_one_cycle_has_none_to_leave_out_and_says_so():
    c, way = cycles(1)
    fitted = fit_strain_map(c, straight(c) + 0.004 * way)
    assert np.isnan(fitted.held_out_coverage) and fitted.covariance is None
    assert fitted.band[1] - fitted.band[0] == pytest.approx(0.008, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), noise=st.floats(1e-4, 0.3))
def test_the_map_never_falls(seed, noise):
    rng = np.random.default_rng(seed)
    c, _ = cycles(2, 60)
    try:
        fitted = fit_strain_map(c, curved(c) + noise * rng.standard_normal(c.size))
    except ResultError:
        return  # nothing but noise
    grid = np.linspace(*fitted.range_f, 500)
    assert (np.diff(fitted.strain(grid)) >= -1e-12).all()


@pytest.mark.parametrize("kind", KINDS)
def test_there_is_no_interval_beyond_the_record(kind):
    c, _ = cycles(2)
    fitted = fit_strain_map(c, straight(c), kind)
    for beyond_f in (0.999 * LOW_F, 1.001 * HIGH_F):
        with pytest.raises(LimitError, match=r"Capacitance = .* F is outside \[1e-09, .* Fit a"):
            fitted.interval([1.2e-9, beyond_f])
        assert not fitted.inside(beyond_f)
    assert np.isnan(fitted.interval([1.2e-9, np.nan])[0]).tolist() == [False, True]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c, e: (c[:20], e[:20]), "32 samples or more"),
        (lambda c, e: (c, e[:-1]), "same length"),
        (lambda c, e: (np.where(c > 1.3e-9, np.nan, c), e), "NaN or infinity"),
        (lambda c, e: (np.full_like(c, 1e-9), e), "1e-09 F throughout"),
        (lambda c, e: (1e12 * c, e), r"capacitance_f lies in \[.*\] F; .* 500 pF are 500e-12"),
        (lambda c, e: (-c, e), r"it must be above 0 and at most 0.001 F"),
        (lambda c, e: (c, 100.0 * e), r"strain lies in .* at most 5 .* in per cent, divide it by"),
        (lambda c, e: (e - e.min(), c), r"capacitance_f lies in .* Are the two columns swapped\?"),
        (lambda c, e: (1e-3 * (1.0 + e) / 2.0, c), r"strain lies in .* two columns swapped\?"),
    ],
)
def test_columns_that_cannot_be_fitted_are_refused(change, words):
    c, _ = cycles(2)
    with pytest.raises(InputError, match=words):
        fit_strain_map(*change(c, straight(c)))


@pytest.mark.parametrize("kind", KINDS)
def test_the_map_of_an_actuator_that_contracts_falls(kind):
    c, way = cycles(3)
    strain = straight(c) + 0.002 * way
    falling, rising = fit_strain_map(c, -strain, kind), fit_strain_map(c, strain, kind)
    # All numbers are those of the mirrored map; the quantiles of the band change places.
    assert falling.coefficients == pytest.approx([-x for x in rising.coefficients], rel=1e-9)
    assert falling.band == pytest.approx([-x for x in reversed(rising.band)], rel=1e-9)
    assert falling.hysteresis_strain == pytest.approx(rising.hysteresis_strain, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_strain_that_does_not_follow_the_capacitance_is_no_result(kind):
    c, _ = cycles(3)
    late = np.roll(straight(c), 100)  # a quarter of a cycle: each capacitance has both strains
    with pytest.raises(ResultError, match=r"does not follow the capacitance.* Check the columns"):
        fit_strain_map(c, late, kind)


def test_unknown_kinds_and_coverages_are_refused():
    c, _ = cycles(2)
    with pytest.raises(InputError, match="kind is 'quartic'; it must be auto or line"):
        fit_strain_map(c, straight(c), "quartic")
    with pytest.raises(InputError, match=r"coverage = 1 is outside \(0, 1\)"):
        fit_strain_map(c, straight(c), coverage=1.0)


# ---- drift ----------------------------------------------------------------------------------


def watched(seed: int, per_hour: float, minutes: float, noise: float = 0.002):
    """A record of a drifting actuator: capacitance, camera's strain, time."""
    c, way = cycles(round(minutes * 6), 100)
    time_s = np.arange(c.size) * 0.1
    rng = np.random.default_rng(seed)
    e = straight(c) + 0.003 * way + per_hour * time_s / 3600 + noise * rng.standard_normal(c.size)
    return c, e, time_s


def test_a_drift_is_found_with_its_rate():
    fitted = fit_strain_map(*watched(0, 0.0, 4.0)[:2])
    drift = drift_check(fitted, *watched(1, 0.02, 16.0))
    assert drift.verdict == "drifts"
    low, high = drift.slope_per_hour.ci95
    assert low < 0.02 < high
    assert drift.slope_per_hour.unit == "1/h"
    assert drift.offset.value == pytest.approx(0.02 * 8 / 60, abs=5 * drift.offset.std + 1e-3)


def test_no_drift_is_called_one_in_twenty_times():
    fitted = fit_strain_map(*watched(0, 0.0, 4.0)[:2])
    # 16 segments of one cycle of 10 s each: what the check asks for.
    called = [
        drift_check(fitted, *watched(k, 0.0, 16 / 6)).verdict == "drifts" for k in range(2, 402)
    ]
    assert np.mean(called) == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / 400))


def test_a_record_too_short_says_so():
    c, way = cycles(4, 400)
    fitted = fit_strain_map(c, straight(c) + 1e-5 * way)
    short_c, short_e, time_s = watched(3, 0.0, 0.5, noise=0.02)
    assert drift_check(fitted, short_c, short_e, time_s).verdict == "too short to tell"


def test_times_that_do_not_rise_are_refused():
    c, e, time_s = watched(1, 0.0, 1.0)
    fitted = fit_strain_map(c, e)
    with pytest.raises(InputError, match="rising"):
        drift_check(fitted, c, e, time_s[::-1])
    with pytest.raises(InputError, match="rising"):
        drift_check(fitted, c, e, time_s[:-1])
