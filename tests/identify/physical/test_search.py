"""The search for the parameters: what the records hardly determine stays where it belongs."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, DeaStack, Drive, SampledLaw, with_parameters
from haselab.identify.physical import MotionRecord
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.search import refine, search
from haselab.identify.physical.unknowns import (
    CAMERA_OFFSET,
    CAMERA_SCALE,
    SENSING_SCALE,
    Unknowns,
)

MASS_KG = 0.2
STD_M = 4e-6


def lengths_alone() -> MotionRecord:
    """Steps under one mass, seen by a camera: only ratios of moduli and permittivity are known."""
    volt = np.repeat([0.0, 5e3, 2e3, 7e3, 0.0, 6e3], 200)
    count = volt.size
    acts = Drive(
        0.01 * np.arange(count + 1), volt, np.full(count, MASS_KG * GRAVITY_M_S2),
        np.full(count, MASS_KG), np.zeros(count),
    )  # fmt: skip
    sampled = SampledLaw(DeaStack(), 9e3)
    start, _ = sampled.at_rest(0.0, 0.0, float(acts.load_n[0]))
    times_s = 0.01 * np.arange(count)
    length_m = sampled.respond(acts, times_s, start).length_m
    none, no = np.zeros(0, dtype=np.int64), np.zeros(0)
    noise_m = STD_M * np.random.default_rng(3).standard_normal(count)
    return MotionRecord(
        "steps", acts, times_s, length_m + noise_m, np.full(count, STD_M), none, none, no, no,
        ("steps",), np.zeros(count, np.int64), none,
    )  # fmt: skip


def test_what_the_records_do_not_show_stays_where_the_user_began():
    law = with_parameters(
        DeaStack(), {"actuator.shear_modulus_pa": 20e3, "actuator.permittivity": 3.5}
    )
    start = Unknowns.of(law, added_inertia_kg=0.01, mass_kg=MASS_KG).without((CAMERA_SCALE,))
    misfit = Misfit([lengths_alone()], known={CAMERA_OFFSET: 2e-6})
    found = search(misfit, start)
    assert found.converged
    at = start.names.index(SENSING_SCALE)
    away = replace(found.unknowns, values=found.unknowns.values.copy())
    away.values[at] = 1.3  # as an earlier search may leave it
    stayed = refine(misfit, away)
    assert stayed.unknowns.value(SENSING_SCALE) == pytest.approx(1.3, abs=0.01)
    back = refine(misfit, away, begun=start)
    assert back.unknowns.value(SENSING_SCALE) == pytest.approx(1.0, abs=0.05)
    assert back.converged
