"""Lengths of a wrong scale, which a small effect that the law lacks may imitate."""

import dataclasses

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, DeaStack, Drive, SampledLaw
from haselab.identify.physical import MotionRecord, fit_actuator

LAW = DeaStack()
MASS_KG, BLOCKS = 0.2, 2000
LENGTH_STD_M, CAPACITANCE_STD_F = 4e-6, 3e-13


def played(law, seed, mass_kg, scale=1.0):
    """A table of 20 s at 100 Hz, under random voltages that are held for some time."""
    rng = np.random.default_rng([seed, 9])
    block, at_rest = np.arange(BLOCKS), 100
    changes = rng.random(BLOCKS) < np.where(block % 1000 < 300, 0.05, 0.005)
    volt = rng.uniform(0.0, 9000.0, BLOCKS)[np.maximum.accumulate(changes * block)]
    volt[:at_rest] = 0.0
    edge_s = 0.01 * np.arange(BLOCKS + 1)
    pull_n = np.full(BLOCKS, mass_kg * GRAVITY_M_S2)
    drive = Drive(edge_s, volt, pull_n, np.full(BLOCKS, mass_kg), np.zeros(BLOCKS))
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(0.0, 0.0, float(pull_n[0]))
    found = sampled.respond(drive, edge_s[:-1], start)
    none = np.zeros(BLOCKS, np.int64)
    return MotionRecord(
        f"table {seed}", drive, edge_s[:-1],
        scale * found.length_m + LENGTH_STD_M * rng.standard_normal(BLOCKS),
        np.full(BLOCKS, LENGTH_STD_M), block, block,
        found.capacitance_f + CAPACITANCE_STD_F * rng.standard_normal(BLOCKS),
        np.full(BLOCKS, CAPACITANCE_STD_F), ("all",), none, none,
    )  # fmt: skip


def fitted(law, scale=1.0):
    records = [played(law, 3, MASS_KG, scale), played(law, 4, 1.5 * MASS_KG, scale)]
    return fit_actuator(LAW, records, mass_kg=MASS_KG, camera_bias_m=50e-6)


@pytest.mark.long
def test_a_wrong_scale_of_the_lengths_is_no_effect_of_the_actuator():
    fit = fitted(LAW, 1.01)
    assert fit.status.startswith("model error: lengths that are 1.0")
    scale = fit.parameters["camera.scale"].value
    assert scale == pytest.approx(1.01, abs=2e-3)  # a fifth of the error
    assert f"are {scale:.4f} times the true ones" in fit.status
    assert fit.law.losses.hysteresis_n == 0.0 and len(fit.law.losses.branch_share) == 2
    assert not any(name.startswith("drift") for name in fit.parameters)
    true = {"branch_share": LAW.losses.branch_share,
            "branch_relaxation_s": LAW.losses.branch_relaxation_s}  # fmt: skip
    for key, values in true.items():
        for k, value in enumerate(values):
            low, high = fit.parameters[f"actuator.{key}[{k}]"].ci95
            assert low <= value <= high


@pytest.mark.long
def test_a_hysteresis_is_not_taken_for_a_wrong_scale():
    law = dataclasses.replace(LAW, hysteresis_n=2e-3, hysteresis_width=0.02)
    fit = fitted(law)
    assert fit.status == "ok"
    low, high = fit.parameters["actuator.hysteresis_n"].ci95
    assert low <= 2e-3 <= high
