"""Lock-in: at the Cramer-Rao bound, honest about its scatter, the same in C and in bulk."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.sensing import Lockin, LockinConfig

BLOCKS = 2000  # the rms of so many errors is itself known to 1 / sqrt(4000) = 1.6 %
ROUNDOFF = 2.0**-24
# Table and readings are rounded once each, a sum of 256 products in 16 lanes 20 times at random.
FLOAT = 8 * ROUNDOFF


@pytest.mark.long
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


@pytest.mark.long
@pytest.mark.parametrize("first_sample", [0, 448])
def test_reported_standard_deviation_is_the_true_scatter_within_ten_percent(
    scene, rng, first_sample
):
    sensed = Lockin(scene.config(blank=(0, first_sample))).sense(scene.codes(BLOCKS, rng))
    assert sensed.capacitance_std_f.mean() == pytest.approx(sensed.capacitance_f.std(), rel=0.1)


def test_standard_deviation_grows_as_blanking_takes_samples(scene, rng):
    whole, blanked = (
        Lockin(scene.config(blank=(0, first))).sense(scene.codes(200, rng)) for first in (0, 448)
    )
    ratio = blanked.capacitance_std_f.mean() / whole.capacitance_std_f.mean()
    assert ratio == pytest.approx(np.sqrt(2000 / 1552), rel=0.02)


@pytest.mark.long
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
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=FLOAT)
    size_ohm = abs(case.impedance_ohm)
    np.testing.assert_allclose(sensed.resistance_ohm, case.resistance_ohm, atol=FLOAT * size_ohm)
    np.testing.assert_allclose(sensed.phase_rad, -np.angle(case.impedance_ohm), atol=FLOAT)


def test_unknown_skew_rotates_resistance_into_capacitance_as_it_must(scene):
    skew_s = 2.5e-6
    case = scene.but(skew_s=skew_s)
    sensed = Lockin(case.config(skew_s=0.0)).sense(case.readings(1, None))
    seen_ohm = case.impedance_ohm * np.exp(-2j * np.pi * case.carrier_hz * skew_s)
    np.testing.assert_allclose(sensed.resistance_ohm, seen_ohm.real, atol=FLOAT * abs(seen_ohm))


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


@pytest.mark.parametrize("dtype", [np.int16, np.float32, np.float64])
@pytest.mark.parametrize("block_samples", [2000, 1987])
def test_columns_pairs_and_types_give_the_same_bits(scene, rng, dtype, block_samples):
    case = scene.but(block_samples=block_samples, carrier_hz=1700.0)
    codes = case.codes(7, rng)  # whole numbers: every type holds them
    lockin = Lockin(case.config(search_updates=True))
    one = lockin.sense(codes)
    pairs = lockin.sense(codes.astype(dtype))
    flat = codes.reshape(-1, 2).astype(dtype)
    columns = lockin.sense_channels(flat[:, 0].copy(), flat[:, 1].copy())
    for name in ("capacitance_f", "capacitance_std_f", "leakage_s", "time_s"):
        np.testing.assert_array_equal(getattr(pairs, name), getattr(one, name))
        np.testing.assert_array_equal(getattr(columns, name), getattr(one, name))


def test_blanked_samples_have_no_influence(scene, rng):
    lockin = Lockin(scene.config(blank=(0, 448)))
    codes = scene.codes(5, rng)
    spoiled = codes.copy()
    spoiled[:, :448] = rng.integers(-32768, 32767, (5, 448, 2), dtype=np.int16)
    np.testing.assert_array_equal(
        lockin.sense(codes).capacitance_f, lockin.sense(spoiled).capacitance_f
    )


def test_times_are_the_middles_of_the_samples_that_count(scene):
    sensed = Lockin(scene.config(blank=(0, 448))).sense(scene.readings(3, None))
    np.testing.assert_allclose(sensed.time_s, (448 + 1999) / 2 / 200e3 + 0.01 * np.arange(3))


@pytest.mark.long
@given(scale=st.floats(1e-3, 1e3), phase_rad=st.floats(-np.pi, np.pi))
def test_capacitance_depends_on_neither_scale_nor_phase(scene, scale, phase_rad):
    case = scene.but(phase_rad=phase_rad, v_peak_v=0.025 * scale)
    sensed = Lockin(case.config()).sense(case.readings(2, None))
    np.testing.assert_allclose(sensed.capacitance_f, case.capacitance_f, rtol=FLOAT)
    np.testing.assert_allclose(sensed.v_pp, 2 * case.v_peak_v, rtol=FLOAT)
    np.testing.assert_allclose(sensed.i_pp, 2 * case.i_peak_v, rtol=FLOAT)


@given(level=st.floats(-5, 5), ramp_v_s=st.floats(-20, 20))
@example(level=4.008708821374267, ramp_v_s=0.0)
def test_level_and_ramp_leave_no_trace(scene, level, ramp_v_s):
    case = scene.but(ramp_v_s=ramp_v_s)
    sensed = Lockin(case.config()).sense(case.readings(2, None) + np.array([level, 0.0]))
    # Readings of up to 5.4 V are rounded to float. On a level they repeat with the carrier, and so
    # do their roundings: only those of one period are independent.
    peak_v = case.v_peak_v * min(1.0, case.ohm_per_ratio / abs(case.impedance_ohm))
    rounded = 5.4 * ROUNDOFF * np.sqrt(2 * case.carrier_hz / case.rate_hz) / peak_v
    np.testing.assert_allclose(
        sensed.capacitance_f, case.capacitance_f, rtol=FLOAT + 5 * np.sqrt(2) * rounded
    )


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
        sensed.capacitance_f, capacitance_f, rtol=FLOAT * abs(z) / abs(z.imag)
    )
    np.testing.assert_allclose(sensed.resistance_ohm, resistance_ohm, atol=FLOAT * abs(z))


def test_noise_alone_and_a_dead_channel_are_not_valid(scene, rng):
    noise = scene.noise_v * rng.standard_normal((50, 2000, 2))
    assert not Lockin(scene.config()).sense(noise).valid.any()
    dead = scene.readings(5, rng)
    dead[:, :, 1] = 0.0
    sensed = Lockin(scene.config()).sense(dead)
    assert not sensed.valid.any()
    assert np.isnan(sensed.capacitance_f).all()
    assert Lockin(scene.config()).sense(scene.readings(5, rng)).valid.all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"carrier_hz": 150.0}, "at least 2 periods"),
        ({"carrier_hz": 80e3}, "sample faster"),
        ({"blank": (0, 1900)}, "at least 2 periods"),
        ({"blank": (300, 100)}, "are not inside a block"),
        ({"blank": (750, 850), "carrier_hz": 250.0}, "leaves too little"),
    ],
)
def test_a_configuration_without_an_answer_is_refused(scene, changes, words):
    with pytest.raises(InputError, match=words):
        Lockin(scene.config(**changes))


def test_blocks_of_another_shape_are_refused(scene):
    lockin = Lockin(scene.config())
    with pytest.raises(InputError, match="whole blocks"):
        lockin.sense(np.zeros((3, 1999, 2)))
    with pytest.raises(ValueError, match="one whole block"):
        lockin.step(np.zeros((1996, 2), dtype=np.int16))


def test_the_configuration_is_a_value():
    assert LockinConfig(2e5, 2000, 2e3, 0.0, 1e6) == LockinConfig(2e5, 2000, 2e3, 0.0, 1e6)
    assert LockinConfig(2e5, 2000, 2e3, 0.0, 1e6).block_s == 0.01
