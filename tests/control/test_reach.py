"""Range of a controller's output that the drive can produce."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.control.gains import Saturation
from haselab.control.reach import reachable_range
from haselab.models.maps import VoltageMap

# an actuator whose zero strain is its unloaded length: 14 mV there
FROM_REST = VoltageMap(3.2434714, 8.6686107, -3.2291820, -65.083499)


@pytest.mark.parametrize("wanted", [Saturation(), Saturation(-0.03, 0.09), Saturation(0.0, 0.07)])
def test_an_actuator_that_is_unstrained_at_0_v_has_limits_from_zero_strain_on(wanted):
    found = reachable_range(wanted, FROM_REST, 0.0, 6.0)
    assert -1.5e-4 < found.low <= 0.0  # 14 mV over the slope of 238 V is a strain of 6e-5
    assert found.high == pytest.approx(min(wanted.high, 0.0715), abs=1e-4)
    assert (FROM_REST.voltage_v(np.linspace(found.low, found.high, 99)) >= 0.0).all()


def test_a_drive_that_does_not_reach_zero_strain_is_refused_with_its_voltage():
    with pytest.raises(ResultError, match=r"zero strain at 0\.0143 V, but .* \[1, 6\] V"):
        reachable_range(Saturation(), FROM_REST, 1.0, 6.0)


def test_limits_without_zero_strain_are_refused_as_limits():
    with pytest.raises(InputError, match=r"limits are 0\.01 to 0\.05, but they must contain zero"):
        reachable_range(Saturation(0.01, 0.05), FROM_REST, 0.0, 6.0)
