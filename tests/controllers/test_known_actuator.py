"""What a controller may know of its actuator: forces, equilibria and the sensed length."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import (
    ACTUATORS,
    GRAVITY_M_S2,
    PlanarHasel,
    equilibrium_m,
)
from haselab.base import InputError, LimitError
from haselab.controllers import (
    CONTROLLERS,
    ControllerKind,
    ControllerSetting,
    KnownActuator,
    OpenLoop,
    known_actuator,
)
from haselab.controllers.motion_model import MotionModel
from haselab.models.actuator import ActuatorTables
from haselab.rig.twin.config import TwinConfig
from haselab.scoreboard import CLASSES, plant
from haselab.scoreboard.devices import Device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.play import Scenario, play
from haselab.scoreboard.tasks.task import staircase

ROOT = Path(__file__).resolve().parents[2]
LONGEST_M = 0.08
# kind, hung mass, length at strain 0, highest drive at a gain of 5000
KINDS = [("planar-hasel", 0.25, 0.051, 2.0), ("peano-hasel", 0.2, 0.115, 1.4),
         ("dea-stack", 0.1, 0.036, 1.0)]  # fmt: skip
ALL_KINDS = [*KINDS, ("curling-hasel", 0.05, 0.104, 1.6)]


def known(kind: str = "planar-hasel", mass_kg: float = 0.25, zero_m: float = 0.051,
          high_v: float = 2.0, **more: float) -> KnownActuator:  # fmt: skip
    law = ACTUATORS.find(kind)()
    return KnownActuator(law, mass_kg, zero_m, 0.0, high_v, 5000.0, **more)


@pytest.mark.parametrize("setting", KINDS, ids=[row[0] for row in KINDS])
def test_the_drive_that_holds_a_strain_is_that_of_the_law_s_equilibrium(setting):
    """Against a bisection of the law's forces; linear interpolation between 1024 lengths."""
    actuator = known(*setting, carrier_v2=5e3)
    low, high = actuator.reachable()
    for share in (0.1, 0.5, 0.9):
        strain = low + share * (high - low)
        volt = 5000.0 * actuator.static_drive_v(strain)
        acting_v = math.hypot(volt, math.sqrt(5e3))
        found_m = equilibrium_m(actuator.law, acting_v, GRAVITY_M_S2 * setting[1])
        assert actuator.strain(found_m) == pytest.approx(strain, abs=2e-4 * (high - low))


@pytest.mark.parametrize("setting", KINDS, ids=[row[0] for row in KINDS])
def test_the_sensed_length_inverts_the_law_s_capacitance(setting):
    actuator = known(*setting, sensing_scale=1.02)
    low, high = actuator.reachable()
    for share in (0.0, 0.3, 0.9):
        length_m, drive_v = actuator.length_m(low + share * (high - low)), 0.7 * setting[3]
        volt = 5000.0 * drive_v
        farad = 1.02 * float(actuator.law.differential_capacitance_f(length_m, volt))
        found_m = actuator.sensed_length_m(farad, drive_v)
        assert found_m == pytest.approx(length_m, abs=1e-3 * actuator.zero_length_m * (high - low))
        pull_n = float(actuator.law.electric_force_n(length_m, volt))
        assert actuator.pull_n(length_m, drive_v) == pytest.approx(pull_n, rel=2e-3)
        assert actuator.drive_v(length_m, pull_n) == pytest.approx(drive_v, rel=2e-3)


@pytest.mark.parametrize("setting", ALL_KINDS, ids=[row[0] for row in ALL_KINDS])
def test_drive_and_force_are_inverse_to_each_other(setting):
    """Up to rounding: a controller takes a difference for a limit that acts."""
    actuator, rng = known(*setting, carrier_v2=5e3), np.random.default_rng(1)
    low, high = actuator.reachable()
    for _ in range(300):
        length_m = actuator.length_m(rng.uniform(low, high))
        drive_v = rng.uniform(0.05, setting[3])
        pull_n = actuator.pull_n(length_m, drive_v)
        assert actuator.drive_v(length_m, pull_n) == pytest.approx(drive_v, rel=1e-9)


@pytest.mark.parametrize("setting", ALL_KINDS, ids=[row[0] for row in ALL_KINDS])
def test_the_noise_of_a_sensed_length_is_that_at_the_drive_that_holds_it(setting):
    """Against the sensed length of a capacitance that is off by its noise."""
    noise_f = 1e-12
    actuator = known(*setting, capacitance_noise_f=noise_f, sensing_scale=1.02)
    low, high = actuator.reachable()
    for share in (0.15, 0.4, 0.6, 0.85):
        strain = low + share * (high - low)
        drive_v = actuator.static_drive_v(strain)
        farad = 1.02 * actuator.static_capacitance_f(strain)
        ends = [actuator.sensed_length_m(farad + k * noise_f, drive_v) for k in (1, -1)]
        assert actuator.length_noise_m(strain) == pytest.approx(abs(ends[0] - ends[1]) / 2, rel=0.1)


def test_no_noise_makes_the_sensed_length_less_certain_than_any_length_of_the_law():
    actuator = known(*KINDS[1], capacitance_noise_f=1e-3)
    last = actuator.table.elastic_n.size - 1
    any_m = last * actuator.table.step_m / math.sqrt(12.0)
    assert actuator.length_noise_m(-0.02) == pytest.approx(any_m, rel=1e-9)


def test_the_reachable_range_ends_at_the_drive_the_field_or_the_pull_in():
    by_drive, by_field = known(), known(highest_field_v_per_m=20e6)
    assert by_drive.static_drive_v(by_drive.reachable()[1]) == pytest.approx(2.0, abs=2e-2)
    last_m = by_field.length_m(by_field.reachable()[1])
    fields = [
        5000.0 * by_field.static_drive_v(by_field.strain(length_m))
        / float(by_field.law.gap_m(length_m))
        for length_m in (last_m, last_m + by_field.table.step_m)
    ]  # fmt: skip
    assert fields[0] <= 20e6 < fields[1]  # the last length of the grid within the limit
    gap_m = float(by_field.law.gap_m(last_m))
    assert by_field.highest_drive_v(last_m) == pytest.approx(20e6 * gap_m / 5000.0, rel=1e-5)
    stack = known("dea-stack", 0.5, 0.036, 3.0)  # its layers collapse before the highest drive
    end_v = 5000.0 * stack.static_drive_v(stack.reachable()[0])
    assert end_v < 0.95 * 5000.0 * 3.0
    with pytest.raises(LimitError, match="no equilibrium"):
        equilibrium_m(stack.law, 1.01 * end_v, GRAVITY_M_S2 * 0.5)


CURLING = TwinConfig.model_validate(
    tomllib.loads((ROOT / "examples/kinds/curling-hasel/twin.toml").read_text())
)


def curling(**changes: float) -> KnownActuator:
    """The curling HASEL of the examples, with the noise of its lock-in."""
    found = true_actuator(Device("curling", "", CURLING, 2.0, 1.0))
    return replace(found, capacitance_noise_f=5.3e-13, **changes)


def test_the_sensed_range_ends_before_the_pouches_are_slack():
    """Near 0 V, the capacitance of this curling HASEL hardly depends on its length."""
    actuator = curling()
    (low, high), (first, last) = actuator.reachable(), actuator.sensed_range()
    assert first == low and high - 0.1 * (high - low) < last < high
    pulls = [actuator.static_pull_n(strain) for strain in (low, last, high)]
    # 0.075 and the share of the creep, 0.05 (next of 400 strains); the end of the range has less
    assert 0.125 <= pulls[1] / pulls[0] < 0.13 and pulls[2] / pulls[0] < 0.03
    ends_m = actuator.length_m(last) + np.array([-1e-4, 1e-4])
    idle_f, driven_f = (
        np.ptp(actuator.law.differential_capacitance_f(ends_m, 5000.0 * drive_v))
        for drive_v in (0.0, actuator.static_drive_v(last))
    )
    assert driven_f > 20.0 * idle_f
    slack_f = [float(actuator.law.capacitance_f(actuator.length_m(s))) for s in (low, high)]
    assert min(slack_f) < actuator.slack_f < max(slack_f) < 1.01 * min(slack_f)
    # Loops start at strain 0, here the length at 0 V, which stays.
    from_rest = replace(actuator, zero_length_m=actuator.length_m(high))
    assert from_rest.sensed_range() == from_rest.reachable()
    # With a lowest drive at which the capacitance shows the length, nothing is taken off.
    biased = curling(low_v=0.5)
    assert biased.sensed_range() == biased.reachable() and biased.slack_f == 0.0


@pytest.mark.parametrize("setting", KINDS, ids=[row[0] for row in KINDS])
def test_the_sensed_range_is_the_reachable_one_where_the_capacitance_shows_the_length(setting):
    actuator = known(*setting)
    assert actuator.sensed_range() == actuator.reachable() and actuator.slack_f == 0.0


def test_a_loop_stays_calm_at_the_end_of_the_sensed_range(monkeypatch):
    """After the largest step; beyond, at 98.5 % of the reachable range, it loses the length."""
    monkeypatch.setattr(plant, "TRAINED", 1.5)  # the usual weight straightens it too far
    actuator, device = curling(), Device("curling", "", CURLING, 2.0, 1.0)
    low, high = actuator.reachable()
    gains = {"bandwidth_rad_s": 81.5, "load_n": 0.085, "shake_m_s2": 0.01, "reserve": 0.15}
    chosen = CONTROLLERS.find("mpc").choose(gains | {"pole_rad_s": 180.0, "stage_s": 0.01})
    errors = []
    for end in (actuator.sensed_range()[1], low + 0.985 * (high - low)):
        wanted = staircase(((-math.inf, low + 0.05 * (high - low)), (0.0, end)))
        scenario = Scenario(device, actuator.zero_length_m, 2.0, wanted)
        host, rng = CLASSES["host-100hz"], np.random.default_rng(2)
        trace = play(scenario, chosen, host, actuator, rng)
        errors.append(float(np.abs(trace.strain[trace.time_s > 1.0] - end).max()) / (high - low))
    assert errors[0] < 0.005 and errors[1] > 0.01  # shares of the range


def test_a_softened_actuator_needs_less_voltage():
    new, worn = known(), known(longest_m=LONGEST_M)
    assert worn.static_drive_v(0.02) < new.static_drive_v(0.02)
    acting_v = 5000.0 * worn.static_drive_v(0.02)
    found_m = equilibrium_m(worn.law, acting_v, GRAVITY_M_S2 * 0.25, longest_m=LONGEST_M)
    assert worn.strain(found_m) == pytest.approx(0.02, abs=1e-4)


PHYSICAL = {
    "kind": "planar-hasel",
    "mass_kg": 0.25,
    "parameters": {"shell.shear_modulus_pa": 15.0e3, "load.added_inertia_kg": 0.01,
                   "camera.offset_m": 1e-5, "camera.scale": 1.001, "sensing.scale": 1.01},
    "residuals": {"capacitance_noise_f": 3e-13},
    "records": {"gain_v_per_v": 5000.0, "highest_drive_v": 2.0, "heaviest_kg": 0.9,
                "carrier_v": 100.0},
}  # fmt: skip
FILE = {
    "actuator": {"geometry": {"zero_length_m": 0.051}, "parameters": {"shell.width_m": 0.05}},
    "drive": {"low_v": 0.0, "high_v": 1.9, "gain_v_per_v": 4000.0, "highest_field_v_per_m": 34e6},
    "model": {"physical": PHYSICAL},
}


def test_the_known_actuator_of_a_file_has_its_law_limits_and_longest_length():
    found = known_actuator(ActuatorTables.model_validate(FILE))
    assert found is not None and isinstance(found.law, PlanarHasel)
    values = found.law.parameters()
    assert values["shell.shear_modulus_pa"] == 15.0e3 and values["shell.width_m"] == 0.05
    assert (found.high_v, found.gain_v_per_v, found.carrier_v2) == (1.9, 4000.0, 5000.0)
    assert (found.sensing_scale, found.added_inertia_kg) == (1.01, 0.01)
    assert found.zero_length_m == pytest.approx((0.051 - 1e-5) / 1.001)
    assert found.capacitance_noise_f == 3e-13 and found.highest_field_v_per_m == 34e6
    heaviest_m = equilibrium_m(found.law, 0.0, 0.9 * GRAVITY_M_S2)
    driven_m = equilibrium_m(found.law, 8000.0, 0.25 * GRAVITY_M_S2)
    assert found.longest_m == pytest.approx(max(heaviest_m, driven_m))


def test_a_file_without_physical_model_gives_none_and_an_incomplete_one_says_what_is_missing():
    assert known_actuator(ActuatorTables()) is None
    short = {**FILE, "drive": {}, "actuator": {}}
    with pytest.raises(InputError, match=r"needs actuator\.geometry\.zero_length_m, drive\.high_v"):
        known_actuator(ActuatorTables.model_validate(short), "A.toml")
    wrong = {"model": {"physical": {**PHYSICAL, "parameters": {"shell.colour": 1.0}}}}
    with pytest.raises(InputError, match=r"\[model.physical\]: shell.colour is not a parameter"):
        known_actuator(ActuatorTables.model_validate({**FILE, **wrong}))


def test_a_kind_that_needs_the_actuator_names_the_command_that_identifies_it():
    setting = ControllerSetting(0.01, 0.0, 2.0)
    for kind in (ControllerKind("v", OpenLoop, output="voltage"),
                 ControllerKind("s", OpenLoop, needs_actuator=True)):  # fmt: skip
        with pytest.raises(InputError, match=r"haselab identify actuator RUN --actuator A\.toml"):
            kind.check(setting)
        kind.check(ControllerSetting(0.01, 0.0, 2.0, actuator=known()))
    ControllerKind("plain", OpenLoop).check(setting)


def test_the_preview_covers_its_time_in_whole_steps():
    kind = ControllerKind("ahead", OpenLoop, preview_s=0.05)
    assert [kind.preview_steps(period_s) for period_s in (0.01, 0.001, 0.02)] == [5, 50, 3]
    assert np.isclose(ControllerKind("none", OpenLoop).preview_steps(0.01), 0)


@pytest.mark.parametrize("setting", KINDS, ids=[row[0] for row in KINDS])
def test_the_natural_frequency_is_that_of_the_linearised_motion(setting):
    """Against the size of the eigenvalues of 1 ms of motion, which damping hardly changes."""
    actuator = known(*setting)
    motion, length_m = MotionModel(actuator), actuator.length_m(0.01)
    values = np.linalg.eigvals(motion.linear(length_m, 0.0, 1e-3))
    swinging = max(values, key=lambda value: abs(value.imag))
    found = motion.natural_rad_s(length_m, length_m)
    assert found == pytest.approx(abs(np.log(swinging)) / 1e-3, rel=0.02)
    assert motion.natural_rad_s(actuator.length_m(-0.01), actuator.length_m(0.02)) >= found
