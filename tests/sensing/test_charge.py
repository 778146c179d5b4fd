"""Capacitance without a carrier, against closed forms."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.sensing import Charge, ChargeConfig, Sensed
from haselab.sensing.charge.noise import hum_of

OHM, CAPACITANCE_F, RATE_HZ = 2.5e6, 1e-9, 1000.0
KAPPA_S = OHM * CAPACITANCE_F  # current over the voltage's slope, both as readings
COUNT, BLOCK = 40_000, 500
TIME_S = (np.arange(COUNT) + 0.5) / RATE_HZ


def triangle(hz: float = 0.5, late_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """0 to 2 V, and its slope."""
    turn = ((TIME_S + late_s) * hz + 0.13) % 1.0
    return 2.0 - 2.0 * np.abs(2.0 * turn - 1.0), np.where(turn < 0.5, 4.0, -4.0) * hz


def noisy(v: np.ndarray, i: np.ndarray, noise_v: float = 1e-3, seed: int = 1) -> tuple:
    rng = np.random.default_rng(seed)
    return v + noise_v * rng.standard_normal(v.size), i + noise_v * rng.standard_normal(v.size)


def sensed(v: np.ndarray, i: np.ndarray, **changes: float) -> Sensed:
    return Charge(ChargeConfig(RATE_HZ, BLOCK, OHM, **changes)).sense_channels(v, i)


def errors(result: Sensed, truth_f: np.ndarray | float) -> np.ndarray:
    """Errors of the valid blocks in stated deviations."""
    return ((result.capacitance_f - truth_f) / result.capacitance_std_f)[result.valid]


def assert_honest(z: np.ndarray) -> None:
    # Blocks of one cycle share its anchors, so some 20 of 80 errors are independent: their rms
    # scatters by 1 / sqrt(40), of which five are 0.8; no normal error of 80 exceeds 5.
    assert np.abs(z).max() < 5.0
    assert 0.2 < np.sqrt(np.mean(z**2)) < 1.8


def test_a_triangle_gives_the_capacitance_within_the_stated_deviation() -> None:
    v, slope = triangle()
    result = sensed(*noisy(v, KAPPA_S * slope + 5e-3))
    assert result.valid.all()
    assert_honest(errors(result, CAPACITANCE_F))
    np.testing.assert_allclose(result.time_s, 0.2495 + 0.5 * np.arange(80), atol=1e-12)
    assert np.isnan(result.resistance_ohm).all()
    assert np.isnan(result.phase_rad).all()


def test_a_capacitance_that_grows_with_the_square_of_the_voltage_is_its_weighted_mean() -> None:
    # q = k (1 + a v^2) v, so i = k (1 + 3 a v^2) v': a fit of C dv/dt would read 1 + 3 a v^2.
    v, slope = triangle()
    share = 0.075
    result = sensed(*noisy(v, KAPPA_S * (1 + 3 * share * v**2) * slope))
    blocks = v.reshape(-1, BLOCK)
    truth_f = CAPACITANCE_F * (1 + share * (blocks**4).sum(axis=1) / (blocks**2).sum(axis=1))
    assert result.valid.all()
    assert_honest(errors(result, truth_f))


def test_a_sine_of_20_hz_at_200_hz_loses_nothing_to_the_sampling() -> None:
    time_s = np.arange(8000) / 200.0
    v = 2.0 * np.sin(2 * np.pi * 20 * time_s)
    i = KAPPA_S * 4 * np.pi * 20 * np.cos(2 * np.pi * 20 * time_s)
    result = Charge(ChargeConfig(200.0, 100, OHM)).sense_channels(*noisy(v, i, 1e-5))
    # Six nodes a step leave (h^6) 191 / 60480 with h = 0.2 pi rad: 1.9e-4.
    assert result.valid.all()
    assert np.abs(result.capacitance_f / CAPACITANCE_F - 1.0).max() < 2.5e-4


def test_holds_at_a_high_voltage_give_numbers_too_and_leakage_is_found() -> None:
    knots, at = [0.0, 1.0, 2.0, 3.0, 4.0], (TIME_S + 0.3) % 4.0
    v = np.interp(at, knots, [0.0, 0.0, 2.0, 2.0, 0.0])
    slope = np.interp(at, knots[1:], [0, 0, 0, 0]) + np.where(
        (at >= 1) & (at < 2), 2.0, np.where(at >= 3, -2.0, 0.0)
    )
    result = sensed(*noisy(v, KAPPA_S * slope + 2e-4 * v + 3e-3))
    assert result.valid.mean() > 0.8
    assert_honest(errors(result, CAPACITANCE_F))
    leakage_s, std_s = result.leakage_s[result.valid][0], result.leakage_std_s[result.valid][0]
    assert abs(leakage_s - 2e-4 / OHM) < 5 * std_s
    assert leakage_s > 5 * std_s
    idle = np.abs(v.reshape(-1, BLOCK)).max(axis=1) == 0.0
    assert idle.any()
    assert not result.valid[idle].any()
    assert "hardly changes" in result.reason_of(int(np.flatnonzero(idle)[0]))


def test_a_stated_skew_is_taken_out() -> None:
    skew_s = 3.3e-3
    v = 2.0 * np.sin(2 * np.pi * 5 * TIME_S)
    i = KAPPA_S * 20 * np.pi * np.cos(2 * np.pi * 5 * (TIME_S + skew_s))
    right, wrong = (sensed(*noisy(v, i), skew_s=s) for s in (skew_s, 0.0))
    assert_honest(errors(right, CAPACITANCE_F))
    # One that is not stated turns the current by 0.1 rad, which shows as a loss: named, and wider.
    assert np.abs(errors(wrong, CAPACITANCE_F)).max() < 5.0
    assert all("leakage or hysteresis" in wrong.model(k) for k in range(80))
    assert wrong.capacitance_std_f.mean() > 5 * right.capacitance_std_f.mean()


def test_hum_on_the_current_is_named_and_costs_nothing() -> None:
    v, slope = triangle()
    hum = 0.05 * np.sin(2 * np.pi * 50 * TIME_S)
    result = sensed(*noisy(v, KAPPA_S * slope + hum))
    assert result.valid.all()
    assert_honest(errors(result, CAPACITANCE_F))
    assert "hum at 50 Hz" in result.model(10)


def test_a_harmonic_of_the_drive_is_no_hum() -> None:
    v, slope = triangle(2.0)
    assert hum_of(v, KAPPA_S * (1 + 0.1 * v**2) * slope, 1 / RATE_HZ) == 0.0


def test_loss_that_may_be_leakage_or_hysteresis_widens_the_deviation() -> None:
    v, slope = triangle()
    lossless = sensed(*noisy(v, KAPPA_S * slope))
    lossy = sensed(*noisy(v, KAPPA_S * slope + 4e-4 * v))
    assert "leakage or hysteresis" in "".join(lossy.seen.values())
    # Half of G, 2e-4, is in doubt; from the foot of a ramp to its middle and back it charges at
    # most T V / 16 = 0.125 V s less than its mean would, 2 % of k V at the middle of the ramp.
    extra_f = np.sqrt(lossy.capacitance_std_f**2 - lossless.capacitance_std_f**2)
    assert 0.005 < np.nanmax(extra_f) / CAPACITANCE_F < 0.04
    assert_honest(errors(lossy, CAPACITANCE_F))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v, i: (v + 1.0, i), "does not cross 0 V"),
        (lambda v, i: (v, -i), "inverted"),
        (lambda v, i: (v, 0.0 * i), "hardly changes"),
        (lambda v, i: (0.0 * v, 0.0 * i), "hardly changes"),
        (lambda v, i: (0.05 * TIME_S + 0.001, 0.05 * KAPPA_S + 0.0 * i), "not separable"),
        (lambda v, i: (np.where(v > 1.0, 2.0, 0.0), 0.0 * i), "steps faster"),
    ],
)
def test_a_record_that_cannot_be_sensed_says_why(change, words) -> None:
    v, slope = triangle()
    result = sensed(*noisy(*change(v, KAPPA_S * slope)))
    assert not result.valid.any()
    assert np.isnan(result.capacitance_f).all()
    assert any(words in result.reason_of(k) for k in range(80))


def test_clipped_and_missing_values_spoil_their_own_runs_alone() -> None:
    v, slope = triangle()
    v, i = noisy(v, KAPPA_S * slope)
    i[10_100], v[25_100] = np.nan, 12.0
    result = sensed(v, i, full_scale=9.9)
    assert result.reason_of(20) == "not a finite number"
    assert result.reason_of(50) == "clipped"
    assert result.valid.sum() == 78
    assert_honest(errors(result, CAPACITANCE_F))


def test_a_burst_on_the_current_is_found_where_the_charge_does_not_close() -> None:
    v, slope = triangle()
    v, i = noisy(v, KAPPA_S * slope)
    i[20_000:20_050] += 0.5
    result = sensed(v, i)
    assert "does not return to zero" in result.reason_of(40)
    assert result.valid.mean() > 0.9
    assert np.abs(errors(result, CAPACITANCE_F)).max() < 5.0


def test_an_offset_that_drifts_is_followed() -> None:
    v, slope = triangle()
    result = sensed(*noisy(v, KAPPA_S * slope + 1e-2 * TIME_S / 40))
    assert result.valid.all()
    assert_honest(errors(result, CAPACITANCE_F))


def test_pieces_leave_no_trace() -> None:
    v, slope = triangle()
    v, i = noisy(v, KAPPA_S * slope)
    charge = Charge(ChargeConfig(RATE_HZ, BLOCK, OHM))
    for k in range(0, COUNT, 7 * BLOCK):
        charge.add(v[k : k + 7 * BLOCK], i[k : k + 7 * BLOCK])
    np.testing.assert_array_equal(charge.finish().capacitance_f, sensed(v, i).capacitance_f)
    assert charge.finish().valid.size == 0


def test_fast_records_are_thinned_without_bias() -> None:
    time_s = (np.arange(800_000) + 0.5) / 2e5
    turn = time_s * 1.5 % 1.0
    v, slope = 2.0 - 2.0 * np.abs(2.0 * turn - 1.0), np.where(turn < 0.5, 6.0, -6.0)
    config = ChargeConfig(2e5, 100_000, OHM)
    result = Charge(config).sense_channels(*noisy(v, KAPPA_S * slope))
    assert config.points < 512
    assert result.valid.all()
    assert np.abs(errors(result, CAPACITANCE_F)).max() < 5.0


@pytest.mark.parametrize("block", [2000, 1999, 2001])
def test_thinning_leaves_no_sample_out(block: int) -> None:
    config = ChargeConfig(RATE_HZ, block, OHM)
    assert config.points * config.thinning == block
    count = COUNT // block * block
    v, slope = triangle(3.3)
    result = Charge(config).sense_channels(*noisy(v[:count], KAPPA_S * slope[:count], 1e-4))
    assert result.valid.all()
    assert np.abs(errors(result, CAPACITANCE_F)).max() < 5.0


@pytest.mark.parametrize(
    "settings",
    [
        {"block_samples": 15},
        {"rate_hz": 0.0},
        {"ohm_per_ratio": float("nan")},
        {"skew_s": 0.2},
    ],
)
def test_settings_outside_their_range_are_refused(settings) -> None:
    with pytest.raises(InputError, match=r"must be|requires"):
        ChargeConfig(
            **{"rate_hz": RATE_HZ, "block_samples": BLOCK, "ohm_per_ratio": OHM} | settings
        )


def test_columns_that_are_no_whole_blocks_are_refused() -> None:
    charge = Charge(ChargeConfig(RATE_HZ, BLOCK, OHM))
    with pytest.raises(InputError, match="whole blocks"):
        charge.add(np.zeros(501), np.zeros(501))
    with pytest.raises(InputError, match="do not fit"):
        charge.sense(np.zeros((2, 499, 2)))


@pytest.mark.parametrize("noise_v", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("monitor", ["voltage", "current"])
def test_a_monitor_that_saturates_below_full_scale_is_named(monitor: str, noise_v: float) -> None:
    omega = 2 * np.pi * 0.9
    v, i = noisy(np.sin(omega * TIME_S), KAPPA_S * omega * np.cos(omega * TIME_S), noise_v)
    if monitor == "voltage":
        v = np.minimum(v, 0.85)
    else:
        i = np.maximum(i, -0.7 * KAPPA_S * omega)
    result = sensed(v, i)
    words = [result.seen[k] for k in np.flatnonzero(~result.valid)]
    # The voltage is wrong in the blocks that it clips, the charge in all between two passes.
    assert result.valid.mean() < (0.6 if monitor == "voltage" else 0.01)
    assert set(words) == {f"flat top: the {monitor} monitor saturates"}
    assert np.abs(errors(result, CAPACITANCE_F)).max(initial=0.0) < 5.0


@pytest.mark.parametrize("share", [0.0, 1.0 / 24.0, 0.1])
@pytest.mark.parametrize("noise_v", [0.0, 1e-4, 1e-3])
def test_a_current_that_a_growing_capacitance_flattens_is_no_flat_top(
    share: float, noise_v: float
) -> None:
    # With 2 V peak and a share of 1/24 the current of a sine is flat to the fourth order.
    omega = 2 * np.pi * 0.9
    v, slope = 2.0 * np.sin(omega * TIME_S), 2.0 * omega * np.cos(omega * TIME_S)
    assert sensed(*noisy(v, KAPPA_S * (1 + 3 * share * v**2) * slope, noise_v)).valid.all()


@pytest.mark.parametrize("noise_v", [0.0, 1e-4, 3e-4])
def test_noise_that_hardly_reaches_an_edge_of_the_converter_is_no_dither(noise_v: float) -> None:
    # The current is 0.51 steps: readings of 0 and 1 in turn, whose variance looks like noise.
    lsb = 20.0 / 2**12
    v, slope = triangle(0.25)
    v, i = noisy(v, 0.51 * lsb * np.sign(slope), noise_v)
    result = sensed(np.round(v / lsb) * lsb, np.round(i / lsb) * lsb)
    assert not result.valid.any()
    assert set(result.seen.values()) == {"converter step too coarse for the current"}


def test_a_leakage_below_zero_is_a_skew_that_was_not_stated() -> None:
    omega, skew_s = 2 * np.pi * 2.0, 5e-3
    v = np.sin(omega * TIME_S)
    i = KAPPA_S * omega * np.cos(omega * (TIME_S + skew_s))
    result = sensed(*noisy(v, i))
    assert result.valid.all()
    assert np.isnan(result.leakage_s).all()
    assert set(result.seen.values()) == {"negative leakage, as from a skew of 5 ms"}
    stated = sensed(*noisy(v, i), skew_s=skew_s)
    assert np.abs(stated.leakage_s / stated.leakage_std_s).max() < 5.0


def test_swapped_columns_are_named() -> None:
    v, slope = triangle()
    v, i = noisy(v, KAPPA_S * slope)
    result = sensed(i, v)
    assert not result.valid.any()
    assert set(result.seen.values()) == {"the columns seem swapped"}
