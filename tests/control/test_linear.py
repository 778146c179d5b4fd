"""Margins of a controller in z: those of the PID that it equals, and of ones that are no PID."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.base import InputError, LimitError
from haselab.control import LinearController, PidGains, margins
from haselab.models.plant import Plant, SlowMode
from haselab.models.rational import RationalModel

PLANT = Plant(0.9, 32.0, 0.12, 0.002, (SlowMode(0.2, 3.0),))
RATE_HZ = 100.0


def in_z(gains: PidGains) -> LinearController:
    """kp + ki T z/(z-1) + kd (z-1)/((tau+T) z - tau) over one denominator."""
    period_s = 1.0 / RATE_HZ
    tau = gains.derivative_filter_s
    step, lag = np.array([1.0, -1.0]), np.array([tau + period_s, -tau])
    top = gains.kp * np.polymul(step, lag)
    top = np.polyadd(top, gains.ki * period_s * np.polymul([1.0, 0.0], lag))
    top = np.polyadd(top, gains.kd * np.polymul(step, step))
    return LinearController(tuple(top), tuple(np.polymul(step, lag)), RATE_HZ)


@pytest.mark.parametrize("gains", [PidGains(0.05, 2.0), PidGains(0.02, 2.5, 0.01, 0.02)])
@pytest.mark.parametrize("plant", [PLANT, RationalModel.from_plant(PLANT)])
def test_a_pid_written_in_z_has_the_margins_of_the_pid(gains, plant) -> None:
    """Two routes to one number: roots of the same response, found on other grids."""
    ours = margins(plant, in_z(gains), loop_delay_s=0.0075, rate_hz=RATE_HZ)
    theirs = margins(plant, gains, loop_delay_s=0.0075, rate_hz=RATE_HZ)
    assert ours.stable and theirs.stable
    for name in ("phase_margin_deg", "gain_margin_db", "delay_margin_s", "crossover_rad_s"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=1e-6), name
    assert ours.peak_sensitivity == pytest.approx(theirs.peak_sensitivity, rel=1e-4)


def test_too_much_gain_is_counted_as_unstable_in_both_forms() -> None:
    gains = PidGains(0.5, 40.0)
    ours = margins(PLANT, in_z(gains), loop_delay_s=0.0075, rate_hz=RATE_HZ)
    theirs = margins(PLANT, gains, loop_delay_s=0.0075, rate_hz=RATE_HZ)
    assert not ours.stable and ours.unstable_poles == theirs.unstable_poles > 0


def test_what_cannot_be_a_controller_is_refused() -> None:
    with pytest.raises(InputError, match=r"at most as many numbers above as below"):
        LinearController((1.0, 0.0), (1.0,), RATE_HZ)
    with pytest.raises(InputError, match=r"linearised for 100 Hz, but the loop runs at 50 Hz"):
        margins(PLANT, in_z(PidGains(0.0, 1.0)), loop_delay_s=0.0, rate_hz=50.0)
    with pytest.raises(LimitError, match=r"this controller is sampled"):
        margins(PLANT, in_z(PidGains(0.0, 1.0)), loop_delay_s=0.0, rate_hz=None)
