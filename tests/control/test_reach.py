"""Range of a controller's output that the drive can produce."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.control.gains import Saturation
from haselab.control.reach import default_step, reachable_range
from haselab.control.simulate import LoopSetting
from haselab.models import RationalModel
from haselab.models.actuator import ActuatorTables
from haselab.models.maps import VoltageMap
from haselab.rig.chip.design import strains_within
from haselab.study.definition import Study
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
