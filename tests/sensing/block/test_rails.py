"""A drive beyond the converter's range; a carrier below one converter step; no noise at all."""

import numpy as np
import pytest

from haselab.sensing import Lockin
from haselab.sensing.block.distortion import at_a_rail

RAIL_V = 2.0  # above the carrier of the current, 1.2 V
STEP_V = 2 * RAIL_V / 2**16


def converted(readings, rail_v=RAIL_V, step_v=STEP_V):
    """Readings of a converter."""
    return np.clip(np.round(readings / step_v) * step_v, -rail_v, rail_v - step_v)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("channel", [0, 1])
def test_no_valid_block_is_wrong_while_a_ramp_leaves_the_converters_range(
    scene, rng, channel, sign
):
    readings = scene.readings(60, rng)
    # The drive keeps rising, only the converter does not follow it.
    low, high = ((1.8, 2.2), (0.2, 2.6))[channel]
    readings[..., channel] += sign * np.linspace(low, high, 60 * 2000).reshape(60, 2000)
    sensed = Lockin(scene.config(full_scale=10.0)).sense(converted(readings))
    error = (sensed.capacitance_f - scene.capacitance_f)[sensed.valid]
    assert 10 < sensed.valid.sum() < 45
    assert (np.abs(error) < 5.0 * sensed.capacitance_std_f[sensed.valid]).all()
    assert "flat top: a monitor saturates" in sensed.seen.values()


@pytest.mark.parametrize("per_period", [7, 10, 50])
@pytest.mark.parametrize("steps", [0.7, 1.5, 3.0, 10.0, 1e6])
def test_a_sine_in_coarse_steps_and_a_repeating_one_are_at_no_rail(per_period, steps):
    angle = 2 * np.pi * np.arange(20 * 10 * per_period) / per_period
    phases = np.linspace(0.0, 1.0, 40)[:, np.newaxis]
    waves = np.round(steps * np.cos(angle + phases) + 0.3 * phases)
    cut = np.stack([waves, -waves], axis=1).reshape(40, 2, 20, -1)
    assert not at_a_rail(cut, np.ones((40, 20), dtype=bool)).any()


def test_a_carrier_below_a_converter_step_gives_no_valid_block(scene, rng):
    # In some blocks the voltage does not change at all, in others by one step at the ramp.
    readings = scene.but(noise_v=1e-4).readings(100, rng)
    readings[..., 0] += np.linspace(0.0, 0.8, 200_000).reshape(100, 2000)
    sensed = Lockin(scene.config(full_scale=10.0)).sense(converted(readings, 10.0, 20.0 / 2**8))
    assert not sensed.valid.any()


def test_noise_free_readings_of_a_drive_are_not_called_stuck(scene):
    readings = scene.readings(20, None)
    drive = np.linspace(0.2, 0.8, 40_000).reshape(20, 2000)
    readings[..., 0] += drive**2
    slope = np.gradient((drive**2).ravel(), 1.0 / scene.rate_hz).reshape(20, 2000)
    readings[..., 1] += scene.ohm_per_ratio * scene.capacitance_f * slope
    sensed = Lockin(scene.config()).sense(readings)
    assert not any("stuck" in text for text in sensed.seen.values())
    assert sensed.valid.any()
    error = sensed.capacitance_f[sensed.valid] / scene.capacitance_f - 1.0
    # The slope of the drive that a block's plain model leaves, 60 uV of a carrier of 25 mV, times
    # the share of it near the carrier.
    assert np.abs(error).max() < 1e-4
