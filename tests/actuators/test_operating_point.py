"""The transfer function of the parameters is the one that an identification finds there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import (
    GRAVITY_M_S2,
    ActuatorLaw,
    CurlingHasel,
    DeaStack,
    Drive,
    OperatingPoint,
    PeanoHasel,
    PlanarHasel,
    SampledLaw,
    equilibrium_m,
    linearise,
)
from haselab.identify import Record, TransferFit, TransferStructure, fit_transfer

HOLD_S, COUNT = 0.02, 2000
UM = 1e-6
PLANAR = PlanarHasel()
SMALL = replace(PLANAR, length_m=0.045, shell_width_m=0.06)
THICK = replace(PLANAR, shell_thickness_m=2e-3, shell_lateral_stretch=2.2)
# law, voltage in V, hung mass in kg: 18 of the planar HASEL in three geometries, from nearly no
# voltage to the highest of the bench; the dielectric elastomer up to 97 % of
# the voltage of its collapse.
POINTS: list[tuple[ActuatorLaw, float, float]] = [
    *((law, volt, mass) for law in (PLANAR, SMALL, THICK) for mass in (0.1, 0.4)
      for volt in (100.0, 5.5e3, 10.8e3)),
    *((law, volt, mass) for law in (DeaStack(), DeaStack(layers=60.0))
      for volt, mass in ((100.0, 0.1), (11.4e3, 0.1), (11.9e3, 0.3))),
    (PeanoHasel(), 100.0, 0.1), (PeanoHasel(), 4e3, 0.1), (PeanoHasel(), 8e3, 0.3),
    (PeanoHasel(pouches=3.0), 4e3, 0.2),
    (CurlingHasel(), 500.0, 0.3), (CurlingHasel(), 6e3, 0.1),
]  # fmt: skip


def identified(law: ActuatorLaw, volt: float, mass_kg: float) -> tuple[OperatingPoint, TransferFit]:
    """The linear model there, and the fit of a chirp and a step of 1e-4 of the voltage."""
    load_n = mass_kg * GRAVITY_M_S2
    longest_m = 1.02 * equilibrium_m(law, volt, load_n)
    point = linearise(law, volt, load_n, mass_kg, longest_m=longest_m)
    time_s, width_v = HOLD_S * np.arange(COUNT), 1e-4 * volt
    chirp = np.sin(2.0 * np.pi * (0.05 + 0.5 * 12.0 / time_s[-1] * time_s) * time_s)
    sampled = SampledLaw(law, volt + width_v)
    start, _ = sampled.at_rest(volt, 0.0, load_n, longest_m=longest_m)
    records = []
    for shape in (chirp, np.where(np.arange(COUNT) < 200, 0.0, 1.0)):
        acts = Drive(
            HOLD_S * np.arange(COUNT + 1), volt + width_v * shape,
            np.full(COUNT, load_n), np.full(COUNT, mass_kg), np.zeros(COUNT),
        )  # fmt: skip
        seen = sampled.respond(acts, time_s, start)
        moved = (seen.length_m - point.length_m) / UM
        records.append(Record(width_v * shape, 1.0 / HOLD_S, moved, time_s))
    poles = point.poles.size
    structure = TransferStructure(poles=poles, zeros=poles - 2, delay=0.0)
    return point, fit_transfer(records, structure, applied=True)  # without noise, none is white


def resonance(fit: TransferFit) -> tuple[float, float]:
    """Natural frequency and damping ratio of the underdamped factor.

    A pair of real poles is a factor, too: its damping ratio is above 1. Two models that differ in
    the order of the factors are "ambiguous" to the fit; the resonance is the same in both.
    """
    values = {name: estimate.value for name, estimate in fit.parameters.items()}
    (found,) = (
        (values[f"natural_frequency{of}_rad_s"], values[f"damping_ratio{of}"])
        for of in ("", "_2", "_3")
        if values.get(f"damping_ratio{of}", 2.0) < 1.0
    )
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "volt", "mass_kg"),
    POINTS,
    ids=[f"{k}-{p[0].kind}-{p[1]:g}V-{p[2]:g}kg" for k, p in enumerate(POINTS)],
)
def test_the_general_transfer_function_is_the_one_that_an_identification_finds(
    law: ActuatorLaw, volt: float, mass_kg: float
) -> None:
    """Accepted: gain and natural frequency within 1 %, damping within 5 %.

    An amplitude of 1e-4 of the voltage changes the gain by as much, and by thirty times as much at
    97 % of the voltage of collapse. Frequency and damping change with its mean only, which is 0 for
    the chirp.
    """
    point, fit = identified(law, volt, mass_kg)
    pole = point.poles[np.argmax(point.poles.imag)]
    omega, zeta = resonance(fit)
    assert fit.parameters["gain"].value * UM == pytest.approx(point.gain_m_per_v, rel=5e-3)
    assert omega == pytest.approx(abs(pole), rel=1e-4)
    assert zeta == pytest.approx(-pole.real / abs(pole), rel=1e-3)


def test_the_formula_of_the_page_is_the_state_space_model() -> None:
    """One force balance, written once by hand and once in states, at several frequencies."""
    law = replace(PLANAR, charge_share=0.2)
    volt, mass_kg = 6e3, 0.3
    point = linearise(law, volt, mass_kg * GRAVITY_M_S2, mass_kg, longest_m=0.08)
    losses, length_m, step_m = law.losses, point.length_m, 1e-5
    s = 1j * np.array([0.05, 0.5, 5.0, 30.0, 100.0])
    ends = length_m + step_m * np.array([-1.0, 1.0])
    soft = float(losses.softening(0.08 / law.free_length_m))
    stiffness = soft * float(np.diff(law.elastic_force_n(ends))[0]) / (2.0 * step_m)
    pull = float(np.diff(law.electric_force_n(ends, volt))[0]) / (2.0 * step_m)
    per_v = volt * float(np.diff(law.capacitance_f(ends))[0]) / (2.0 * step_m)
    branches = sum(
        share * tau * s / (1.0 + tau * s)
        for share, tau in zip(losses.branch_share, losses.branch_relaxation_s, strict=True)
    )
    late = 1.0 - 0.2 + 0.2 / (1.0 + losses.charge_relaxation_s * s)
    below = mass_kg * s**2 + losses.damping_n_s_per_m * s + stiffness * (1.0 + branches) - pull
    states = np.eye(point.b.size)
    found = [point.c @ np.linalg.solve(value * states - point.a, point.b) for value in s]
    # derivatives are differences over 1e-5 m and 3.6e-6 m of a length of 0.05 m
    np.testing.assert_allclose(found, per_v * late / below, rtol=1e-6)
