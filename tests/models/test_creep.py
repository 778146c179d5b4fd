"""Creep models against integrals, series and sums that share nothing with them."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erfcx

from haselab.base import InputError
from haselab.models import Creep, FractionalCreep, PowerCreep, PronyCreep, mittag_leffler


@pytest.mark.parametrize("order", [0.1, 0.35, 0.6, 0.85, 0.97])
@pytest.mark.parametrize("x", [0.01, 0.3, 1.0, 4.0, 30.0])
def test_mittag_leffler_is_its_spectral_integral(order, x):
    """A sum of decays with a known density, for orders below 1."""
    angle = math.pi * order

    def density(s):
        grown = math.exp(order * s)
        decay = math.exp(-math.exp(s) * x ** (1.0 / order))
        return (
            math.sin(angle)
            / math.pi
            * grown
            * decay
            / (grown * grown + 2.0 * grown * math.cos(angle) + 1.0)
        )

    low, high = -40.0 / order, math.log(750.0) - math.log(x) / order
    points = sorted({min(max(point, low), high) for point in (-1.0, 0.0, 1.0, high - 7.0)})
    expected = quad(density, low, high, points=points, epsabs=1e-12, epsrel=1e-11, limit=2000)[0]
    assert mittag_leffler(order, x) == pytest.approx(expected, abs=1e-9)


def test_mittag_leffler_is_its_series_and_its_closed_forms():
    x = np.array([0.0, 1e-6, 0.1, 0.7])
    for order in (0.3, 0.5, 0.8, 1.0):
        series = sum((-x) ** k / math.gamma(order * k + 1.0) for k in range(160))
        assert np.abs(mittag_leffler(order, x) - series).max() < 1e-12
    wide = np.logspace(-6, 6, 60)
    assert np.abs(mittag_leffler(0.5, wide) - erfcx(wide)).max() < 1e-12
    assert np.abs(mittag_leffler(1.0, wide) - np.exp(-wide)).max() < 1e-12


CREEPS = [
    PronyCreep(1.0, (0.3, 0.2), (0.5, 7.0)),
    PowerCreep(1.0, 0.1, 0.3),
    FractionalCreep(1.0, 0.4, 0.7, 2.0),
]


@pytest.mark.parametrize("creep", CREEPS)
@pytest.mark.parametrize("changes", [3, 300])
def test_any_held_input_is_the_sum_of_its_steps(creep, changes):
    rng = np.random.default_rng(2)
    u = np.zeros(400)
    for at in rng.choice(400, changes, replace=False):
        u[at:] += rng.normal()
    time_s, expected = np.arange(400) / 20.0, np.zeros(400)
    for k, change in enumerate(np.diff(u, prepend=0.0)):
        expected[k:] += change * creep.compliance(time_s[: 400 - k])
    scale = np.abs(u).max() * float(creep.compliance(20.0))
    # A fast convolution loses the rounding of its largest partial sums.
    assert np.abs(creep.simulate(u, 20.0) - expected).max() <= 1e-12 * scale * changes
    assert np.abs(Creep.simulate(creep, u, 20.0) - expected).max() <= 1e-12 * scale * changes


def test_the_inverse_of_prony_creep_gives_back_the_input():
    u = np.random.default_rng(3).normal(size=500)
    for creep in (CREEPS[0], PronyCreep(2.0, (-0.5,), (3.0,)), PronyCreep(1.0)):
        assert np.abs(creep.invert(creep.simulate(u, 10.0), 10.0) - u).max() < 1e-11


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: PronyCreep(1.0, (0.1,), ()), "1 gains and 0 time constants"),
        (lambda: PronyCreep(1.0, (0.1,), (0.0,)), "above 0"),
        (lambda: PowerCreep(1.0, 0.1, 1.5), "above 0"),
        (lambda: FractionalCreep(1.0, 0.1, 0.5, -1.0), "above 0"),
        (lambda: mittag_leffler(1.2, [0.0]), "order must be above 0 and at most 1"),
        (lambda: mittag_leffler(0.5, [-1.0]), "arguments 0 or more"),
        (lambda: CREEPS[0].simulate([[1.0]], 1.0), "finite vector"),
        (lambda: CREEPS[0].simulate([1.0], 0.0), "above 0 Hz"),
        (lambda: PronyCreep(0.0, (1.0,), (1.0,)).invert([1.0], 1.0), "no stable inverse"),
        (lambda: PronyCreep(0.1, (-1.0,), (1.0,)).invert([1.0], 1.0), "no stable inverse"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, match):
    with pytest.raises(InputError, match=match):
        make()
