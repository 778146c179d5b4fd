"""Settling time and overshoot of a predicted step, relative to the step that is reached."""

import math

import control
import numpy as np
import pytest

from haselab.control import LoopSetting, PidGains, Saturation
from haselab.control.loop_shaping import predict
from haselab.models import Plant, SlowMode
from haselab.models.rational import RationalModel

RATE_HZ = 100.0
WIDE = LoopSetting(RATE_HZ, 0.0, Saturation(-1e3, 1e3))


def response(plant: RationalModel, gains: PidGains, seconds: float) -> np.ndarray:
    """Unit step of the sampled loop, by python-control. The measurement precedes the output."""
    held = control.c2d(control.tf(plant.numerator, plant.denominator), 1.0 / RATE_HZ, "zoh")
    z = control.tf([1, 0], [1], 1.0 / RATE_HZ)
    tau, period = gains.derivative_filter_s, 1.0 / RATE_HZ
    law = gains.kp + gains.ki * period * z / (z - 1)
    slope = gains.kd * (z - 1) / ((tau + period) * z - tau)  # acts on the measurement alone
    closed = control.feedback(control.series(law, control.feedback(held, slope)), 1)
    time_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return np.asarray(control.step_response(control.minreal(closed, verbose=False), time_s).outputs)


@pytest.mark.parametrize(
    ("plant", "gains"),
    [
        (Plant(1.0, 20.0, 0.3, slow_modes=(SlowMode(0.5, 6.0),)), PidGains(0.2, 1.0)),
        (RationalModel([2.0], [1.0, 0.0, 0.0]), PidGains(1.629, 0.1387, 1.559, 0.1096)),
    ],
)
def test_settling_and_overshoot_are_those_of_the_step_that_is_reached(plant, gains):
    found = predict(plant, gains, WIDE, step=1.0, record_s=4.0).step
    model = RationalModel.from_plant(plant) if isinstance(plant, Plant) else plant
    y = response(model, gains, 64.0)
    assert y[-1] == pytest.approx(1.0, abs=1e-3)
    settled = (np.flatnonzero(np.abs(y - 1.0) > 0.02)[-1] + 1) / RATE_HZ
    # The light smoothing and the grid between the samples shift the last crossing by two samples.
    assert found.settling_time_s == pytest.approx(settled, abs=2.0 / RATE_HZ)
    within = y[: round(4.0 * RATE_HZ)]  # the overshoot is that of the record
    assert found.overshoot == pytest.approx(max(0.0, within.max() - 1.0), abs=1e-3)


def test_a_response_that_never_settles_in_the_longest_record_says_so():
    slow = Plant(1.0, 20.0, 0.3, slow_modes=(SlowMode(0.5, 600.0),))
    found = predict(slow, PidGains(0.0, 0.001), WIDE, step=1.0, record_s=4.0).step
    assert math.isnan(found.settling_time_s)
