"""Lock-in: at the Cramer-Rao bound, honest about its scatter, the same in C and in bulk."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.sensing import Lockin, LockinConfig

BLOCKS = 2000  # the rms of so many errors is itself known to 1 / sqrt(4000) = 1.6 %
ROUNDOFF = 2.0**-24


@pytest.mark.parametrize("ramp_v_s", [0.0, 5.0])
@pytest.mark.parametrize(("v_peak_v", "capacitance_f"), [(0.01, 0.5e-9), (0.025, 1.5e-9)])
def test_error_is_at_the_cramer_rao_bound_still_and_under_a_ramp(
    scene, rng, rms, ramp_v_s, v_peak_v, capacitance_f
):
    # 4 s of 5 V/s would leave the converter's range: the ramp starts again every 100 blocks.
    case = scene.but(ramp_v_s=ramp_v_s, v_peak_v=v_peak_v, capacitance_f=capacitance_f)
    codes = np.concatenate([case.codes(100, rng) for _ in range(BLOCKS // 100)])
    error_f = Lockin(case.config()).sense(codes).capacitance_f - case.capacitance_f
    assert rms(error_f) <= 1.1 * case.capacitance_bound_f
    # Unbiased: the mean within five of its standard deviations.
    assert abs(error_f.mean()) < 5 * case.capacitance_bound_f / np.sqrt(BLOCKS)


@pytest.mark.parametrize("first_sample", [0, 400])
def test_reported_standard_deviation_is_the_true_scatter_within_ten_percent(
    scene, rng, first_sample
):
    sensed = Lockin(scene.config(first_sample=first_sample)).sense(scene.codes(BLOCKS, rng))
    assert sensed.capacitance_std_f.mean() == pytest.approx(sensed.capacitance_f.std(), rel=0.1)


def test_standard_deviation_grows_as_blanking_takes_samples(scene, rng):
    whole, blanked = (
        Lockin(scene.config(first_sample=first)).sense(scene.codes(200, rng)) for first in (0, 400)
    )
    ratio = blanked.capacitance_std_f.mean() / whole.capacitance_std_f.mean()
    assert ratio == pytest.approx(np.sqrt(2000 / 1600), rel=0.02)


def test_series_resistance_is_recovered(scene, rng):
    case = scene.but(resistance_ohm=30e3)
    sensed = Lockin(case.config()).sense(case.codes(BLOCKS, rng))
    # A circular error of V / I moves Re Z as much as Im Z.
    bound_ohm = case.capacitance_bound_f / case.capacitance_f * abs(case.impedance_ohm.imag)
    mean_error_ohm = sensed.resistance_ohm.mean() - 30e3
    assert abs(mean_error_ohm) < 5 * bound_ohm / np.sqrt(BLOCKS)


@pytest.mark.parametrize("skew_s", [2.5e-6, -2.5e-6, 20e-6])
def test_known_skew_leaves_no_trace(scene, skew_s):
    case = scene.but(skew_s=skew_s)
    sensed = Lockin(case.config()).sense(case.readings(3, None))
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=1e-12)
    np.testing.assert_allclose(sensed.resistance_ohm, case.resistance_ohm, rtol=1e-9)
    np.testing.assert_allclose(sensed.phase_rad, -np.angle(case.impedance_ohm), rtol=1e-12)


def test_unknown_skew_rotates_resistance_into_capacitance_as_it_must(scene):
    skew_s = 2.5e-6
    case = scene.but(skew_s=skew_s)
    sensed = Lockin(case.config(skew_s=0.0)).sense(case.readings(1, None))
    seen_ohm = case.impedance_ohm * np.exp(-2j * np.pi * case.carrier_hz * skew_s)
    np.testing.assert_allclose(sensed.resistance_ohm, seen_ohm.real, rtol=1e-9)


def test_step_in_c_equals_the_bulk_numbers_to_float_precision(scene, rng):
    lockin, codes = Lockin(scene.config()), scene.codes(50, rng)
    bulk = lockin.sense(codes)
    z = scene.impedance_ohm
    for k, block in enumerate(codes):
        capacitance_f, resistance_ohm, valid = lockin.step(block)
        # 14 roundings of products as large as |V| |I|; tests/core/test_demod.c has the same bound.
        assert capacitance_f == pytest.approx(
            bulk.capacitance_f[k], rel=14 * ROUNDOFF * abs(z) / abs(z.imag)
        )
        assert resistance_ohm == pytest.approx(
            bulk.resistance_ohm[k], abs=14 * ROUNDOFF * abs(z) * 1.2
        )
        assert valid


def test_codes_through_the_float_core_equal_the_double_path(scene, rng):
    case = scene.but(v_peak_v=0.5)
    codes = case.codes(20, rng)
    lockin = Lockin(case.config())
    single, double = lockin.sense(codes), lockin.sense(codes.astype(np.float64))
    # 250 additions of products in each lane, as large as the mean code times 2 / N.
    magnitude = np.abs(codes).mean(axis=(0, 1)) * 2
    peak = np.array([case.v_peak_v, case.i_peak_v]) / (20 / 2**16)
    bound = 260 * ROUNDOFF * (magnitude / peak).sum()
    np.testing.assert_allclose(single.capacitance_f, double.capacitance_f, rtol=bound)
    np.testing.assert_allclose(single.capacitance_std_f, double.capacitance_std_f, rtol=bound)


def test_blanked_samples_have_no_influence(scene, rng):
    lockin = Lockin(scene.config(first_sample=400))
    codes = scene.codes(5, rng)
    spoiled = codes.copy()
    spoiled[:, :400] = rng.integers(-32768, 32767, (5, 400, 2), dtype=np.int16)
    np.testing.assert_array_equal(
        lockin.sense(codes).capacitance_f, lockin.sense(spoiled).capacitance_f
    )


def test_times_are_the_middles_of_the_samples_that_count(scene):
    sensed = Lockin(scene.config(first_sample=400)).sense(scene.readings(3, None))
    np.testing.assert_allclose(sensed.time_s, (400 + 1999) / 2 / 200e3 + 0.01 * np.arange(3))


@given(scale=st.floats(1e-3, 1e3), phase_rad=st.floats(-np.pi, np.pi))
def test_capacitance_depends_on_neither_scale_nor_phase(scene, scale, phase_rad):
    case = scene.but(phase_rad=phase_rad, v_peak_v=0.025 * scale)
    sensed = Lockin(case.config()).sense(case.readings(2, None))
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=1e-11)
    np.testing.assert_allclose(sensed.v_pp, 2 * case.v_peak_v, rtol=1e-11)
    np.testing.assert_allclose(sensed.i_pp, 2 * case.i_peak_v, rtol=1e-11)


@given(level=st.floats(-5, 5), ramp_v_s=st.floats(-20, 20))
def test_level_and_ramp_leave_no_trace(scene, level, ramp_v_s):
    case = scene.but(ramp_v_s=ramp_v_s)
    sensed = Lockin(case.config()).sense(case.readings(2, None) + level)
    # Sums over 2,000 readings of up to 5.4 V against a carrier of 25 mV, in double.
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=1e-10)


@given(
    capacitance_f=st.floats(0.1e-9, 10e-9),
    resistance_ohm=st.floats(0.0, 50e3),
    carrier_hz=st.floats(500.0, 20e3),
)
def test_any_series_r_c_at_any_carrier_is_recovered(
    scene, capacitance_f, resistance_ohm, carrier_hz
):
    case = scene.but(
        capacitance_f=capacitance_f, resistance_ohm=resistance_ohm, carrier_hz=carrier_hz
    )
    sensed = Lockin(case.config()).sense(case.readings(1, None))
    z = case.impedance_ohm
    np.testing.assert_allclose(
        sensed.capacitance_f, capacitance_f, rtol=1e-11 * abs(z) / abs(z.imag)
    )
    np.testing.assert_allclose(sensed.resistance_ohm, resistance_ohm, atol=1e-10 * abs(z))


def test_noise_alone_and_a_dead_channel_are_not_valid(scene, rng):
    noise = scene.noise_v * rng.standard_normal((50, 2000, 2))
    assert not Lockin(scene.config()).sense(noise).valid.any()
    dead = scene.readings(5, rng)
    dead[:, :, 1] = 0.0
    sensed = Lockin(scene.config()).sense(dead)
    assert not sensed.valid.any()
    assert np.isnan(sensed.capacitance_f).all()
    assert Lockin(scene.config()).sense(scene.readings(5, rng)).valid.all()


def test_a_block_that_the_core_cannot_take_is_sensed_in_double(scene, rng):
    case = scene.but(rate_hz=250e3, block_samples=2500)
    sensed = Lockin(case.config()).sense(case.codes(20, rng))
    assert abs(sensed.capacitance_f.mean() - case.capacitance_f) < (
        5 * case.capacitance_bound_f / np.sqrt(20)
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"carrier_hz": 150.0}, "at least 2 periods"),
        ({"carrier_hz": 80e3}, "sample faster"),
        ({"first_sample": 1900}, "at least 2 periods"),
    ],
)
def test_a_configuration_without_an_answer_is_refused(scene, changes, words):
    with pytest.raises(InputError, match=words):
        Lockin(scene.config(**changes))


def test_blocks_of_another_shape_are_refused(scene):
    lockin = Lockin(scene.config())
    with pytest.raises(InputError, match="whole blocks"):
        lockin.sense(np.zeros((3, 1999, 2)))
    with pytest.raises(ValueError, match="multiple of 8"):
        lockin.step(np.zeros((1996, 2), dtype=np.int16))


def test_the_configuration_is_a_value():
    assert LockinConfig(2e5, 2000, 2e3, 0.0, 1e6) == LockinConfig(2e5, 2000, 2e3, 0.0, 1e6)
    assert LockinConfig(2e5, 2000, 2e3, 0.0, 1e6).block_s == 0.01
