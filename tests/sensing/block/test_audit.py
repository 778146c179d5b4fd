"""Noise that is constant within a block and differs between blocks widens the deviations."""

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.sensing import Lockin


@pytest.mark.parametrize("tau_s", [20e-3, 40e-3])
def test_noise_in_a_narrow_band_at_the_carrier_is_in_the_deviation(scene, rng, rms, tau_s):
    case, blocks = scene, 300
    readings = case.readings(blocks, rng)
    time_s = np.arange(blocks * case.block_samples) / case.rate_hz
    keep = np.exp(-1.0 / (tau_s * case.rate_hz))
    white = rng.standard_normal((2, time_s.size))
    slow = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=1)
    angle = 2.0 * np.pi * case.carrier_hz * time_s
    tone = slow[0] * np.cos(angle) + slow[1] * np.sin(angle)
    readings[..., 1] += 3.0 * case.noise_v * tone.reshape(blocks, -1)
    sensed = Lockin(case.config()).sense(readings)
    ok = sensed.valid
    assert ok.mean() > 0.9
    error_f, std_f = sensed.capacitance_f[ok] - case.capacitance_f, sensed.capacitance_std_f[ok]
    assert np.median(std_f) == pytest.approx(rms(error_f), rel=0.4)
    assert np.mean(np.abs(error_f) > 5.0 * std_f) < 0.01
    assert "scatter of the blocks" in sensed.model(int(np.flatnonzero(ok)[100]))


def test_white_noise_widens_nothing(scene, rng):
    readings = scene.readings(300, rng)
    one = Lockin(scene.config()).sense(readings)
    other = Lockin(scene.config(), models=False).sense(readings)
    np.testing.assert_array_equal(one.capacitance_std_f, other.capacitance_std_f)


def test_an_actuator_whose_resistance_moves_with_its_strain_is_not_noise(scene, rng):
    """Capacitance and resistance by 5 % at 7 Hz, a hundred times the deviation of a block."""
    readings = np.concatenate([
        scene.but(capacitance_f=scene.capacitance_f * (1.0 + swing),
                  resistance_ohm=20e3 * (1.0 - swing)).readings(1, rng)
        for swing in 0.05 * np.sin(2.0 * np.pi * 7.0 * 0.01 * np.arange(300))
    ])  # fmt: skip
    one = Lockin(scene.config()).sense(readings)
    other = Lockin(scene.config(), models=False).sense(readings)
    np.testing.assert_array_equal(one.capacitance_std_f, other.capacitance_std_f)


@pytest.mark.parametrize("level", [0.1, 0.3])
def test_a_coarse_converter_is_refused_where_the_residuals_look_like_noise(scene, rng, level):
    """A step of five deviations of the noise: the rounding repeats itself in every block."""
    clean = scene.readings(200, None)
    step = 0.4 * np.abs(clean[0, :, 0]).max() * (1.0 + level)
    readings = np.round((clean + rng.normal(0.0, 0.2 * step, clean.shape)) / step) * step
    sensed = Lockin(scene.config()).sense(readings)
    error = np.abs(sensed.capacitance_f / scene.capacitance_f - 1.0)[sensed.valid]
    std = sensed.capacitance_std_f[sensed.valid] / scene.capacitance_f
    assert (error < 5.0 * std).all()
    assert sensed.valid.all() or "step of the converter" in sensed.reason_of(
        int(np.flatnonzero(~sensed.valid)[0])
    )
