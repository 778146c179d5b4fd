"""A session as one motion: when each capacitance was sensed."""

from types import SimpleNamespace

import numpy as np
import pytest

from haselab.pipelines.motion import _late_s, _rise, _weights
from haselab.sensing import Lockin, LockinConfig

RATE_HZ, CARRIER_HZ, BLOCK = 200e3, 2000.0, 2000
AMPLITUDE = 2e4  # codes
RISE_PER_S, STEP = 3.0, 1e-3  # of the capacitance, relative


@pytest.mark.parametrize("phase_rad", [0.0, 0.4, 1.3, 2.2, 3.0])
@pytest.mark.parametrize("blank", [(336, 560), (0, 560)])
def test_a_capacitance_that_changes_is_weighted_as_stated(phase_rad, blank):
    config = LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=blank)
    lockin = Lockin(config, models=False)
    time_s = np.arange(BLOCK) / RATE_HZ
    turn = np.exp(1j * (config.omega_rad_s * time_s + phase_rad))
    rise = RISE_PER_S * (time_s - lockin.middle_s)
    step = STEP * (np.arange(BLOCK) >= blank[1])
    flat = AMPLITUDE * np.stack([turn.real, (1j * turn).real], axis=1)[None]
    weight, later_s = (part[0] for part in _weights(flat[:, :, 0].astype(np.int16), lockin))
    assert weight.sum() == pytest.approx(1.0, abs=5e-7)  # single precision
    used = np.flatnonzero(lockin.counted)
    parts = [used[used < blank[1]], used[used >= blank[1]]][-len(weight) :]
    for change in (rise, step, rise + step):
        codes = flat * np.stack([np.ones(BLOCK), 1.0 + change], axis=1)
        ratio = lockin.sense(codes).capacitance_f[0] / lockin.sense(flat).capacitance_f[0]
        found = sum(w * change[at].mean() for w, at in zip(weight, parts, strict=True))
        found += later_s * RISE_PER_S * (change is not step)
        # the second order of the change, and the rounding of the codes
        assert ratio - 1.0 == pytest.approx(found, abs=STEP**2 + 2.0 / AMPLITUDE**2)


def test_the_phase_of_the_carrier_moves_the_time():
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(336, 560)))
    time_s = np.arange(BLOCK) / RATE_HZ
    phase_rad = np.linspace(0.0, np.pi, 50)[:, None]
    codes = (AMPLITUDE * np.cos(2.0 * np.pi * CARRIER_HZ * time_s + phase_rad)).astype(np.int16)
    later_s = _weights(codes, lockin)[1]
    assert np.ptp(later_s) > 5e-5
    # by half a turn of the carrier and on, it repeats
    assert later_s[0] == pytest.approx(later_s[-1], abs=1e-7)


@pytest.mark.parametrize("from_v", [0.0, 900.0])
def test_the_first_step_of_an_experiment_is_as_late_as_its_monitor_shows(from_v):
    """A slew from one level to the next acts on average half of its duration late."""
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(400, 560)))
    slew = 60  # samples
    at = np.arange(BLOCK)
    ramp = np.clip((at - 400.0) / slew, 0.0, 1.0)
    carrier = 60.0 * np.sin(2.0 * np.pi * CARRIER_HZ * at / RATE_HZ)
    first = from_v + (4000.0 - from_v) * ramp + carrier
    codes = np.round(np.stack([first, np.full(BLOCK, 4000.0) + carrier])).astype(np.int16)
    found = _rise(codes, lockin)
    part = SimpleNamespace(rise=found, lag_s=np.zeros(2))
    late_s = _late_s([part], RATE_HZ)[0]
    # of the square of the voltage, which the force follows; sums of samples
    square = (4000.0**2 - (from_v + (4000.0 - from_v) * ramp[400:560]) ** 2).sum()
    expected = square / (4000.0**2 - from_v**2) - 0.5
    # codes are rounded, and the square of each is uncertain by 2 V / sqrt(12)
    rounding = 3.0 * 2.0 * 4000.0 * np.sqrt(160.0 / 12.0) / (4000.0**2 - from_v**2)
    assert late_s[0] * RATE_HZ == pytest.approx(expected, abs=rounding)
    assert expected > 0.3 * slew
    # a step in two parts has the same area, and the same mean of share (1 - share)
    share = ((from_v + (4000.0 - from_v) * ramp) ** 2 - from_v**2) / (4000.0**2 - from_v**2)
    apart = 4.0 * (share * (1.0 - share)).sum()
    assert found.duration[0] == pytest.approx(apart, abs=4.0 * rounding)
    assert found.duration[1] == 0.0
    assert found.middle[0] == pytest.approx(np.sqrt(0.5 * (4000.0**2 + from_v**2)), abs=1.0)
