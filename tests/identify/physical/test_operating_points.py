"""The general transfer function of *identified* parameters, against that of the true ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, ActuatorLaw, equilibrium_m, linearise, with_parameters
from haselab.identify.physical import fit_actuator
from tests.actuators.test_operating_point import identified, resonance

MASSES = 0.4, 0.7, 1.0, 1.3, 1.6  # over the hung mass of the record
VOLTAGES = 0.3, 0.44, 0.58, 0.72, 0.86, 1.0  # over the highest voltage of the record
# geometry changed after the identification, in another factor of each field
GEOMETRY = {
    "planar-hasel": {"shell_width_m": 0.9},
    "dea-stack": {"layers": 0.6, "side_m": 0.8},
    "peano-hasel": {"pouches": 0.6, "pouch_width_m": 0.7},
    "curling-hasel": {"cells": 0.8, "strip_width_m": 0.7},
}
ACCEPTED = 0.01, 0.01, 0.05  # of gain, natural frequency, damping ratio


def seen(law: ActuatorLaw, volt: float, mass_kg: float, inertia_kg: float = 0.0):
    load_n = mass_kg * GRAVITY_M_S2
    longest_m = 1.02 * equilibrium_m(law, volt, load_n)
    point = linearise(law, volt, load_n, mass_kg + inertia_kg, longest_m=longest_m)
    pole = point.poles[point.poles.imag.argmax()]
    return np.array([point.gain_m_per_v, abs(pole), -pole.real / abs(pole)])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("dea-stack", marks=pytest.mark.long),
        pytest.param("planar-hasel", marks=pytest.mark.long),
        pytest.param("peano-hasel", marks=pytest.mark.slow),
        pytest.param("curling-hasel", marks=pytest.mark.slow),
    ],
)
def test_parameters_of_a_noisy_record_give_30_operating_points_and_another_geometry(
    name, benchmarks
) -> None:
    """A hidden law, a minute of lengths and capacitances with noise, starts at the defaults."""
    from benchmarks.identification.physical_kinds import KINDS

    kind = KINDS[name]
    truth, record = kind.drawn(1)
    others = ("camera.", "sensing.", "load.")
    law = with_parameters(
        kind.law, {key: value for key, value in truth.items() if not key.startswith(others)}
    )
    fit = fit_actuator(kind.law, [record], mass_kg=kind.mass_kg)
    assert fit.status == "ok" and fit.law is not None
    for change in ({}, GEOMETRY[name]):
        true_law, found_law = (
            replace(one, **{field: share * getattr(one, field) for field, share in change.items()})
            for one in (law, fit.law)
        )
        for share in MASSES:
            for part in VOLTAGES:
                at = part * kind.highest_v, share * kind.mass_kg
                true = seen(true_law, *at)
                far = np.abs(seen(found_law, *at, fit.added_inertia_kg) / true - 1.0)
                assert (far <= ACCEPTED).all(), (change, at, far)
    # and the transfer function that a noise-free chirp and step give there
    for part, share in ((0.3, 1.0), (1.0, 1.6)):
        at = part * kind.highest_v, share * kind.mass_kg
        _, direct = identified(law, *at)
        gain = direct.parameters["gain"]
        measured = np.array([1e-6 * gain.value, *resonance(direct)])
        found = seen(fit.law, *at, fit.added_inertia_kg)
        # a slow pole next to a zero: then the fit itself knows the static gain only roughly
        within = np.maximum(ACCEPTED, (3.0 * abs(gain.std / gain.value), 0.0, 0.0))
        assert (np.abs(found / measured - 1.0) <= within).all(), (at, found, measured)
