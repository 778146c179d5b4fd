"""Wrong units, volts, signs and masses are named before a fit, for each kind of actuator."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import (
    ACTUATORS,
    GRAVITY_M_S2,
    CurlingHasel,
    DeaStack,
    Drive,
    PeanoHasel,
    PlanarHasel,
    SampledLaw,
)
from haselab.identify.physical import MotionRecord, fit_actuator
from haselab.identify.physical.plausible import find_implausible
from haselab.scoreboard.devices import DEVICES, find_device
from haselab.scoreboard.knowledge import TRAINED, simulated_record

KINDS = {
    "planar-hasel": (PlanarHasel(), 0.25, 8e3),
    "peano-hasel": (PeanoHasel(), 0.1, 7e3),
    "curling-hasel": (CurlingHasel(curl_rad=0.5), 0.05, 8e3),
    "dea-stack": (DeaStack(), 0.2, 9e3),
}
GAIN = 5e3
FACTORS = (1.0, 1.5)  # of the masses of two records
STD_M, STD_F = 4e-6, 3e-13


def played(law, mass_kg, highest_v):
    """Two seconds of a law, a step to the highest voltage after one."""
    edge_s = np.linspace(0.0, 2.0, 201)
    volt = np.where(edge_s[:-1] < 1.0, 0.0, highest_v)
    load_n, masses_kg = np.full(200, mass_kg * GRAVITY_M_S2), np.full(200, mass_kg)
    drive = Drive(edge_s, volt, load_n, masses_kg, np.full(200, 5e3))
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(0.0, 5e3, float(load_n[0]))
    found = sampled.respond(drive, edge_s[:-1], start)
    every, none = np.arange(200), np.zeros(200, np.int64)
    return MotionRecord(
        f"{mass_kg:g} kg", drive, edge_s[:-1], found.length_m, np.full(200, STD_M), every, every,
        found.capacitance_f, np.full(200, STD_F), ("all",), none, none,
    )  # fmt: skip


@pytest.fixture(scope="module", params=list(KINDS))
def seen(request):
    """Law and record of a kind."""
    law, mass_kg, highest_v = KINDS[request.param]
    return law, played(law, mass_kg, highest_v)


def scaled(record, **factors):
    return replace(record, **{name: f * getattr(record, name) for name, f in factors.items()})


def driven(record, factor):
    drive = record.drive
    ripple_v2 = factor**2 * drive.ripple_v2
    return replace(
        record, drive=replace(drive, voltage_v=factor * drive.voltage_v, ripple_v2=ripple_v2)
    )


def timed(record, factor):
    drive = record.drive
    return replace(
        record, drive=replace(drive, edge_s=factor * drive.edge_s),
        length_time_s=factor * record.length_time_s,
    )  # fmt: skip


def clipped(record):
    """A converter that ends below the highest capacitance, with noise below its end."""
    noisy = record.capacitance_f + STD_F * np.random.default_rng(1).normal(size=200)
    return replace(record, capacitance_f=np.minimum(noisy, np.quantile(noisy, 0.6)))


def mirrored(record):
    return replace(record, length_m=2.0 * record.length_m[0] - record.length_m)


def loaded(record, factor):
    drive = record.drive
    return replace(record, drive=replace(
        drive, load_n=factor * drive.load_n, mass_kg=factor * drive.mass_kg
    ))  # fmt: skip


def test_a_plausible_record_has_no_fault(seen):
    law, record = seen
    assert find_implausible(law, [record]) == ""


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (lambda r: scaled(r, length_m=1e3, length_std_m=1e3), "Check the unit of the lengths"),
        (lambda r: scaled(r, length_m=1e-3, length_std_m=1e-3), "Check the unit of the lengths"),
        (
            lambda r: scaled(r, capacitance_f=1e12, capacitance_std_f=1e12),
            "Check the unit of the capacitances",
        ),
        (lambda r: driven(r, 1.0 / GAIN), "not those at the amplifier's input"),
        (lambda r: driven(r, GAIN), "the amplifier's gain is not counted twice"),
        (lambda r: driven(r, 1e-3), "check the amplifier's gain and the unit of the voltage (V)"),
        (lambda r: timed(r, 1e3), "if all times were 1000 times shorter"),
        (lambda r: timed(r, 1e-3), "if all times were 1000 times longer"),
        (lambda r: timed(r, 1.0 / 60.0), "if all times were 60 times longer"),
        (mirrored, "the lengths grow where the actuator contracts"),
    ],
    ids=["mm", "km", "pF", "input volts", "gain twice", "kV", "ms", "s for ms", "min", "sign"],
)
def test_swapped_units_and_volts_are_named_without_numbers(seen, bad, words):
    law, record = seen
    fit = fit_actuator(law, [record, bad(record)], mass_kg=float(record.drive.mass_kg[0]))
    assert words in fit.status and not fit.parameters


def test_clipped_capacitances_are_named_and_values_that_rest_are_not(seen):
    """The record has no noise, so before the step all its values are at one end, exactly."""
    law, record = seen
    ramp = np.linspace(0.0, record.drive.voltage_v.max(), 200)
    moving = replace(record, drive=replace(record.drive, voltage_v=ramp))
    assert "capacitances are exactly" in find_implausible(law, [clipped(moving)])
    assert "exactly" not in find_implausible(law, [record])
    coarse = replace(moving, capacitance_f=np.round(record.capacitance_f, 11))
    assert "exactly" not in find_implausible(law, [coarse])


def test_a_record_without_motion_may_have_a_small_drive(seen):
    law, record = seen
    small = driven(record, 1.0 / GAIN)
    rng = np.random.default_rng(1)
    still = replace(small, length_m=record.length_m[0] + STD_M * rng.standard_normal(200))
    assert find_implausible(law, [still]) == ""


def test_starts_that_are_off_find_no_fault(seen):
    """Stiffness and inertia of the start move the resonance, by up to a fifth."""
    law, record = seen
    mass_kg, highest_v = float(record.drive.mass_kg[0]), float(record.drive.voltage_v.max())
    for factor in (0.7, 1.4):
        heavier = loaded(played(law, factor * mass_kg, highest_v), 1.0 / factor)
        assert find_implausible(law, [heavier]) == ""


def test_a_lighter_mass_that_stretches_more_is_named_without_numbers(seen):
    law, record = seen
    mass_kg, highest_v = float(record.drive.mass_kg[0]), float(record.drive.voltage_v.max())
    records = [played(law, f * mass_kg, highest_v) for f in FACTORS]
    assert find_implausible(law, records) == ""
    swapped = [
        loaded(r, f / own) for r, f, own in zip(records, FACTORS[::-1], FACTORS, strict=True)
    ]
    fit = fit_actuator(law, swapped, mass_kg=1.5 * mass_kg)
    assert "Check the masses, which may be swapped" in fit.status and not fit.parameters


def test_a_record_of_one_length_and_many_capacitances_is_compared_with_no_motion(seen):
    law, record = seen
    one = replace(
        record, length_time_s=record.length_time_s[:1], length_m=record.length_m[:1],
        length_std_m=record.length_std_m[:1], length_experiment=record.length_experiment[:1],
    )  # fmt: skip
    assert find_implausible(law, [one]) == ""


@pytest.mark.parametrize("name", list(DEVICES))
def test_a_short_study_of_any_device_is_plausible_until_masses_are_swapped(name):
    """A mass is lifted for 0.2 s, in which the slow devices hardly move."""
    device = find_device(name)
    law = ACTUATORS.find(device.config.kind)()
    record = simulated_record(device, np.random.default_rng(1))
    assert find_implausible(law, [record]) == ""
    mass_kg = record.drive.mass_kg
    light, heavy = mass_kg == 0.6 * device.mass_kg, mass_kg == TRAINED * device.mass_kg
    stated_kg = np.where(light, TRAINED * device.mass_kg, mass_kg)
    stated_kg[heavy] = 0.6 * device.mass_kg
    swapped = replace(record.drive, mass_kg=stated_kg, load_n=GRAVITY_M_S2 * stated_kg)
    assert "masses, which may be swapped" in find_implausible(law, [replace(record, drive=swapped)])


@pytest.mark.parametrize("inertia_kg", [0.5, 1.0, 2.0])
def test_motion_above_the_resonance_is_no_wrong_sign(inertia_kg):
    """There an actuator moves against its drive; the inertia is not known beforehand."""
    law, edge_s = DeaStack(), np.linspace(0.0, 4.0, 401)
    sine = np.sin(2.0 * np.pi * 6.0 * edge_s[:-1])
    volt = 5e3 * np.sqrt(1.0 + sine)
    weight = np.full(400, 0.2 * GRAVITY_M_S2)
    drive = Drive(edge_s, volt, weight, np.full(400, 0.2), np.zeros(400))
    sampled = SampledLaw(law, 8e3, added_inertia_kg=inertia_kg)
    start, _ = sampled.at_rest(float(volt[0]), 0.0, float(weight[0]))
    found = sampled.respond(drive, edge_s[:-1], start)
    none, no = np.zeros(0, np.int64), np.zeros(0)
    record = MotionRecord(
        "sine", drive, edge_s[:-1], found.length_m, np.full(400, STD_M), none, none, no, no,
        ("all",), np.zeros(400, np.int64), none,
    )  # fmt: skip
    assert find_implausible(law, [record]) == ""


def test_changes_of_the_load_at_a_small_constant_voltage_are_no_motion_by_the_drive(seen):
    law, record = seen
    offset = replace(record.drive, voltage_v=np.full(200, 5.0))
    assert find_implausible(law, [replace(record, drive=offset)]) == ""


def test_a_rest_before_the_drive_is_not_clipped(seen):
    """The first value after the voltage has changed is still that of the rest."""
    law, record = seen
    volt = np.where(np.arange(200) < 100, 0.0, np.linspace(0.0, 1.0, 200) * 5e3)
    resting = replace(record, drive=replace(record.drive, voltage_v=volt))
    length_m = np.concatenate([
        np.full(101, record.length_m[0]), record.length_m[0] + 1e-5 * np.arange(1, 100) ** 0.5,
    ])  # fmt: skip
    sign = -1.0 if record.length_m[-1] < record.length_m[0] else 1.0
    length_m = record.length_m[0] + sign * (length_m - record.length_m[0])
    assert "exactly" not in find_implausible(law, [replace(resting, length_m=length_m)])
