"""Slow changes of stiffness and permittivity: against the twin, and their derivatives."""

import dataclasses

import numpy as np
import pytest

from haselab.actuators import DRIFTS, Drive, PeanoHasel, PlanarHasel, SampledLaw
from haselab.actuators.losses import drift_pairs
from haselab.base import LimitError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import native_bench

LOAD_N, MASS_KG, STEPS = 0.25 * 9.81, 0.25, 100
VALUES = dict(zip(DRIFTS, (-1e-3, 20.0, 5e-4, 10.0), strict=True))


def held(count, seed=1, highest_v=8e3):
    """Random voltages, each held for 0.1 s."""
    volt = np.repeat(np.random.default_rng(seed).uniform(0.0, highest_v, count // 10), 10)
    ones = np.ones(count)
    edges = 0.01 * np.arange(count + 1)
    return Drive(edges, volt, LOAD_N * ones, MASS_KG * ones, 5e3 * ones)


def test_the_twin_that_ages_and_warms_up_moves_alike():
    """The twin has its own steps and its own factors."""
    config = TwinConfig.model_validate({
        "load": {"mass_kg": MASS_KG},
        "unmodelled": {
            "stiffness_loss": 0.02, "ageing_s": 20.0, "capacitance_rise": 0.005, "warming_s": 10.0,
            "begins_s": 120.0,
        },
    })  # fmt: skip
    bench, drive = native_bench(config, 1, noise=False), held(400)
    bench.inertia_kg, bench.carrier_v = MASS_KG, 0.02
    for share in np.linspace(0.0, 1.0, 300):  # hung slowly, then at rest
        bench.move(np.zeros(1), 1, share * LOAD_N, np.empty(STEPS))
    bench.move(np.zeros(1), 1, LOAD_N, np.empty(1_170_000))
    seen = np.empty(400 * STEPS)
    bench.move(drive.voltage_v / config.amplifier.gain, STEPS, LOAD_N, seen)
    law = SampledLaw(config.law, 10e3, drifts=VALUES)
    start, _ = law.at_rest(0.0, 5e3, LOAD_N)
    found = law.respond(drive, drive.edge_s[1:], start)
    still = SampledLaw(config.law, 10e3)
    without = still.respond(drive, drive.edge_s[1:], start)
    moved_m = np.abs(found.length_m - without.length_m).max()
    # the twin's step of 0.1 ms and ours of at most 2.5 ms are of order four; it takes each factor
    # at the beginning of a step, hence up to 2.5 ms of 10 s too early
    assert np.abs(found.length_m - seen[STEPS - 1 :: STEPS]).max() < 1e-3 * moved_m
    rise = 1.0 - 0.005 * np.expm1(-0.005 * (2 * np.arange(400) + 1) / 10.0)
    plain = config.law.capacitance_f(seen.reshape(400, STEPS)).mean(axis=1)
    assert found.capacitance_f == pytest.approx(rise * plain, rel=1e-4)


@pytest.mark.parametrize(
    "law", [PlanarHasel(charge_share=0.1, charge_relaxation_s=2.0), PeanoHasel()]
)
def test_derivatives_are_those_of_the_simulated_numbers(law):
    drive, names = held(200, highest_v=3e3), tuple(DRIFTS)
    sampled = SampledLaw(law, 11e3, names, drifts=VALUES)
    start, start_by = sampled.at_rest(drive.voltage_v[0], 5e3, LOAD_N)

    def seen(values):
        for field, pair in drift_pairs(values).items():
            sampled.parameters[field] = pair
        return sampled.respond(drive, drive.edge_s[1:], start, start_by=start_by)

    found = seen(VALUES)
    for k, name in enumerate(names):
        step = 1e-3 * abs(VALUES[name])
        low, high = (seen(VALUES | {name: VALUES[name] + s * step}) for s in (-1.0, 1.0))
        for field in ("length", "capacitance"):
            unit = field + ("_m" if field == "length" else "_f")
            change = (getattr(high, unit) - getattr(low, unit)) / (2.0 * step)
            exact = getattr(found, f"{field}_by")[:, k]
            # steps of 1e-3 leave 1e-6 by the third derivative
            assert np.linalg.norm(change - exact) < 1e-5 * np.linalg.norm(exact)


def test_a_drift_that_leaves_nothing_is_refused():
    with pytest.raises(LimitError, match=r"to less than 0\.1 of it\. Make one of them smaller\."):
        SampledLaw(PlanarHasel(), 8e3, drifts={"drift.stiffness_per_s": -0.01,
                                               "drift.stiffness_s": 100.0})  # fmt: skip


def test_no_drift_changes_nothing():
    drive, law = held(50), PlanarHasel()
    none = dict(zip(DRIFTS, (0.0, 20.0, 0.0, 10.0), strict=True))
    plain, still = SampledLaw(law, 10e3), SampledLaw(law, 10e3, drifts=none)
    start, _ = plain.at_rest(0.0, 5e3, LOAD_N)
    one, two = (sampled.respond(drive, drive.edge_s, start) for sampled in (plain, still))
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
