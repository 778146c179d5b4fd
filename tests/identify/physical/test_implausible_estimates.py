"""A wrong mass, gain or time that a camera alone cannot show moves the estimates, and is named."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, DeaStack, Drive, PeanoHasel, SampledLaw
from haselab.identify.physical import fit_actuator
from haselab.identify.physical.plausible import find_implausible
from haselab.pipelines.motion_table import motion_of_table

MASS_KG, HIGHEST_V, STD_M = 0.2, 8e3, 4e-6
START = DeaStack()


def acting(rows, step_s):
    time_s = step_s * np.arange(rows)
    rng = np.random.default_rng(1)
    levels = np.append(0.0, HIGHEST_V * rng.uniform(0.0, 1.0, 12))
    return time_s, levels[np.arange(rows) // (rows // 12)]


def moved(law, mass_kg, time_s, voltage_v):
    """Lengths at each row, and capacitances shortly after."""
    step_s, count = time_s[1], 2 * time_s.size
    edge_s = np.append(np.stack([time_s, time_s + 0.01 * step_s], axis=1).ravel(),
                       time_s[-1] + step_s)  # fmt: skip
    weight, masses_kg = np.full(count, mass_kg * GRAVITY_M_S2), np.full(count, mass_kg)
    drive = Drive(edge_s, np.repeat(voltage_v, 2), weight, masses_kg, np.zeros(count))
    sampled = SampledLaw(law, 1e4)
    start, _ = sampled.at_rest(float(voltage_v[0]), 0.0, float(weight[0]))
    found = sampled.respond(drive, time_s, start)
    noise_m = STD_M * np.random.default_rng(2).standard_normal(time_s.size)
    return found.length_m + noise_m, found.capacitance_f[::2]


@pytest.fixture(scope="module")
def table():
    """What a camera sees of a stack that is near the start values."""
    law = replace(START, shear_modulus_pa=17e3, permittivity=2.8, layer_thickness_m=0.00068)
    time_s, voltage_v = acting(1200, 0.01)
    return time_s, voltage_v, moved(law, MASS_KG, time_s, voltage_v)[0]


def fitted(table, *, mass=1.0, volts=1.0, times=1.0):
    time_s, voltage_v, length_m = table
    record = motion_of_table(
        "table", times * time_s, volts * voltage_v, mass_kg=mass * MASS_KG, length_m=length_m
    )
    return fit_actuator(START, [record], mass_kg=mass * MASS_KG, camera_bias_m=5e-5, clock_std=1e-3)


def test_a_right_record_has_numbers_and_no_such_note(table):
    fit = fitted(table)
    assert fit.status == "ok"
    assert not any("same effect" in note for note in fit.notes)


def test_a_material_that_is_five_times_stiffer_is_no_wrong_mass():
    """Its permittivity is usual; a mass stated too high would raise both."""
    law = replace(START, shear_modulus_pa=5.0 * START.shear_modulus_pa)
    time_s, voltage_v = acting(1200, 0.01)
    fit = fitted((time_s, voltage_v, moved(law, MASS_KG, time_s, voltage_v)[0]))
    assert fit.status == "ok"
    found = fit.parameters["actuator.shear_modulus_pa"]
    assert found.value == pytest.approx(law.shear_modulus_pa, abs=4.0 * found.std)


@pytest.mark.parametrize("factor", [10.0, 5.0])
def test_a_mass_that_is_far_too_high_has_no_numbers(table, factor):
    fit = fitted(table, mass=factor)
    assert not fit.parameters
    assert "A mass that is stated" in fit.status and "too high" in fit.status


def test_a_mass_stated_two_times_too_high_has_a_note_that_names_it(table):
    fit = fitted(table, mass=2.0)
    (note,) = [note for note in fit.notes if "A mass that is stated" in note]
    assert "too high" in note
    assert "actuator.shear_modulus_pa" in note and "actuator.permittivity" in note


def test_a_gain_that_is_far_too_low_has_no_numbers(table):
    fit = fitted(table, volts=0.25)
    assert not fit.parameters and "gain of the amplifier" in fit.status
    assert "too low" in fit.status and "actuator.permittivity" in fit.status


def test_times_of_half_the_frame_rate_have_no_numbers(table):
    """Only a part of the hung mass would move."""
    fit = fitted(table, times=0.5)
    assert not fit.parameters
    assert "would move" in fit.status and "frame rate" in fit.status


@pytest.mark.parametrize("times", [1e3, 60.0, 10.0, 0.1, 1.0 / 60.0, 1e-3])
def test_a_wrong_unit_of_the_times_is_named_before_the_fit(table, times):
    time_s, voltage_v, length_m = table
    record = motion_of_table("table", times * time_s, voltage_v, mass_kg=MASS_KG, length_m=length_m)
    change = f"{times:g} times shorter" if times > 1.0 else f"{1.0 / times:g} times longer"
    assert f"if all times were {change}" in find_implausible(START, [record])


@pytest.mark.parametrize("times", [1e3, 60.0, 1.0 / 60.0, 1e-3])
def test_capacitances_alone_show_a_wrong_unit_of_the_times(times):
    """Those of pouches follow the voltage at once, and the motion only in part."""
    law = PeanoHasel()
    time_s, voltage_v = acting(600, 0.01)
    capacitance_f = moved(law, 0.1, time_s, voltage_v)[1]
    capacitance_f = capacitance_f + 3e-13 * np.random.default_rng(3).standard_normal(600)
    for factor, wrong in ((1.0, False), (times, True)):
        record = motion_of_table(
            "table", factor * time_s, voltage_v, mass_kg=0.1, capacitance_f=capacitance_f
        )
        assert ("capacitances do not follow" in find_implausible(law, [record])) == wrong


def test_a_stated_inertia_is_no_wrong_unit_of_the_times():
    """A lever of 20 kg makes a stack ten times slower."""
    time_s, voltage_v = acting(1200, 0.05)
    step_s, weight = time_s[1], np.full(1200, MASS_KG * GRAVITY_M_S2)
    drive = Drive(np.append(time_s, time_s[-1] + step_s), voltage_v, weight,
                  np.full(1200, MASS_KG), np.zeros(1200))  # fmt: skip
    sampled = SampledLaw(START, 1e4, added_inertia_kg=20.0)
    start, _ = sampled.at_rest(float(voltage_v[0]), 0.0, float(weight[0]))
    seen_m = sampled.respond(drive, time_s, start).length_m
    seen_m = seen_m + STD_M * np.random.default_rng(4).standard_normal(1200)
    record = motion_of_table("table", time_s, voltage_v, mass_kg=MASS_KG, length_m=seen_m)
    assert find_implausible(START, [record], 20.0) == ""
