"""Laws against the derivative of their energies and against each other."""

import numpy as np
import pytest

from haselab.base import InputError, LimitError
from haselab.models import (
    LAWS,
    ArrudaBoyce,
    ArrudaBoyceSeries,
    Deformation,
    Gent,
    NeoHooke,
    Ogden,
    OgdenThreeTerms,
    OgdenTwoTerms,
    Yeoh,
    inverse_langevin,
    law_from_parameters,
)

MU = 15.6e3


def invariant(length, side):
    return length**2 + side**2 + 1.0 / (length * side) ** 2


def ogden_sum(length, side, alpha):
    return length**alpha + side**alpha + (length * side) ** -alpha - 3.0


ENERGIES = [
    (NeoHooke(MU), lambda x, s: MU / 2 * (invariant(x, s) - 3)),
    (Ogden(MU, 2.35), lambda x, s: 2 * MU / 2.35**2 * ogden_sum(x, s, 2.35)),
    (
        OgdenTwoTerms(MU, 1.3, 30.0, 5.0),
        lambda x, s: (
            2 * MU / 1.3**2 * ogden_sum(x, s, 1.3) + 60.0 / 25 * ogden_sum(x, s, 5.0)
        ),
    ),
    (
        OgdenThreeTerms(MU, 1.3, 30.0, 5.0, 900.0, -2.0),
        lambda x, s: (
            2 * MU / 1.3**2 * ogden_sum(x, s, 1.3)
            + 60.0 / 25 * ogden_sum(x, s, 5.0)
            + 1800.0 / 4 * ogden_sum(x, s, -2.0)
        ),
    ),
    (
        Yeoh(7830.0, 103.0, -0.81),
        lambda x, s: np.polyval([-0.81, 103.0, 7830.0, 0.0], invariant(x, s) - 3),
    ),
    (Gent(MU, 60.0), lambda x, s: -MU * 30.0 * np.log(1 - (invariant(x, s) - 3) / 60.0)),
    (
        ArrudaBoyceSeries(MU, 3.92),
        lambda x, s: MU * sum(
            c / 3.92 ** (2 * i - 2) * (invariant(x, s) ** i - 3.0**i)
            for i, c in enumerate((1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750), start=1)
        ),
    ),
]  # fmt: skip


@pytest.mark.parametrize(("law", "energy"), ENERGIES, ids=lambda x: getattr(x, "name", ""))
@pytest.mark.parametrize("lateral", [1.0, 3.0, None])
def test_stress_is_the_derivative_of_the_energy(law, energy, lateral):
    length, step = np.array([0.9, 1.3, 1.8]), 1e-5
    side = lateral if lateral is not None else 1.0 / np.sqrt(length)

    def total(stretch):
        return energy(stretch, side if lateral is not None else 1.0 / np.sqrt(stretch))

    difference = (total(length + step) - total(length - step)) / (2 * step)
    # Central difference: step**2 of the third derivative, and the rounding of the energy.
    assert law.nominal_stress_pa(length, lateral) == pytest.approx(difference, rel=1e-6, abs=0.5)


def test_exact_chains_follow_the_series_where_it_converges_and_neo_hooke_for_long_chains():
    stretch = np.linspace(1.0, 1.6, 7)
    exact = ArrudaBoyce(MU, 4.0).nominal_stress_pa(stretch)
    series = ArrudaBoyceSeries(MU, 4.0).nominal_stress_pa(stretch)
    assert exact == pytest.approx(series, rel=1e-5, abs=1e-9)  # sixth term: 0.0004 (I1/16)^5
    long = ArrudaBoyce(MU, 1e4).nominal_stress_pa(stretch)
    assert long == pytest.approx(NeoHooke(MU).nominal_stress_pa(stretch), rel=1e-7, abs=1e-9)


def test_inverse_langevin_inverts_over_the_whole_range():
    x = np.concatenate([np.geomspace(1e-6, 500.0, 60), [0.0]])
    y = np.where(
        x < 1e-2, x / 3 - x**3 / 45, 1 / np.tanh(np.maximum(x, 1e-2)) - 1 / np.maximum(x, 1e-2)
    )
    # Near 1 the function loses digits: dx = x^2 dy, with dy one rounding of y.
    assert np.abs(inverse_langevin(y) - x).max() <= 4 * 500.0**2 * 2.3e-16


def test_a_natural_block_carries_no_stress_but_a_laterally_stretched_one_does():
    for law, _ in ENERGIES:
        assert abs(float(law.nominal_stress_pa(1.0))) < 1e-9
    assert float(NeoHooke(MU).nominal_stress_pa(1.0, 3.0)) == pytest.approx(MU * (1 - 1 / 9))


def test_stretch_beyond_the_chains_and_unknown_laws_are_refused():
    with pytest.raises(LimitError, match="lambda_m"):
        ArrudaBoyce(MU, 2.0).nominal_stress_pa(4.0)
    with pytest.raises(LimitError, match="jm"):
        Gent(MU, 5.0).nominal_stress_pa(4.0)
    with pytest.raises(LimitError, match="not strain"):
        NeoHooke(MU).nominal_stress_pa(-0.1)
    with pytest.raises(InputError, match="must be one of neo-hooke"):
        law_from_parameters("hooke", {})
    with pytest.raises(InputError, match="needs mu_pa"):
        law_from_parameters("neo-hooke", {"mu": 1.0})
    assert law_from_parameters("gent", {"mu_pa": 1.0, "jm": 9.0}) == LAWS["gent"](1.0, 9.0)


@pytest.mark.parametrize("law", [law for law, _ in ENERGIES], ids=lambda law: law.name)
def test_equal_stretch_both_ways_does_the_work_of_the_energy(law):
    energy = {known.name: energy for known, energy in ENERGIES}[law.name]
    x, step = np.array([1.2, 1.7]), 1e-5
    both = (energy(x + step, x + step) - energy(x - step, x - step)) / (2 * step)
    # Both directions are pulled, so each carries half.
    length, width = Deformation("equibiaxial").stretches(x)
    assert law.nominal_stress_pa(length, width) == pytest.approx(0.5 * both, rel=1e-6, abs=0.5)


def test_kinds_of_test_are_what_their_names_say():
    x = np.array([1.1, 2.0])
    assert Deformation().stretches(x)[1] == pytest.approx(x**-0.5)
    assert Deformation("pure_shear").stretches(x)[1].tolist() == [1.0, 1.0]
    assert Deformation("fixed_lateral", lateral_stretch=3.0).stretches(x)[1].tolist() == [3.0, 3.0]
    length, width = Deformation("prestretched", prestretch=2.0).stretches(x)
    assert (length.tolist(), width.tolist()) == ([2.2, 4.0], [2.0, 2.0])
    with pytest.raises(InputError, match="deformation = shear; it must be one of uniaxial"):
        Deformation("shear")
    with pytest.raises(InputError, match="prestretch = 0; it must be above 0"):
        Deformation("prestretched", prestretch=0.0)
    with pytest.raises(LimitError, match="not strain"):
        Deformation().stretches([0.0])


def test_an_exponent_of_zero_is_the_limit_of_small_ones():
    x = np.linspace(1.0, 3.0, 5)
    zero = Ogden(MU, 0.0).nominal_stress_pa(x)
    # The next term of the exponential, alpha ln(l1/l3).
    assert Ogden(MU, 1e-6).nominal_stress_pa(x) == pytest.approx(zero, rel=3e-6, abs=1e-9)
