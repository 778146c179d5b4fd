"""Hysteresis models against their definitions, their closed-form inverses, and themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from haselab.base import InputError
from haselab.models import BoucWen, DeadZones, PrandtlIshlinskii

PLAYS = PrandtlIshlinskii(1.0, (0.1, 0.25, 0.6), (0.5, 0.3, 0.2), offset=0.1)
ZONES = DeadZones((-1.0, 0.5, 1.5), (0.6, 0.4, -0.7))
inputs = st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=60).map(np.array)
positive = st.floats(0.05, 2.0)


def play(u, threshold, before=0.0):
    """The definition, sample by sample."""
    x, out = before, []
    for value in u:
        x = max(value - threshold, min(value + threshold, x))
        out.append(x)
    return np.array(out)


def rounding(*arrays):
    """What a hundred operations in double may lose of numbers this large."""
    return 100 * np.finfo(float).eps * max(1.0, *(np.abs(a).max() for a in arrays))


@given(inputs)
def test_the_sum_of_plays_is_that_of_the_definition(u):
    pairs = zip(PLAYS.thresholds, PLAYS.weights, strict=True)
    expected = 0.1 + u + sum(weight * play(u, r) for r, weight in pairs)
    assert np.abs(PLAYS.simulate(u) - expected).max() <= rounding(expected)


@given(inputs)
def test_the_inverse_is_that_of_kuhnens_closed_form(y):
    """The inverse of a sum of plays is a sum of plays with other thresholds and weights."""
    r, p = np.r_[0.0, PLAYS.thresholds], np.r_[PLAYS.gain, PLAYS.weights]
    total = np.cumsum(p)
    thresholds = [float((p[: i + 1] * (r[i] - r[: i + 1])).sum()) for i in range(1, 4)]
    weights = [-p[i] / (total[i] * total[i - 1]) for i in range(1, 4)]
    bare = y - PLAYS.offset
    pairs = zip(weights, thresholds, strict=True)
    expected = bare / p[0] + sum(weight * play(bare, s) for weight, s in pairs)
    assert np.abs(PLAYS.invert(y) - expected).max() <= rounding(expected, y)


@settings(max_examples=60, deadline=None)
@given(
    inputs,
    st.lists(positive, min_size=0, max_size=6),
    st.lists(positive, min_size=6, max_size=6),
    st.booleans(),
    st.booleans(),
    st.floats(0.0, 0.3),
)
def test_inverse_then_model_is_the_identity(y, gaps, weights, leads, curved, rate_dependence_s):
    size = len(gaps)
    used = np.array(weights[:size]) * (-0.9 / max(sum(weights[:size]), 1e-9) if leads else 1.0)
    model = PrandtlIshlinskii(
        1.0,
        tuple(np.cumsum(gaps)),
        tuple(used),
        -0.2,
        rate_dependence_s,
        4.0,
        ZONES if curved else DeadZones(),
    )
    if model.obstacle(10.0):
        return
    u = model.invert(y, 10.0)
    # An error of the output is one of the input over the flattest slope, here 0.1 by 0.3, and
    # the rate's feedback below 1 lets it grow no faster than the samples do.
    assert np.abs(model.simulate(u, 10.0) - y).max() <= 1e3 * rounding(u, y)


def test_the_rate_widens_the_loop_as_the_thresholds_say():
    """On a ramp of rate v the play lags by alpha + beta v once the filter has settled."""
    model = PrandtlIshlinskii(1.0, (0.2,), (1.0,), 0.0, 0.05, 0.1)
    u = 3.0 * np.arange(1000) / 100.0
    lag = 2.0 * u[-1] - model.simulate(u, 100.0)[-1]
    assert abs(lag - (0.2 + 0.05 * 3.0)) <= rounding(u)


def test_a_rate_independent_model_does_not_see_how_fast_a_path_is_walked():
    corners = np.array([0.0, 2.0, -1.0, 1.5, 0.3])
    slow = np.interp(np.linspace(0, 4, 4001), np.arange(5), corners)
    for model in (PLAYS, BoucWen(1.0, -0.2, 2.0, 0.8), BoucWen(1.0, -0.2, 2.0, 0.8, 1.7)):
        # Runge-Kutta steps differ with the exponent 1.7; the closed forms do not.
        allowed = 1e-6 if isinstance(model, BoucWen) else rounding(slow)
        assert abs(model.simulate(slow)[-1] - model.simulate(corners)[-1]) <= allowed


def test_a_full_sweep_wipes_out_the_past():
    pasts = [np.array([0.0, 0.4, -0.2]), np.array([1.0, 0.9, 0.95])]
    sweep = np.array([2.0, -2.0, 0.3, 1.1])
    one, other = (PLAYS.simulate(np.r_[past, sweep])[3:] for past in pasts)
    assert np.array_equal(one[1:], other[1:])


@pytest.mark.long
@pytest.mark.parametrize("exponent", [1.0, 1.2, 2.0, 3.5])
@pytest.mark.parametrize("sigma", [0.5, 0.8, 2.5])
def test_bouc_wen_follows_its_differential_equation(exponent, sigma):
    model = BoucWen(0.0, 1.0, 3.0, sigma, exponent)
    path, w = [0.0, 0.9, -0.8, 0.1, -1.2], 0.0
    got = model.simulate(path)
    for k in range(1, len(path)):
        sign = np.sign(path[k] - path[k - 1])

        def slope(_, w, sign=sign):
            power = np.abs(w) ** exponent
            return 3.0 * sign * (1 - sigma * sign * np.sign(w) * power + (sigma - 1) * power)

        length = abs(path[k] - path[k - 1])
        w = solve_ivp(slope, (0, length), [w], rtol=1e-11, atol=1e-12, max_step=2e-3).y[0, -1]
        assert abs(got[k] - w) <= (1e-9 if exponent == 1.0 else 1e-6)


@settings(max_examples=60, deadline=None)
@given(inputs, st.floats(-1.0, 1.0), st.floats(0.5, 3.0), st.sampled_from([1.0, 1.5, 3.0]))
def test_the_bouc_wen_inverse_then_model_is_the_identity(y, share, sigma, exponent):
    # At most 0.9 of the gain is taken away after a reversal.
    model = BoucWen(1.0, 0.9 * share / (2.0 * sigma * 2.0), 2.0, sigma, exponent, 0.3, ZONES)
    assert model.obstacle() == ""
    u = model.invert(y)
    assert np.abs(model.simulate(u) - y).max() <= 1e3 * rounding(u, y)


RATED = PrandtlIshlinskii(1.0, (0.2,), (0.5,), 0.0, 0.01, 0.1)


@pytest.mark.parametrize("model", [PLAYS, RATED, BoucWen(1.0, -0.1, 2.0)])
def test_blocks_give_what_the_whole_record_gives(model):
    u = np.cumsum(np.random.default_rng(1).normal(size=300)) * 0.2
    whole, state, parts = model.simulate(u, 50.0), model.init(50.0), []
    for block in np.array_split(u, 7):
        state, y = model.step(state, block)
        parts.append(y)
    assert np.array_equal(np.concatenate(parts), whole)
    state, first = model.inverse_step(model.init(50.0), whole[:100])
    rest = model.inverse_step(state, whole[100:])[1]
    assert np.array_equal(np.r_[first, rest], model.invert(whole, 50.0))


def test_arguments_are_left_as_they_are():
    u = np.linspace(0.0, 1.0, 9)
    kept, state = u.copy(), PLAYS.init()
    memory = state.memory.copy()
    PLAYS.step(state, u)
    PLAYS.inverse_step(state, u)
    assert np.array_equal(u, kept)
    assert np.array_equal(state.memory, memory)


def test_dead_zones_are_those_of_the_formula_and_have_an_inverse():
    h = np.linspace(-3.0, 3.0, 601)
    expected = h + 0.6 * np.minimum(h + 1, 0) + 0.4 * np.maximum(h - 0.5, 0)
    expected = expected - 0.7 * np.maximum(h - 1.5, 0)
    assert np.abs(ZONES.apply(h) - expected).max() <= rounding(h)
    assert np.abs(ZONES.invert(ZONES.apply(h)) - h).max() <= rounding(h)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: PrandtlIshlinskii(1.0, (0.3, 0.2), (1.0, 1.0)), "ascend from above 0"),
        (lambda: PrandtlIshlinskii(1.0, (0.3,), ()), "1 thresholds and 0 weights"),
        (lambda: PrandtlIshlinskii(1.0, (0.3,), (1.0,), 0.0, -1.0), "0 s or more"),
        (lambda: BoucWen(1.0, 1.0, 0.0), "above 0, 0.5 or more, and 1 or more"),
        (lambda: BoucWen(1.0, np.nan, 1.0), "they must be finite"),
        (lambda: DeadZones((1.0, 0.0), (1.0, 1.0)), "must ascend"),
        (lambda: DeadZones((1.0,), (-1.0,)).invert([2.0]), "slopes above 0"),
        (lambda: PLAYS.simulate([0.0, np.nan]), "finite vector"),
        (lambda: PLAYS.simulate([0.0], 0.0), "rate_hz = 0 Hz"),
        (lambda: PrandtlIshlinskii(0.0, (0.3,), (1.0,)).invert([1.0]), "of one sign"),
        (lambda: PrandtlIshlinskii(1.0, (0.3,), (-1.0,)).invert([1.0]), "of one sign"),
        (lambda: BoucWen(1.0, -0.6, 1.0).invert([1.0]), "Use play operators"),
        (
            lambda: PrandtlIshlinskii(1.0, (0.3,), (1.0,), 0.0, 0.1).invert([1.0], 100.0),
            "diverges; it must be below 1",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, match):
    with pytest.raises(InputError, match=match):
        make()


def test_the_feedback_of_the_inverse_shows_when_it_diverges():
    """On a ramp the recursion of the inverse has the eigenvalues that `feedback` stands for."""
    rate_hz, y = 100.0, np.linspace(0.0, 1.0, 200)
    for filter_s, stable in ((0.04, False), (0.06, True)):
        model = PrandtlIshlinskii(1.0, (0.05,), (1.0,), 0.0, 0.1, filter_s)
        assert (model.feedback(rate_hz) < 1.0) == stable
        if stable:
            u = model.invert(y, rate_hz)
            assert np.abs(np.diff(u, 2)[150:]).max() < 1e-3 * np.abs(np.diff(u)).max()
