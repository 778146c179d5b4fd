"""What disturbs a block is found, blanked or reported; nothing wrong passes in silence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.sensing import REASONS, Lockin, LockinConfig, PaperChain, SineFit, reason_text
from haselab.sensing.block.tones import converter_step

METHODS = [Lockin, SineFit, PaperChain]


def bits(*words: str) -> int:
    return sum(bit for bit, text in REASONS.items() if text in words)


def stepped(scene, rng, at: int, height_v: float = 0.02, blocks: int = 200):
    """A drive that climbs at one sample of each block, with the current that charges C."""
    readings = scene.readings(blocks, rng)
    readings[:, at:, 0] += height_v
    if at < scene.block_samples:
        readings[:, at, 1] += height_v * scene.rate_hz * scene.ohm_per_ratio * scene.capacitance_f
    return readings


@pytest.mark.parametrize("at", [0, 1, 313, 600, 601, 1000, 1400, 1990])
def test_an_update_at_an_unknown_time_costs_no_more_than_the_segments_it_hits(scene, rng, rms, at):
    case = scene.but(carrier_hz=1913.0)  # no whole number of periods: the worst for leaks
    lockin = Lockin(case.config(search_updates=True))
    sensed = lockin.sense(stepped(case, rng, at))
    assert sensed.valid.all()
    error_f = sensed.capacitance_f - case.capacitance_f
    # Two of 17 segments are left out, and a level more is fitted; 200 blocks determine an rms to 5
    # %.
    assert rms(error_f) < 1.3 * case.capacitance_bound_f
    assert sensed.capacitance_std_f.mean() == pytest.approx(rms(error_f), rel=0.2)


@pytest.mark.parametrize("height_v", [0.02, 0.2])
def test_an_update_at_a_blocks_end_settles_in_the_next_one(scene, rng, rms, height_v):
    """Updates 8 samples before each block's end and in its middle: two places are hit."""
    readings = stepped(scene, rng, 1000, height_v=height_v)
    tail = np.exp(-np.arange(52) / 8.0)
    readings[:, :52, 0] -= height_v * tail
    charge = scene.rate_hz * scene.ohm_per_ratio * scene.capacitance_f / 8.0
    readings[:, :52, 1] += height_v * tail * charge
    sensed = Lockin(scene.config(search_updates=True)).sense(readings)
    assert sensed.valid.all()
    # Three of 17 segments are left out: 1 / sqrt(1 - 0.17) = 1.10.
    assert rms(sensed.capacitance_f - scene.capacitance_f) < 1.3 * scene.capacitance_bound_f


def test_a_search_that_finds_nothing_changes_nothing(scene, rng):
    readings = scene.readings(300, rng)
    lockin = Lockin(scene.config(search_updates=True))
    sensed = lockin.sense(readings)
    clean = SineFit(scene.config(), parameters=3).sense(readings)  # all samples, in double
    same = np.isclose(sensed.capacitance_f, clean.capacitance_f, rtol=1e-6)
    assert same.mean() > 0.99


def test_an_update_that_is_not_looked_for_is_told(scene, rng):
    sensed = Lockin(scene.config()).sense(stepped(scene, rng, 613, height_v=0.05))
    assert (sensed.reason == bits("update in the window")).all()
    assert np.isnan(sensed.capacitance_f).all()


def test_two_updates_in_one_block_are_both_left_out(scene, rng, rms):
    readings = stepped(scene, rng, 413, height_v=0.05)
    readings[:, 1313:, 0] += 0.05
    sensed = Lockin(scene.config(search_updates=True)).sense(readings)
    assert sensed.valid.all()
    assert "steps at" in sensed.model(7)
    # Four of 20 segments are left out: 1 / sqrt(0.8) = 1.12; 200 blocks determine an rms to 5 %.
    error_f = sensed.capacitance_f - scene.capacitance_f
    assert rms(error_f) < 1.12 * 1.15 * scene.capacitance_bound_f
    assert sensed.capacitance_std_f.mean() == pytest.approx(rms(error_f), rel=0.2)


@pytest.mark.parametrize("method", METHODS)
def test_a_reading_that_is_no_number_spoils_its_own_block_alone(scene, rng, method):
    readings = scene.readings(40, rng)
    readings[30, 700, 1] = np.nan
    readings[33, 3, 0] = np.inf
    sensed = method(scene.config()).sense(readings)
    assert np.flatnonzero(sensed.reason & bits("not a finite number")).tolist() == [30, 33]
    assert not sensed.valid[[30, 33]].any()
    assert sensed.valid[[5, 29, 31, 32, 34, 39]].all()
    clean = method(scene.config()).sense(scene.readings(40, np.random.default_rng(20181001)))
    off = np.abs(sensed.capacitance_f - clean.capacitance_f) / clean.capacitance_std_f
    if method is PaperChain:  # its low-pass starts anew behind such a block
        off[[31, 34]] = 0.0
    assert np.nanmax(off) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_clipped_readings_and_a_limited_current_are_told(scene, rng, method):
    readings = scene.readings(10, rng)
    readings[4, :, 0] = np.clip(readings[4, :, 0] + 9.99, -10.0, 10.0)
    readings[7, 1000, 1] = -5.1
    config = replace(scene.config(), full_scale=10.0, current_limit=5.0)
    sensed = method(config).sense(readings)
    assert sensed.reason[4] & bits("clipped")
    assert sensed.reason[7] & bits("current limit")
    assert not sensed.reason[[0, 3, 9]].any()


@pytest.mark.parametrize("method", METHODS)
def test_swapped_channels_and_an_inverted_monitor_have_no_capacitors_phase(scene, rng, method):
    readings = scene.readings(10, rng)
    for wrong in (readings[:, :, ::-1].copy(), readings * [1.0, -1.0]):
        sensed = method(scene.config()).sense(wrong)
        assert (sensed.reason == bits("phase out of band")).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_missing_channel_and_noise_alone_have_lost_their_amplitude(scene, rng, method):
    readings = scene.readings(10, rng)
    readings[:, :, 1] = 0.0
    assert (method(scene.config()).sense(readings).reason & bits("amplitude lost")).all()


@pytest.mark.parametrize("factor", [0.5, 0.8, 0.9, 0.99, 1.01, 1.02, 1.25, 2.0])
def test_a_wrong_rate_never_gives_a_capacitance(scene, rng, factor):
    """The record's true rate is another than the one stated: the carrier seems to be elsewhere."""
    true = scene.but(rate_hz=scene.rate_hz * factor)
    sensed = Lockin(scene.config()).sense(true.readings(20, rng))
    assert not sensed.valid.any()


@pytest.mark.long
@given(
    scale=st.floats(0.1, 100.0),
    phase_rad=st.floats(0.0, 6.28),
)
def test_capacitance_is_linear_in_the_currents_quadrature(scene, scale, phase_rad):
    """C is Im Y / omega of a pure capacitor: adding two currents adds the two capacitances."""
    one = scene.but(resistance_ohm=0.0, phase_rad=phase_rad)
    two = scene.but(resistance_ohm=0.0, phase_rad=phase_rad, capacitance_f=scale * 1.5e-9)
    a, b = one.readings(1, None), two.readings(1, None)
    both = a.copy()
    both[:, :, 1] += b[:, :, 1]
    lockin = Lockin(scene.config())
    total_f = lockin.sense(both).capacitance_f[0]
    parts_f = lockin.sense(a).capacitance_f[0] + lockin.sense(b).capacitance_f[0]
    assert total_f == pytest.approx(parts_f, rel=2e-6)


@given(shift=st.integers(0, 5000))
def test_a_shift_in_time_leaves_the_capacitance(scene, shift):
    case = scene.but(carrier_hz=1913.0)
    record = case.readings(5, None).reshape(-1, 2)[shift : shift + 2000]
    sensed = Lockin(case.config()).sense(record[np.newaxis])
    assert sensed.capacitance_f[0] == pytest.approx(case.capacitance_f, rel=2e-6)


def test_leakage_and_its_deviation_are_those_of_a_resistor_in_parallel(scene, rng):
    """A drive of 0.2 V on the monitor, 1 V/s, over 10 nS: I = G V + C dV/dt beside the carrier."""
    case, leakage_s = scene.but(ramp_v_s=0.2), 10e-9
    readings = case.readings(200, rng)
    readings[:, :, 0] += 0.2
    ramp_v = 0.2 + 0.2 * np.arange(200 * 2000).reshape(200, 2000) / 200e3
    readings[:, :, 1] += scene.ohm_per_ratio * leakage_s * ramp_v
    sensed = Lockin(case.config()).sense(readings)
    error = (sensed.leakage_s - leakage_s) / sensed.leakage_std_s
    assert abs(error.mean()) < 5 / np.sqrt(200)
    assert error.std() == pytest.approx(1.0, abs=5 / np.sqrt(400))


def test_a_large_leakage_leaves_capacitance_and_resistance(scene):
    """R in series with C and G in parallel, in closed form; without noise."""
    omega = 2 * np.pi * scene.carrier_hz
    capacitance_f, resistance_ohm, leakage_s = 1.5e-9, 5e3, 5e-6
    z = resistance_ohm + 1 / (leakage_s + 1j * omega * capacitance_f)
    time_s = np.arange(2000) / scene.rate_hz
    voltage = 0.025 * np.exp(1j * omega * time_s)
    current = voltage * scene.ohm_per_ratio / z
    level_v = 0.5
    through = level_v * scene.ohm_per_ratio / (resistance_ohm + 1 / leakage_s)
    block = np.stack([voltage.real + level_v, current.real + through], axis=1)[np.newaxis]
    sensed = Lockin(scene.config()).sense(block)
    # The level sees R + 1/G, 2.5 % more than 1/G: C moves by the square of a small part of it.
    assert sensed.leakage_s[0] == pytest.approx(leakage_s / (1 + resistance_ohm * leakage_s), 1e-4)
    assert sensed.capacitance_f[0] == pytest.approx(capacitance_f, rel=4e-3)
    naive_f = -1 / (omega * z.imag)
    assert abs(naive_f - capacitance_f) > 10 * abs(sensed.capacitance_f[0] - capacitance_f)


def test_reasons_have_words():
    assert reason_text(0) == ""
    assert reason_text(bits("clipped", "carrier off")) == "clipped; carrier off"


@pytest.mark.parametrize("blocks", [4, 199, 200, 2000])
def test_the_converters_step_is_found_however_long_the_record_is(blocks):
    """Also where the length is a whole number of carrier periods, 50 readings a period."""
    time = np.arange(blocks * 2000)
    noise = np.random.default_rng(blocks).normal(0.0, 0.05, (time.size, 2))
    readings = 8.0 * np.sin(2.0 * np.pi * time / 50.0)[:, np.newaxis] + noise
    step = np.array([3e-3, 5e-4])
    found = converter_step(np.round(readings).reshape(blocks, 2000, 2) * step)
    assert found == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize("steps", [0.3, 0.6])
@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_a_carrier_below_one_step_of_the_converter_is_refused(steps: float, noise: float) -> None:
    rng, lsb = np.random.default_rng(1), 20.0 / 2**12
    turn = np.exp(2j * np.pi * 2000.0 * np.arange(2000 * 20) / 200e3 + 0.3j)
    i = 2.5e6 * 2j * np.pi * 2000.0 * 1e-9 * turn
    ideal = steps * lsb * np.stack([turn.real, i.real], axis=1) + [1.0, 0.0]
    record = np.round(ideal / lsb + noise * rng.standard_normal(ideal.shape)) * lsb
    config = LockinConfig(200e3, 2000, 2000.0, 0.0, 2.5e6, min_amplitude_codes=1e-6)
    assert not Lockin(config).sense(record.reshape(-1, 2000, 2)).valid.any()
