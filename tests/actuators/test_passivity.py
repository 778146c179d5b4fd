"""No built-in kind gains energy from a closed cycle, and its motion loses only what it states."""

import dataclasses

import numpy as np
import pytest

from haselab.actuators import (
    ActuatorLaw,
    CurlingHasel,
    DeaStack,
    Drive,
    PeanoHasel,
    PlanarHasel,
    SampledLaw,
)

KINDS = [PlanarHasel, PeanoHasel, CurlingHasel, DeaStack]
LOADED = {PlanarHasel: 0.25, PeanoHasel: 0.1, CurlingHasel: 0.05, DeaStack: 0.2}
STEP_S = 2e-4


@pytest.mark.parametrize("kind", KINDS)
def test_no_cycle_of_length_and_voltage_gains_energy(kind: type[ActuatorLaw]) -> None:
    """Around a rectangle the force and the charge do no work in all, though each side does."""
    law = kind()
    nodes, weights = np.polynomial.legendre.leggauss(200)
    share, half = 0.5 * (nodes + 1.0), 0.5 * weights
    limits = law.length_limits_m
    for low, high, low_v, high_v in ((0.3, 0.9, 0.0, 9e3), (0.6, 0.8, 1e3, 4e3)):
        ends_m = [limits.low + place * (limits.high - limits.low) for place in (low, high)]
        lengths_m = ends_m[0] + share * (ends_m[1] - ends_m[0])
        voltages_v = low_v + share * (high_v - low_v)
        work_j = []
        for voltage_v in (low_v, high_v):
            force_n = law.electric_force_n(lengths_m, voltage_v) - law.elastic_force_n(lengths_m)
            work_j.append((force_n * half).sum() * (ends_m[1] - ends_m[0]))
        for length_m in ends_m:
            charge_c = law.capacitance_f(length_m, voltages_v) * voltages_v
            work_j.append((charge_c * half).sum() * (high_v - low_v))
        low_x, high_x, at_low, at_high = work_j
        gained_j = low_x + at_high - high_x - at_low
        assert abs(gained_j) < 1e-8 * max(abs(w) for w in work_j)


def _branches(law: ActuatorLaw, length_m, force_n):
    r"""Energy stored in the branches, and power that they lose.

    A branch of share g has relaxed to the force y, that of the length X(y). It stores
    g [W(x) - W(X) - y (x - X)], and loses g (F - y)(x - X) / tau, which is never below 0 where the
    elastic force rises with the length.
    """
    limits, losses = law.length_limits_m, law.losses
    table_m = np.linspace(limits.low, limits.high, 40001)
    table_n = law.elastic_force_n(table_m)
    stored_j, lost_w = np.zeros(length_m.size), np.zeros(length_m.size)
    for share, tau_s in zip(losses.branch_share, losses.branch_relaxation_s, strict=True):
        fade = np.exp(-STEP_S / tau_s)
        relaxed_n = np.full(length_m.size, force_n[0])
        for k in range(1, length_m.size):  # the force between two samples is their mean
            mean_n = 0.5 * (force_n[k] + force_n[k - 1])
            relaxed_n[k] = mean_n + (relaxed_n[k - 1] - mean_n) * fade
        at_m = np.interp(relaxed_n, table_n, table_m)
        stored_j += share * (
            law.elastic_energy_j(length_m) - law.elastic_energy_j(at_m)
            - relaxed_n * (length_m - at_m)
        )  # fmt: skip
        lost_w += share * (force_n - relaxed_n) * (length_m - at_m) / tau_s
    return stored_j, lost_w


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_what_a_step_of_the_voltage_sets_free_goes_into_the_losses(kind) -> None:
    """Kinetic, elastic and electric energy, weight and branches fall by what the losses state."""
    law = kind()
    if law.losses.softening_share:  # its work in the first cycle is no energy of a state
        law = dataclasses.replace(law, softening_share=0.0)
    mass_kg = LOADED[kind]
    load_n = 9.81 * mass_kg
    sampled = SampledLaw(law, 9e3)
    sampled.parameters["step_s"] = STEP_S
    start, _ = sampled.at_rest(2e3, 0.0, load_n)
    times_s = STEP_S * np.arange(4000)
    count = 100
    same = np.ones(count)
    drive = Drive(
        0.01 * np.arange(count + 1), 7e3 * same, load_n * same, mass_kg * same,
        0.0 * same,
    )  # fmt: skip
    seen = sampled.respond(drive, times_s, start)
    force_n = law.elastic_force_n(seen.length_m)
    stored_j, lost_w = _branches(law, seen.length_m, force_n)
    energy_j = (
        0.5 * (mass_kg + law.moving_mass_kg) * seen.speed_m_s**2
        + law.energy_j(seen.length_m, 7e3) - load_n * seen.length_m + stored_j
    )  # fmt: skip
    assert lost_w.min() > -1e-9 * lost_w.max()
    lost_w = lost_w + law.losses.damping_n_s_per_m * seen.speed_m_s**2
    lost_j = np.concatenate([[0.0], np.cumsum(0.5 * (lost_w[1:] + lost_w[:-1]) * STEP_S)])
    assert lost_j[-1] > 0.5 * np.ptp(energy_j) > 0.0
    # trapezia of 0.2 ms, up to 0.05 rad of the fastest motion: 0.05^2 / 12 of the loss
    np.testing.assert_allclose(energy_j - energy_j[0], -lost_j, atol=1e-3 * lost_j[-1])
    assert (np.diff(energy_j) < 1e-6 * lost_j[-1]).all()
