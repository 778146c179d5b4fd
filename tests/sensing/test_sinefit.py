"""Sine fit: an unknown frequency costs nothing in capacitance and is found at its bound."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.sensing import Lockin, SineFit

BLOCKS = 800  # the rms of so many errors is itself known to 1 / sqrt(1600) = 2.5 %


@settings(max_examples=30)
@given(offset_hz=st.floats(-40, 40), phase_rad=st.floats(-np.pi, np.pi))
def test_a_frequency_beside_the_nominal_is_found_and_leaves_no_error(scene, offset_hz, phase_rad):
    case = scene.but(carrier_hz=2000.0 + offset_hz, phase_rad=phase_rad)
    fit = SineFit(case.config(carrier_hz=2000.0))
    readings = case.readings(1, None)
    # The search ends when a step turns the block's end by less than 1e-9 rad of 20 turns.
    np.testing.assert_allclose(fit.frequencies_hz(readings), case.carrier_hz, rtol=1e-9 / 125)
    sensed = fit.sense(readings)
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=1e-10)
    np.testing.assert_allclose(sensed.resistance_ohm, case.resistance_ohm, rtol=1e-8)


@pytest.mark.long
def test_frequency_is_at_its_cramer_rao_bound(scene, rng, rms):
    r"""$\mathrm{var}\,\omega \ge 24\sigma^2 / (A^2 T_s^2 N (N^2 - 1))$ (Rife and Boorstyn 1974).

    Two channels of one frequency add their information: A^2 becomes A_v^2 + A_i^2.
    """
    found_hz = SineFit(scene.config()).frequencies_hz(scene.readings(BLOCKS, rng))
    n, step_s = scene.block_samples, 1 / scene.rate_hz
    energy = scene.v_peak_v**2 + scene.i_peak_v**2
    bound_hz = np.sqrt(24 / (energy * n * (n**2 - 1))) * scene.noise_v / step_s / (2 * np.pi)
    assert rms(found_hz - 2000.0) <= 1.1 * bound_hz


@pytest.mark.long
@pytest.mark.parametrize("ramp_v_s", [0.0, 5.0])
def test_capacitance_is_at_its_cramer_rao_bound(scene, rng, rms, ramp_v_s):
    case = scene.but(ramp_v_s=ramp_v_s)
    codes = np.concatenate([case.codes(100, rng) for _ in range(BLOCKS // 100)])
    sensed = SineFit(case.config()).sense(codes * (20 / 2**16))
    error_f = sensed.capacitance_f - case.capacitance_f
    assert rms(error_f) <= 1.1 * case.capacitance_bound_f
    assert sensed.capacitance_std_f.mean() == pytest.approx(sensed.capacitance_f.std(), rel=0.1)


@pytest.mark.parametrize("off_hz", [2.0, 8.0, 30.0])
def test_it_follows_a_carrier_that_the_lock_in_corrects_or_refuses(scene, rng, off_hz):
    case = scene.but(carrier_hz=2000.0 + off_hz)
    readings = case.readings(20, rng)
    config = case.config(carrier_hz=2000.0)
    lockin, fit = Lockin(config).sense(readings), SineFit(config).sense(readings)
    allowed_f = 5 * case.capacitance_bound_f / np.sqrt(20)
    assert abs(fit.capacitance_f.mean() - case.capacitance_f) < allowed_f
    if off_hz < 4.0:  # a fifth of a percent of the carrier
        assert abs(lockin.capacitance_f.mean() - case.capacitance_f) < allowed_f
    else:
        assert (lockin.reason & 64 == 64).all()


def test_blanked_samples_have_no_influence(scene, rng):
    fit = SineFit(scene.config(blank=(0, 400)))
    readings = scene.readings(3, rng)
    spoiled = readings.copy()
    spoiled[:, :400] = 9.0
    np.testing.assert_array_equal(
        fit.sense(readings).capacitance_f, fit.sense(spoiled).capacitance_f
    )


def test_a_carrier_that_is_not_there_is_not_valid(scene, rng):
    noise = scene.noise_v * rng.standard_normal((20, 2000, 2))
    assert not SineFit(scene.config()).sense(noise).valid.any()
    assert not SineFit(scene.config()).sense(np.zeros((1, 2000, 2))).valid.any()


def test_a_configuration_without_an_answer_is_refused(scene):
    with pytest.raises(InputError, match="at least 2 periods"):
        SineFit(scene.config(blank=(0, 1900)))
    with pytest.raises(InputError, match="whole blocks"):
        SineFit(scene.config()).sense(np.zeros((2, 1000, 2)))
