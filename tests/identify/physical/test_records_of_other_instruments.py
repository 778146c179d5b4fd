"""Steps of a converter and errors of the clock, which move estimates further than white noise."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, DeaStack, Drive, SampledLaw
from haselab.identify.physical import fit_actuator
from haselab.identify.physical.information import covariance_of, vague_information
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.misstated import clock_std
from haselab.identify.physical.search import refine
from haselab.identify.physical.unknowns import CAMERA_OFFSET, CAMERA_SCALE, Unknowns
from haselab.pipelines.motion_table import motion_of_table

LAW, MASSES_KG = DeaStack(), (0.15, 0.25)
LENGTH_STD_M, CAPACITANCE_STD_F = 2e-6, 1e-12
KNOWN = {CAMERA_OFFSET: 5e-5, CAMERA_SCALE: 5e-5}


def recorded(seed, mass_kg, *, step_m=0.0, clock=1.0, rows=1800):
    """A table of a triangle, long steps and held random voltages; lengths in steps."""
    rng = np.random.default_rng(seed)
    third = rows // 3
    time_s = 0.01 * np.arange(rows)
    volt = np.concatenate([
        8e3 * (1.0 - np.abs(np.linspace(-1.0, 1.0, third))),
        np.repeat(rng.uniform(0.0, 8e3, 4), third // 4),
        np.repeat(rng.uniform(0.0, 8e3, third // 30), 30),
    ])  # fmt: skip
    same = np.ones(rows)
    drive = Drive(np.append(time_s, 0.01 * rows), volt, mass_kg * GRAVITY_M_S2 * same,
                  mass_kg * same, 0.0 * same)  # fmt: skip
    sampled = SampledLaw(LAW, 10e3)
    start, _ = sampled.at_rest(0.0, 0.0, mass_kg * GRAVITY_M_S2)
    seen_m = sampled.respond(drive, time_s, start).length_m
    length_m = seen_m + LENGTH_STD_M * rng.standard_normal(rows)
    if step_m:
        length_m = np.round(length_m / step_m) * step_m
    capacitance_f = LAW.capacitance_f(seen_m) + CAPACITANCE_STD_F * rng.standard_normal(rows)
    return motion_of_table(f"{mass_kg} kg", clock * time_s, volt, mass_kg=mass_kg,
                           length_m=length_m, capacitance_f=capacitance_f)  # fmt: skip


def both(seed, **options):
    return [recorded(seed + k, mass, **options) for k, mass in enumerate(MASSES_KG)]


def fitted(records):
    """Misfit and minimum from the truth on, with the true noise."""
    records = [
        replace(one, length_std_m=np.full(one.length_m.size, LENGTH_STD_M),
                capacitance_std_f=np.full(one.capacitance_f.size, CAPACITANCE_STD_F))
        for one in records
    ]  # fmt: skip
    misfit = Misfit(records, known=KNOWN)
    start = Unknowns.of(LAW, added_inertia_kg=0.0, mass_kg=MASSES_KG[1])
    return misfit, refine(misfit, start)


def test_values_in_coarse_steps_are_runs_that_share_an_error():
    fine, coarse = (Misfit([recorded(1, 0.2, step_m=step_m)]) for step_m in (0.0, 2e-5))
    assert np.array_equal(fine.runs, np.arange(fine.runs.size))
    length_m = coarse.records[0].length_m
    changes = np.count_nonzero(np.diff(length_m)) + 1
    assert coarse.runs[-1] + 1 == changes + coarse.records[0].capacitance_f.size
    assert all(np.ptp(length_m[coarse.runs[: length_m.size] == k]) == 0.0 for k in range(changes))


@pytest.mark.slow
def test_the_intervals_allow_for_coarse_steps_of_the_lengths():
    inside, count = 0, 0
    for seed in (10, 20, 30, 40):
        fit = fit_actuator(LAW, both(seed, step_m=2e-5), mass_kg=MASSES_KG[1], camera_bias_m=5e-5)
        assert fit.status == "ok"
        assert "in steps of 2e-05 m" in fit.notes[0] and "allow for it" in fit.notes[0]
        unknowns = Unknowns.of(LAW, added_inertia_kg=0.0, mass_kg=MASSES_KG[1])
        for name, true in zip(unknowns.names, unknowns.values.tolist(), strict=True):
            found = fit.parameters[name]
            if name not in fit.not_identifiable:
                low, high = found.ci95
                inside, count = inside + (low <= true <= high), count + 1
    # 3 of 60 are outside by chance; their number varies by 1.7
    assert count >= 48 and inside >= count - 4


def test_an_error_of_the_clock_moves_the_estimates_as_far_as_the_intervals_allow():
    misfit, right = fitted(both(1))
    _, wrong = fitted(both(1, clock=1.001))
    prior = vague_information(right.unknowns)
    expected = clock_std(misfit, right, 1e-3, prior)
    moved = np.abs(wrong.unknowns.distance(right.unknowns))
    std = np.sqrt(np.diag(covariance_of([right.jacobian, np.diag(np.sqrt(prior))])))
    names = list(right.unknowns.names)
    for name in ("actuator.shear_modulus_pa", "sensing.scale", "load.added_inertia_kg"):
        k = names.index(name)
        # a search may end 0.3 standard deviations from the minimum
        assert moved[k] > std[k] and abs(expected[k] - moved[k]) < 0.3 * std[k], name
    assert not clock_std(misfit, right, 0.0, prior).any()


@pytest.mark.parametrize("added_kg", [0.5, 2.0])
def test_an_inertia_above_the_hung_mass_is_found_from_a_chirp(added_kg):
    """For example a lever or a plate, which the usual start of the search does not expect.

    A time of twice the true one would imitate 3 masses, so a larger one is only suggested.
    """
    mass_kg, rows, rng = 0.2, 1000, np.random.default_rng(12)
    time_s, same = 0.02 * np.arange(rows), np.ones(rows)
    volt = 8e3 * (0.6 + 0.35 * np.sin(2.0 * np.pi * (0.2 * time_s + 0.2 * time_s**2)))
    volt[time_s < 1.0] = 0.0
    drive = Drive(np.append(time_s, 0.02 * rows), volt, mass_kg * GRAVITY_M_S2 * same,
                  (mass_kg + added_kg) * same, 0.0 * same)  # fmt: skip
    sampled = SampledLaw(LAW, 10e3)
    start, _ = sampled.at_rest(0.0, 0.0, mass_kg * GRAVITY_M_S2)
    seen_m = sampled.respond(drive, time_s, start).length_m
    record = motion_of_table(
        "chirp", time_s, volt, mass_kg=mass_kg,
        length_m=seen_m + LENGTH_STD_M * rng.standard_normal(rows),
        capacitance_f=LAW.capacitance_f(seen_m) + CAPACITANCE_STD_F * rng.standard_normal(rows),
    )  # fmt: skip
    fit = fit_actuator(LAW, [record], mass_kg=mass_kg, camera_bias_m=5e-5)
    if added_kg > 4.0 * mass_kg:
        assert not fit.parameters
        assert "An added inertia of 2 kg" in fit.status
        assert fit.status.endswith("if they are right, begin there with --added-inertia-kg 2")
        fit = fit_actuator(
            LAW, [record], mass_kg=mass_kg, camera_bias_m=5e-5, added_inertia_kg=added_kg
        )
    else:
        assert "The added inertia is 2.5 times the hung mass" in fit.notes[0]
    assert fit.status == "ok", fit.status
    found = fit.parameters["load.added_inertia_kg"]
    assert abs(found.value - added_kg) < 4.0 * found.std < 0.1 * added_kg
