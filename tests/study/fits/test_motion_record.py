"""A session as one motion: when each capacitance was sensed."""

import numpy as np
import pytest

from haselab.pipelines.motion import _later_s
from haselab.sensing import Lockin, LockinConfig

RATE_HZ, CARRIER_HZ, BLOCK = 200e3, 2000.0, 2000
AMPLITUDE = 2e4  # codes
RISE_PER_S = 3.0  # of the capacitance, relative


@pytest.mark.parametrize("phase_rad", [0.0, 0.4, 1.3, 2.2, 3.0])
@pytest.mark.parametrize("blank", [(336, 560), (0, 560)])
def test_a_rising_capacitance_is_that_of_the_stated_time(phase_rad, blank):
    config = LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=blank)
    lockin = Lockin(config, models=False)
    time_s = np.arange(BLOCK) / RATE_HZ
    turn = np.exp(1j * (config.omega_rad_s * time_s + phase_rad))
    rise = 1.0 + RISE_PER_S * (time_s - lockin.middle_s)
    codes = AMPLITUDE * np.stack([turn.real, rise * (1j * turn).real], axis=1)[None]
    flat = AMPLITUDE * np.stack([turn.real, (1j * turn).real], axis=1)[None]
    ratio = lockin.sense(codes).capacitance_f[0] / lockin.sense(flat).capacitance_f[0]
    later_s = float(_later_s(codes[:, :, 0].astype(np.int16), lockin)[0])
    # the second order of the rise, (rise * later)^2, and the rounding of the codes
    assert ratio - 1.0 == pytest.approx(RISE_PER_S * later_s, abs=3e-8 + 2.0 / AMPLITUDE**2)


def test_the_phase_of_the_carrier_moves_the_time():
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(336, 560)))
    time_s = np.arange(BLOCK) / RATE_HZ
    phase_rad = np.linspace(0.0, np.pi, 50)[:, None]
    codes = (AMPLITUDE * np.cos(2.0 * np.pi * CARRIER_HZ * time_s + phase_rad)).astype(np.int16)
    later_s = _later_s(codes, lockin)
    assert np.ptp(later_s) > 5e-5
    # by half a turn of the carrier and on, it repeats
    assert later_s[0] == pytest.approx(later_s[-1], abs=1e-7)
