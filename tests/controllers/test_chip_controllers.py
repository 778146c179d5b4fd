"""The controllers in integers: the law is the one of their design, within its limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2
from haselab.base import InputError
from haselab.controllers import CONTROLLERS, Controller, ControllerSetting, Measurement
from haselab.controllers.chip.motion_record import motion_record
from haselab.controllers.chip.observer_design import linear_chip_loop
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.sampled_point import sampled_point
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import CLASSES
from haselab.scoreboard.plant import FastPlant

DEVICE, LOOP = find_device("hz"), CLASSES["chip-1khz"]
PARAMETERS = {
    "chip-force": {"kp": 2.8, "ki": 467.0, "kd": 0.575, "filter_s": 0.0088, "reserve": 0.15},
    "chip-observer": {"bandwidth_rad_s": 57.71, "load_n": 0.5676, "shake_m_s2": 0.04,
                      "reserve": 0.15},
}  # fmt: skip
KINDS = sorted(PARAMETERS)
VOLT = 2.0 / 32767  # resolution of the drive


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    return replace(true_actuator(DEVICE), capacitance_noise_f=1.6e-12)


def setting_of(known: KnownActuator, start_v: float) -> ControllerSetting:
    return ControllerSetting(
        LOOP.period_s, 0.0, 2.0, start_v, LOOP.delay_s, known, LOOP.sensed_before_s,
        LOOP.volt_slew_v_per_s,
    )  # fmt: skip


def started(kind: str, known: KnownActuator, start_v: float) -> Controller:
    controller = CONTROLLERS.find(kind).choose(PARAMETERS[kind]).make()
    controller.start(setting_of(known, start_v))
    return controller


def seen(strain: float, drive_v: float, valid: bool = True) -> Measurement:
    return Measurement(strain if valid else math.nan, math.nan, drive_v, 0.0, valid)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("strain", [-0.03, 0.0, 0.1, 0.2])
def test_at_rest_it_keeps_the_drive_that_holds_the_strain(
    kind: str, strain: float, known: KnownActuator
) -> None:
    drive_v = known.static_drive_v(strain)
    controller = started(kind, known, drive_v)
    found = [controller.step(strain, seen(strain, drive_v)) for _ in range(200)]
    # Tables of 15 bits over the length and 2^-12 of the root: 2^-11 of the drive, or a few codes.
    assert max(abs(value - drive_v) for value in found) < drive_v * 2.0**-11 + 4 * VOLT


def test_it_weighs_what_rests_at_a_known_drive(known: KnownActuator) -> None:
    drive_v, mass_kg = known.static_drive_v(0.05, 0.3), 0.3
    controller = started("chip-observer", known, drive_v)
    for _ in range(3):
        controller.step(0.05, seen(0.05, drive_v))
    # The mean of the load has a time constant of 40 ms, of which 3 ms have passed.
    shown = 1.0 - math.exp(-3.0 / 40.0)
    found_kg = (controller.estimated_load_kg - known.mass_kg) / shown  # type: ignore[attr-defined]
    # 2^-15 of the largest acceleration, a tenth of which is the weight: 0.1 g, divided by 0.07
    assert abs(found_kg - (mass_kg - known.mass_kg)) < 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_without_a_valid_strain_it_keeps_the_drive(kind: str, known: KnownActuator) -> None:
    drive_v = known.static_drive_v(0.0)
    controller = started(kind, known, drive_v)
    for _ in range(5):
        last_v = controller.step(0.0, seen(0.001, drive_v))
    assert {controller.step(0.1, seen(0.0, drive_v, valid=False)) for _ in range(50)} == {last_v}


@pytest.mark.parametrize("kind", KINDS)
def test_no_input_drives_it_beyond_voltage_field_or_rate(kind: str, known: KnownActuator) -> None:
    """Strains and references at random, far beyond the table and not numbers among them."""
    known = replace(known, highest_field_v_per_m=25e6)
    controller = started(kind, known, 1.0)
    rng = np.random.default_rng(5)
    strains = rng.choice([-1e30, -0.5, 0.0, 0.1, 0.28, 0.3, 5.0, 1e30, math.nan, math.inf], 4000)
    references, before_v = rng.choice([-1e9, -0.04, 0.1, 0.25, 1e9], 4000), 1.0
    controller.step(0.0, seen(0.0, 1.0))
    for strain, reference in zip(strains.tolist(), references.tolist(), strict=True):
        drive_v = controller.step(reference, seen(strain, before_v))
        assert 0.0 <= drive_v <= 2.0
        assert abs(drive_v - before_v) <= LOOP.volt_slew_v_per_s * LOOP.period_s + VOLT
        before_v = drive_v
    for _ in range(100):
        drive_v = controller.step(0.28, seen(0.28, before_v))
    assert drive_v <= known.highest_drive_v(known.length_m(0.28)) + 4 * VOLT


@pytest.mark.parametrize("strain", [0.0, 0.12])
def test_a_load_moves_the_played_loop_as_its_linear_loop_says(
    strain: float, known: KnownActuator
) -> None:
    """Without noise; the load is small, so that the actuator is linear within a per cent."""
    quiet = replace(LOOP, relative_noise=0.0)
    drive_v = known.static_drive_v(strain)
    plant = FastPlant(DEVICE, quiet, np.random.default_rng(1), 700)
    plant.train()
    plant.hold(drive_v, 40.0)
    controller, added_kg = started("chip-observer", known, drive_v), 0.004
    value_v, begin = drive_v, 500
    for k in range(700):
        if k == begin:
            plant.hang(DEVICE.mass_kg + added_kg)
        farad = plant.update(value_v)
        measured = Measurement(math.nan, farad, value_v, 0.0)
        value_v = controller.step(strain, measured)
    lengths = plant.true_lengths_m[:: LOOP.steps]
    played = lengths[begin:] - lengths[begin - 1]
    setting = setting_of(known, drive_v)
    values = tuple(PARAMETERS["chip-observer"][name]
                   for name in ("bandwidth_rad_s", "load_n", "shake_m_s2"))  # fmt: skip
    loop = linear_chip_loop(
        motion_record(setting, 0.15), setting, sampled_point(setting, strain), values
    )
    state, linear = np.zeros(loop.load.size), []
    for _ in range(played.size):
        linear.append(float(loop.length @ state))
        state = loop.a @ state + GRAVITY_M_S2 * added_kg * loop.load
    # The mean over a window of 1 ms, and half an update between both clocks: 1 ms of the motion.
    gap = np.abs(played - np.array(linear)).max()
    assert gap < 0.1 * np.abs(linear).max()


@pytest.mark.parametrize("kind", ["chip-force", "chip-observer"])
def test_the_design_for_such_an_actuator_is_refused_before_its_search(kind, monkeypatch) -> None:
    monkeypatch.setattr("haselab.controllers.chip.force.design_force", None)
    setting = setting_of(true_actuator(find_device("peano-hasel")), 0.0)
    design = CONTROLLERS.find(kind).design
    assert design is not None
    with pytest.raises(InputError, match="not proportional to the square"):
        design(setting)


def test_an_actuator_whose_force_is_not_that_of_a_square_is_refused() -> None:
    peano = true_actuator(find_device("peano-hasel"))
    with pytest.raises(InputError, match="not proportional to the square"):
        started("chip-force", peano, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_design_has_a_result_that_fits_the_integers(kind: str, known: KnownActuator) -> None:
    design = CONTROLLERS.find(kind).design
    assert design is not None
    values = design(setting_of(known, 0.0))
    CONTROLLERS.find(kind).choose(values).make().start(setting_of(known, 0.0))
    if kind == "chip-observer":
        assert values["shake_m_s2"] == 0.04


def test_an_observer_of_large_accelerations_moves_less_with_a_load(known: KnownActuator) -> None:
    """10 % more weight: at most 0.5 % strain, and less than 0.1 % after 150 ms."""
    setting = setting_of(known, known.static_drive_v(0.0))
    motion, point = motion_record(setting, 0.15), sampled_point(setting, 0.0)
    added_n, moved = 0.1 * known.mass_kg * GRAVITY_M_S2, []
    for values in ((57.71, 0.5676, 0.04), (40.98, 0.3167, 0.01)):  # the best of both designs
        loop = linear_chip_loop(motion, setting, point, values)
        state, strains = np.zeros(loop.load.size), []
        for _ in range(400):
            state = loop.a @ state + added_n * loop.load
            strains.append(abs(float(loop.length @ state)) / known.zero_length_m)
        moved.append(np.array(strains))
    large, small = moved
    assert large.max() < 0.005 < 0.0065 < small.max()
    assert large[150:].max() < 1e-3
