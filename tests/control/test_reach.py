"""Range of a controller's output that the drive can produce."""

import math

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.control.gains import Saturation
from haselab.control.reach import default_step, reachable_range
from haselab.control.simulate import LoopSetting
from haselab.controllers import known_actuator
from haselab.models import RationalModel
from haselab.models.actuator import ActuatorTables
from haselab.models.maps import VoltageMap
from haselab.rig.chip.design import strains_within
from haselab.study.definition import Study
from haselab.study.feasibility import check_settings
from haselab.study.known import with_actuator_tables

# an actuator whose zero strain is its unloaded length: 14 mV there
FROM_REST = VoltageMap(3.2434714, 8.6686107, -3.2291820, -65.083499)

# the same, where the fitted map has 0 V at a strain of 0.06 % of its range: -32 mV at zero strain
BELOW_REST = VoltageMap(1.33632, 4.9019, -1.36828, -39.0907, -0.0175, 0.105)


@pytest.mark.parametrize("wanted", [Saturation(), Saturation(-0.03, 0.09), Saturation(0.0, 0.07)])
def test_an_actuator_that_is_unstrained_at_0_v_has_limits_from_zero_strain_on(wanted):
    found = reachable_range(wanted, FROM_REST, 0.0, 6.0)
    assert -1.5e-4 < found.low <= 0.0  # 14 mV over the slope of 238 V is a strain of 6e-5
    assert found.high == pytest.approx(min(wanted.high, 0.0715), abs=1e-4)
    assert (FROM_REST.voltage_v(np.linspace(found.low, found.high, 99)) >= 0.0).all()


def test_a_drive_that_does_not_reach_zero_strain_is_refused_with_its_voltage():
    with pytest.raises(ResultError, match=r"zero strain at 0\.0143 V, but .* \[1, 6\] V"):
        reachable_range(Saturation(), FROM_REST, 1.0, 6.0)


@pytest.mark.parametrize(
    ("gain", "limits", "step"),
    [
        (1.0, (-0.03, 0.03), 0.015),  # upwards where both sides are equal
        (-1.0, (-0.03, 0.03), 0.015),
        (-1.0, (-0.1, 0.02), 0.04),  # a plant that reverses reaches 0.04 with its lower limit
        (1.0, (-0.02, 0.015), -0.01),
    ],
)
def test_the_usual_step_is_upwards_unless_only_the_other_side_is_large(gain, limits, step):
    plant = RationalModel((gain,), (1.0, 1.0))
    assert default_step(plant, Saturation(*limits)) == pytest.approx(step)


def test_limits_without_zero_strain_are_refused_as_limits():
    with pytest.raises(InputError, match=r"limits are 0\.01 to 0\.05, but they must contain zero"):
        reachable_range(Saturation(0.01, 0.05), FROM_REST, 0.0, 6.0)


def test_a_map_that_passes_0_v_just_beside_zero_strain_starts_its_loops_there():
    found = reachable_range(Saturation(), BELOW_REST, 0.0, 2.0)
    assert 0.0 < found.low < 1e-3 and found.start == found.low
    assert BELOW_REST.voltage_v(found.low) >= 0.0
    assert reachable_range(found, BELOW_REST, 0.0, 2.0) == found  # a second design
    assert LoopSetting(100.0, 0.01, found).saturation == found
    low, high = strains_within((found.low, found.high), BELOW_REST, 1.9)
    assert low == found.low and float(BELOW_REST.voltage_v(high)) <= 1.9


def test_a_study_of_such_an_actuator_has_its_baseline_at_the_lowest_drive():
    names = ("a1_v", "b1", "a2_v", "b2", "strain_low", "strain_high")
    section = {name: getattr(BELOW_REST, name) for name in names}
    drive = {"low_v": 0.0, "high_v": 2.0, "voltage_map": section}
    steps = {"step": 0.03, "zero_s": 4.0, "step_s": 6.0, "rest_s": 10.0, "frame_rate_hz": 20.0}
    steps |= {"open_trials": 1, "pi_trials": 0, "pid_trials": 0}
    study = Study.model_validate({"name": "rest", "steps": steps})
    known = with_actuator_tables(study, ActuatorTables.model_validate({"drive": drive}))
    assert known.operating_point.baseline_v is not None
    # Within one step of the grid of `reach`, 0.1225 / 1500, times the slope of 60 V.
    assert 0.0 <= known.operating_point.baseline_v < 5e-3


@pytest.mark.parametrize(
    ("step", "drive_v", "message"),
    [
        # Eq. 4 of the paper: 1.043 V at zero strain, 1.6 V at a strain of 0.0692.
        (0.08, (0.0, 1.6), r"needs 1\.667 V .* 0 to 1\.6 V\. Choose a step between 0 and 0\.069"),
        (0.03, (1.2, 1.6), r"starts at zero strain, which needs 1\.044 V"),
    ],
)
def test_an_open_step_that_the_drive_does_not_reach_is_refused_before_the_run(
    step, drive_v, message
):
    eq4 = {"a1_v": 1.324, "b1": 3.124, "a2_v": -0.2805, "b2": -26.92}
    section = eq4 | {"strain_low": -0.05, "strain_high": 0.1}
    drive = {"low_v": drive_v[0], "high_v": drive_v[1], "voltage_map": section}
    steps = {"step": step, "zero_s": 4.0, "step_s": 6.0, "rest_s": 10.0, "frame_rate_hz": 20.0}
    steps |= {"open_trials": 1, "pi_trials": 0, "pid_trials": 0}
    study = Study.model_validate({"name": "far", "steps": steps})
    with pytest.raises(InputError, match=message):
        with_actuator_tables(study, ActuatorTables.model_validate({"drive": drive}))


@pytest.mark.parametrize("wide", [3.0, 1e3, 1e30])
def test_limits_far_beyond_the_map_are_narrowed_to_what_the_drive_reaches(wide):
    """Before, only strain 0 of 1501 strains was within the drive, so the reach was 0 to 0."""
    eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
    usual = eq4.reach((eq4.strain_low, eq4.strain_high), 0.0, 1.6)
    found = eq4.reach((-wide, wide), 0.0, 1.6)
    assert found == pytest.approx(usual, abs=2.0 * wide / 1500.0 if wide < 10.0 else 1e-12)
    assert eq4.reach((5.0, wide + 5.0), 0.0, 1.6) is None  # beyond the map alone


def test_limits_that_a_study_cannot_use_are_named():
    tables, _ = file_with_observer()
    controller = tables.controller
    assert controller is not None and controller.limits is not None
    ends = controller.limits.model_copy(update={"low": -1e30, "high": 1e30})
    wide = controller.model_copy(update={"limits": ends})
    with pytest.raises(InputError, match=r"limits of -1e\+30 to 1e\+30.* --limits to 'haselab"):
        with_actuator_tables(voltage_study(0.02, 1), tables.model_copy(update={"controller": wide}))


def voltage_study(step: float, open_trials: int) -> Study:
    """Steps with an observer, whose limits are those of the file."""
    steps = {"step": step, "zero_s": 4.0, "step_s": 6.0, "rest_s": 10.0, "frame_rate_hz": 20.0}
    steps |= {"open_trials": open_trials, "pi_trials": 0, "pid_trials": 0}
    return Study.model_validate({"name": "far", "steps": steps})


def file_with_observer() -> tuple[ActuatorTables, float]:
    """An actuator whose map needs twice the drive of the physical model, and its highest strain."""
    length_m, high_v = 0.051, 2.0
    parameters = {"shell.shear_modulus_pa": 15e3}
    sections = {
        "actuator": {"geometry": {"zero_length_m": length_m}},
        "model": {"physical": {"kind": "planar-hasel", "mass_kg": 0.25, "parameters": parameters}},
        "drive": {"low_v": 0.0, "high_v": high_v, "gain_v_per_v": 5000.0},
    }
    known = known_actuator(ActuatorTables.model_validate(sections))
    assert known is not None
    low, high = known.reachable()
    # Straight lines: zero strain at 1 V, and the highest strain at 3 V instead of 2 V.
    eq4 = {"a1_v": 1.0, "b1": math.log(3.0) / high, "a2_v": 0.0, "b2": 0.0}
    sections["drive"]["voltage_map"] = eq4 | {"strain_low": -0.01, "strain_high": 0.5 * high}
    gains = {"bandwidth_rad_s": 20.0, "load_n": 0.1, "shake_m_s2": 0.01, "reserve": 0.1}
    ends = {"low": low, "high": high}
    sections["controller"] = {"kind": "observer", "parameters": gains, "limits": ends}
    return ActuatorTables.model_validate(sections), high


def test_a_controller_with_a_voltage_output_reaches_what_its_physical_model_does():
    tables, high = file_with_observer()
    step = 0.9 * high
    far = with_actuator_tables(voltage_study(step, 0), tables)
    assert far.control.kind == "observer" and far.control.saturation_high == high
    said = (
        r"extrapolated: the map .* for the trials in open loop\. .*'observer' .*open_trials = 0\."
    )
    with pytest.raises(InputError, match=said):
        with_actuator_tables(voltage_study(step, 1), tables)
    with pytest.raises(InputError, match=r"the controller 'observer' does not reach\. Choose a"):
        with_actuator_tables(voltage_study(1.1 * high, 0), tables)
    with pytest.raises(InputError, match=r"Choose a step between 0 and [0-9.]+\.$"):  # neither one
        with_actuator_tables(voltage_study(1.1 * high, 1), tables)
    controller = tables.controller
    assert controller is not None
    in_strain = controller.model_copy(update={"kind": "pid", "parameters": {"kp": 0.1, "ki": 1.0}})
    with pytest.raises(InputError, match="by the voltage map"):  # its output passes the map
        with_actuator_tables(
            voltage_study(step, 0), tables.model_copy(update={"controller": in_strain})
        )


def test_a_chirp_needs_a_trial_in_open_loop():
    chirp = {"amplitude_v": 0.5, "start_hz": 0.1, "stop_hz": 10.0, "duration_s": 9.0, "hold_s": 4.0}
    study = voltage_study(0.02, 0).model_dump(exclude_unset=True) | {"control": {"kind": "open"}}
    check_settings(Study.model_validate(study))
    with pytest.raises(InputError, match=r"open_trials is 0, but the fit of \[chirp\]"):
        check_settings(Study.model_validate(study | {"chirp": chirp | {"frame_rate_hz": 200.0}}))
