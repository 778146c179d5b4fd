"""Farads, ohms and strain after two references, on a twin whose monitors lag, err and are skewed.

The scene is that of benchmarks/sensing/calibration.py, which prints the numbers.
"""

import importlib
from types import ModuleType

import numpy as np
import pytest


@pytest.fixture(scope="module")
def scene(benchmarks) -> ModuleType:
    return importlib.import_module("benchmarks.sensing.calibration")


@pytest.fixture(scope="module")
def calibrated(scene):
    bench, rig = scene.make()
    return bench, rig, scene.calibrated(rig, scene.calibrate(rig))


def test_known_loads_are_read_to_half_a_percent_and_their_resistance_to_five(scene, calibrated):
    _, rig, config = calibrated
    c_errors, r_errors = scene.load_errors(rig, config)
    assert np.abs(c_errors).max() < 0.005
    assert np.abs(r_errors).max() < 0.05
    # Without the calibration it is the stray, 12 % of gain, and the lags.
    c_errors, r_errors = scene.load_errors(rig, scene.nominal(rig))
    assert np.abs(c_errors).min() > 0.12
    assert np.abs(r_errors).max() > 1.0


def test_the_actuator_itself_is_read_as_well(scene, calibrated):
    bench, rig, config = calibrated
    c_error, r_error = scene.actuator_errors(bench, rig, config)
    assert abs(c_error) < 0.005
    assert abs(r_error) < 0.05


@pytest.mark.long
def test_strain_follows_the_camera_from_0_to_20_hz_within_a_percent_of_the_span(scene, calibrated):
    _, rig, config = calibrated
    found = scene.strain_errors(rig, config, 5.0)
    curve, line = found["cubic"], found["line"]
    assert curve.span > 0.1
    assert curve.rms < 0.01
    assert max(curve.by_band) < 0.01
    # C belongs to the middle of the samples that count. What is left: 8 us of lag, and half of a
    # mechanical step of 100 us, in which the twin's capacitance stays that of the step's start.
    assert abs(curve.delay_s - 58e-6) < 5 * curve.delay_std_s
    assert curve.delay_std_s < 50e-6
    # C goes with the 3.33rd power of the length, which bends by 2.33 / 2 of the strain squared:
    # half a span out, 0.3 of that stays about the best line, rms: 0.087 of the span's square.
    assert curve.rms < line.rms < 2.33 / 2 * 0.3 / 4 * curve.span * 1.5
    # 500 blocks, of which five neighbours err alike: the share scatters by 0.022.
    assert curve.held > 0.95 - 4 * 0.022
