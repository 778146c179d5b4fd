"""The loop watchdog by itself: its checks on made-up signals, and its limits in the rig file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError, Limits
from haselab.models.maps import VoltageMap
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import describe
from haselab.safety.rig_limits import safety_of
from haselab.safety.watchdog.loop_model import capacitance_range, loop_model
from haselab.safety.watchdog.loop_signals import Delay, Repeats
from haselab.safety.watchdog.loop_watchdog import LoopSample, LoopWatchdog, OutputWatchdog
from haselab.safety.watchdog.plant_direction import direction_ratio
from haselab.safety.watchdog.settings import FieldRating, WatchdogSettings, permit_expired

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
RIG = describe(TwinConfig())
MODEL = loop_model(RIG, EQ4, (-0.04, 0.1), (2000.0, 0.02), 5e-3, (4.9e8, -0.27, 0.0, 0.0))
SETTINGS = WatchdogSettings()


def codes_of(rng: np.random.Generator, drive_v: float = 0.0) -> np.ndarray:
    """A block with noise and the level of a drive."""
    codes = rng.integers(-3, 4, (RIG.block_samples, 2)).astype(np.int16)
    codes[:, 0] += np.int16(round(drive_v * MODEL.code_per_v))
    return codes


def watched(strains, drives, references, watchdog: LoopWatchdog | None = None) -> tuple[int, str]:
    """The block at which a watchdog trips, and why."""
    watchdog = watchdog or LoopWatchdog(MODEL, SETTINGS)
    rng = np.random.default_rng(1)
    for k, (strain, drive_v, desired) in enumerate(zip(strains, drives, references, strict=True)):
        farad = (strain + 0.27) / 4.9e8
        sample = LoopSample(float(strain), farad, float(drive_v), float(desired))
        if fault := watchdog.fault(codes_of(rng, drive_v), sample):
            return k, fault
    return -1, ""


def second_order(x: np.ndarray, omega: float, zeta: float, gain: float) -> np.ndarray:
    """Response of a plant to blocks of 10 ms, by 100 Euler steps each."""
    strain = speed = 0.0
    out = np.empty(len(x))
    for k, value in enumerate(x):
        for _ in range(100):
            speed += 1e-4 * (omega**2 * (gain * value - strain) - 2.0 * zeta * omega * speed)
            strain += 1e-4 * speed
        out[k] = strain
    return out


@pytest.mark.parametrize("flat", [False, True])
def test_the_static_strain_is_the_interpolated_one_also_beyond_the_map(flat) -> None:
    volts = MODEL.map_drive_v.copy()
    if flat:  # parts of the map at one drive
        volts[:3], volts[-3:], volts[50:54] = volts[0], volts[-1], volts[50]
    watchdog = LoopWatchdog(replace(MODEL, map_drive_v=volts), SETTINGS)
    random = np.random.default_rng(4).uniform(volts[0] - 0.5, volts[-1] + 0.5, 2000)
    for drive_v in [*random.tolist(), *volts.tolist(), math.inf, -math.inf, math.nan]:
        wanted = float(np.interp(drive_v, volts, MODEL.map_strain))
        assert np.array_equal(watchdog._static(drive_v), wanted, equal_nan=True)


@pytest.mark.parametrize("omega", [8.0, 15.0, 33.0, 60.0])
@pytest.mark.parametrize("gain", [0.3, 1.0])
def test_the_direction_of_a_plant_is_found_without_knowing_the_plant(omega, gain) -> None:
    rng = np.random.default_rng(2)
    x = np.where(np.arange(50) < 12, 0.0, 0.04) + 0.01 * np.sin(0.3 * np.arange(50))
    noise = 1e-4 * rng.standard_normal(50)
    right = direction_ratio(x, second_order(x, omega, 0.12, gain) + noise)
    wrong = direction_ratio(x, second_order(x, omega, 0.12, -gain) + noise)
    # Noise of 47 degrees of freedom cannot favour one sign by a ratio of 1.6: that is 8 sigma.
    assert right < 1.2
    assert wrong > SETTINGS.direction_ratio


@pytest.mark.parametrize(
    ("strain", "reason"),
    [(math.inf, "out of range"), (1e300, "out of range"), (-0.5, "out of range")],
)
def test_a_strain_that_cannot_be_trips_at_once(strain: float, reason: str) -> None:
    noise = 1e-4 * np.random.default_rng(3).standard_normal(50)
    strains = np.where(np.arange(50) < 40, noise, strain)
    block, fault = watched(strains, np.ones(50), np.zeros(50))
    assert block == 40
    assert reason in fault


def test_a_repeated_block_is_frozen_and_a_noisy_one_is_not() -> None:
    rng = np.random.default_rng(4)
    repeats = Repeats("Block", 0.01, 0.1, "")
    assert not any(repeats.fault(float(value)) for value in rng.standard_normal(1000))
    faults = [repeats.fault(7.0) for _ in range(12)]
    assert faults.index(next(f for f in faults if f)) == 10  # the first one is new


def test_ten_repetitions_are_forgotten_after_a_second() -> None:
    repeats = Repeats("Block", 0.01, 0.1, "")
    sequence = np.arange(150.0)
    assert not any(repeats.fault(float(value)) for value in [*sequence, *sequence])


def test_a_swinging_output_trips_but_not_one_whose_reference_swings() -> None:
    rng = np.random.default_rng(5)
    blocks = np.arange(300)
    strains = 1e-4 * rng.standard_normal(300)
    square_v = np.where(blocks // 2 % 2, 0.7, 1.3)  # 25 Hz
    block, fault = watched(strains, square_v, np.zeros(300))
    assert "Output oscillates" in fault
    assert block * 0.01 < 0.5
    swinging = 0.02 + 0.02 * np.sign(square_v - 1.0)
    free = LoopWatchdog(MODEL, WatchdogSettings(charges_per_s=100.0, response_share=1e-9))
    assert "oscillates" not in watched(strains, square_v, swinging, free)[1]


@pytest.mark.parametrize("queued", [0, 1, 2])
def test_the_step_of_the_first_output_is_no_jump_and_a_later_one_is(queued: int) -> None:
    """The paper's chain takes 0.03 off in the block in which a step of 1 V comes out."""
    model = replace(MODEL, queued=queued)
    for block in range(10):
        strains = 1e-4 * np.random.default_rng(8).standard_normal(30)
        strains[block] -= 0.03
        found, fault = watched(strains, np.ones(30), np.zeros(30), LoopWatchdog(model, SETTINGS))
        if block <= queued:  # what comes before the step is at rest, and not the loop's doing
            assert fault == ""
        elif block > queued + 1:
            assert "Strain jumped" in fault
            assert found in (block, block + 1)


def test_an_actuator_with_a_high_resonance_may_move_as_fast_as_it_can() -> None:
    """A step by 0.35 of the range, hardly damped, at 16 Hz; a slow actuator cannot do this."""
    fast = replace(MODEL, resonance_rad_s=2.0 * math.pi * 16.0)
    step = np.repeat([0.0, 0.35 * MODEL.range], [20, 60])
    strains = second_order(step, fast.resonance_rad_s, 0.05, 1.0)
    strains += 1e-4 * np.random.default_rng(4).standard_normal(80)
    drives = EQ4.voltage_v(step)
    for model, said in ((fast, ""), (MODEL, "Strain jumped")):
        found, fault = watched(strains, drives, step, LoopWatchdog(model, SETTINGS))
        assert (found > 0, fault[: len(said)]) == (bool(said), said)


QUICK = replace(MODEL, strain_low=-0.04, strain_high=0.1, resonance_rad_s=2.0 * math.pi * 15.5)


def largest_step(zeta: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strains, drives and references of a step by 0.86 of the range at 15.5 Hz, after 0.2 s."""
    step = np.repeat([-0.03, 0.09], [20, 60])
    strains = second_order(step + 0.03, QUICK.resonance_rad_s, zeta, 1.0) - 0.03
    strains += 1e-4 * np.random.default_rng(4).standard_normal(80)
    return strains, EQ4.voltage_v(step), step


@pytest.mark.parametrize("zeta", [0.05, 0.17])
def test_the_largest_step_of_a_quick_actuator_is_no_jump(zeta: float) -> None:
    """A curling HASEL with 15.5 Hz and a damping of 0.17: the rate changes by 0.46 of the range."""
    strains, drives, step = largest_step(zeta)
    assert np.abs(np.diff(strains, 2)).max() > 0.3 * QUICK.range
    settings = replace(SETTINGS, range_margin=1.0)
    assert watched(strains, drives, step, LoopWatchdog(QUICK, settings)) == (-1, "")
    constant = np.full(80, drives[0])  # the drive does not explain it
    _, fault = watched(strains, constant, step, LoopWatchdog(QUICK, SETTINGS))
    assert fault.startswith("Strain jumped")


@pytest.mark.parametrize(("block", "share"), [(12, 0.4), (21, 1.2), (55, 0.4)])
def test_a_jump_is_found_before_during_and_after_the_largest_step(block: int, share: float) -> None:
    """In the 0.2 s after a step, the drive explains more."""
    strains, drives, step = largest_step(0.17)
    strains[block] += share * QUICK.range
    watchdog = LoopWatchdog(QUICK, replace(SETTINGS, range_margin=1e3))
    found, fault = watched(strains, drives, step, watchdog)
    assert fault.startswith("Strain jumped")
    assert found in (block, block + 1)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_capacitance_that_follows_the_drive_is_no_jump(share: float) -> None:
    """At one length, zipping changes the capacitance of pouches with the voltage, at once."""
    step = np.repeat([0.0, -0.03, 0.05, 0.05, -0.02, 0.01], [20, 1, 1, 1, 1, 40])
    strains = share * step + 1e-4 * np.random.default_rng(4).standard_normal(step.size)
    drives = EQ4.voltage_v(step)
    plain = replace(MODEL, strain_low=-0.04, strain_high=0.1)
    pouch = replace(plain, follows_drive=True)
    settings = replace(SETTINGS, range_margin=1.0)
    assert watched(strains, drives, step, LoopWatchdog(pouch, settings)) == (-1, "")
    _, fault = watched(strains, drives, step, LoopWatchdog(plain, settings))
    assert fault.startswith("Strain jumped")
    for block in (12, 55):  # the drive is constant
        jumped = strains.copy()
        jumped[block] += 0.4 * plain.range
        found, fault = watched(jumped, drives, step, LoopWatchdog(pouch, settings))
        assert fault.startswith("Strain jumped") and found in (block, block + 1)


def test_the_capacitance_of_slack_pouches_is_named_as_a_reason() -> None:
    """Only where the map does not cover it, and the capacitance is that of slack pouches."""
    line = (4.9e8, -0.3, 0.0, 0.0)  # -0.25 at 1.02e-10 F, the end of range and margin
    pouches = replace(MODEL, capacitance_map=line, capacitance_f=6e-10, slack_f=1e-10)
    for farad, slack in ((1.02e-10, True), (0.8e-10, False), (6e-10, False)):
        sample = LoopSample(0.0, farad, 0.0, 0.0)
        for model in (pouches, replace(pouches, slack_f=0.0)):
            watchdog = LoopWatchdog(model, replace(SETTINGS, range_margin=0.4))
            fault = watchdog.fault(codes_of(np.random.default_rng(1)), sample)
            assert fault.startswith("Capacitance out of range") == (farad < 2e-10)
            assert ("slack at any length" in fault) == (slack and model is pouches)


def test_a_high_resonance_does_not_hide_a_broken_sensor() -> None:
    """At any resonance, a jump by 0.6 of the range is found."""
    for resonance_hz in (16.0, 50.0, 500.0):
        model = replace(MODEL, resonance_rad_s=2.0 * math.pi * resonance_hz)
        strains = 1e-4 * np.random.default_rng(9).standard_normal(60)
        strains[40] += 0.6 * MODEL.range
        watchdog = LoopWatchdog(model, replace(SETTINGS, range_margin=1e3))
        found, fault = watched(strains, np.ones(60), np.zeros(60), watchdog)
        assert "Strain jumped" in fault and found == 40


def test_the_charging_energy_is_limited() -> None:
    rng = np.random.default_rng(6)
    drives = np.where(np.arange(100) % 2, 0.78, 1.22)  # below the swings that count
    _, fault = watched(1e-4 * rng.standard_normal(100), drives, np.zeros(100))
    # 0.44 V a block: (0.44 / 2)^2 = 0.048 of a full charge, 100 times a second: 4.84, below 5.
    assert fault == ""
    drives = np.where(np.arange(100) % 2, 0.77, 1.23)  # 5.3 a second
    _, fault = watched(1e-4 * rng.standard_normal(100), drives, np.zeros(100))
    assert "full charges per second (" in fault


@pytest.mark.parametrize(
    ("gain", "swing_v", "declared", "reason"),
    [
        (1.0, 0.0, True, ""),
        (1.0, 0.0, False, "Output oscillates"),
        (-1.0, 0.0, True, "moves against the drive"),
        (1.0, 0.7, True, "Output oscillates"),  # of its magnitude
    ],
)
def test_a_declared_alternation_is_judged_by_its_magnitude(gain, swing_v, declared, reason) -> None:
    """The sign changes every 5 blocks, where the strain is invalid; the voltage steps once."""
    blocks = np.arange(200)
    asked_v = np.where(blocks < 60, 1.0, 1.3)
    magnitude_v = asked_v + swing_v * (blocks // 2 % 2)
    drives = magnitude_v * np.where(blocks // 5 % 2, -1.0, 1.0)
    model = replace(MODEL, alternates=declared)
    asked, static = np.interp([asked_v, magnitude_v], MODEL.map_drive_v, MODEL.map_strain)
    strains = second_order(static - static[0], 33.0, 0.3, gain) + static[0]
    strains += 1e-4 * np.random.default_rng(9).standard_normal(200)
    if declared:
        strains[5::5] = 0.5
    settings = WatchdogSettings(charges_per_s=100.0)
    _, fault = watched(strains, drives, asked, LoopWatchdog(model, settings))
    assert fault == "" if not reason else reason in fault


@pytest.mark.parametrize(("late", "trips"), [(0, False), (1, False), (2, True), (7, True)])
def test_a_monitor_that_lags_behind_is_found_in_the_noise_of_a_hold(late, trips) -> None:
    rng = np.random.default_rng(7)
    delay = Delay(MODEL, SETTINGS)
    drives = 1.0 + 1e-3 * rng.standard_normal(60)
    faults = [
        delay.fault(codes_of(rng, 0.0) + np.int16(0), 0.0)
        if k < 10
        else delay.fault(_level(rng, drives[k - late]), drives[k])
        for k in range(60)
    ]
    assert any(faults) == trips


def _level(rng: np.random.Generator, drive_v: float) -> np.ndarray:
    """A block whose level is finer than a code: as noise and carrier make it."""
    codes = np.zeros((RIG.block_samples, 2), dtype=np.int16)
    exact = drive_v * MODEL.code_per_v + rng.uniform(-0.5, 0.5, RIG.block_samples)
    codes[:, 0] = np.round(exact)
    return codes


def test_a_field_above_the_rating_trips_and_grows_with_the_capacitance() -> None:
    rating = FieldRating(30e6, 300e-6, 5e-10)
    assert rating.field_v_per_m(6000.0, 5e-10) == pytest.approx(20e6)
    assert rating.field_v_per_m(6000.0, 2e-9) == pytest.approx(40e6)  # half as thick
    watchdog = LoopWatchdog(MODEL, SETTINGS, rating)
    rng = np.random.default_rng(8)
    block, fault = watched(
        1e-4 * rng.standard_normal(30), np.where(np.arange(30) < 20, 1.0, 1.9), np.zeros(30),
        watchdog,
    )  # fmt: skip
    assert (block, fault[:14]) == (20, "Field too high")


def test_the_range_of_capacitance_is_that_of_the_map() -> None:
    low, high = capacitance_range((4.9e8, -0.27, 0.0, 0.0), -0.1, 0.2)
    assert low == pytest.approx(0.17 / 4.9e8)
    assert high == pytest.approx(0.47 / 4.9e8)
    slope, offset, bend = 8.1e8, -0.38, -2.49e17
    for farad, strain in zip(capacitance_range((slope, offset, bend, 0.0), -0.1, 0.2),
                             (-0.1, 0.2), strict=True):  # fmt: skip
        assert (bend * farad + slope) * farad + offset == pytest.approx(strain)
    # The parabola has its top at 0.28: from there on no strain of the range is reached.
    high = capacitance_range((slope, offset, bend, 0.0), -0.1, 0.5)[1]
    assert high == pytest.approx(-slope / (2.0 * bend))
    # A cubic factor that keeps it rising: the root of the whole polynomial.
    cubic = 1.2e26
    high = capacitance_range((slope, offset, bend, cubic), -0.1, 0.5)[1]
    assert ((cubic * high + bend) * high + slope) * high + offset == pytest.approx(0.5)
    # A line that meets the range below 0 F only: no capacitance is below 0.
    assert capacitance_range((4.9e8, -0.27, 0.0, 0.0), -0.5, -0.4) == (0.0, 0.0)


def test_the_range_of_capacitance_of_a_map_that_falls() -> None:
    assert capacitance_range((-4.9e8, 0.27, 0.0, 0.0), -0.2, 0.1) == pytest.approx(
        (0.17 / 4.9e8, 0.47 / 4.9e8)
    )
    # strain = 0.02 - (c - 1)^2 (c + 0.5) / 10 with c in nF: it falls from 1 nF on, and rises below
    falling = (0.0, -0.03, 0.15e18, -0.1e27)
    low, high = capacitance_range(falling, -0.1, 0.1, about_f=1.6e-9)
    assert low == pytest.approx(1e-9)  # the strain is at most 0.02, at the turning point
    assert -0.03 + 0.15e18 * high**2 - 0.1e27 * high**3 == pytest.approx(-0.1)


def test_a_rig_with_its_own_controller_is_watched_by_its_output() -> None:
    rng = np.random.default_rng(9)
    watchdog = OutputWatchdog(RIG, Limits("strain", -0.05, 0.1, ""), SETTINGS)
    faults = [watchdog.fault(codes_of(rng), 0.5 + k // 2 % 2, 0.0) for k in range(50)]
    assert any("oscillates" in fault for fault in faults)
    frozen = OutputWatchdog(RIG, Limits("strain", -0.05, 0.1, ""), SETTINGS)
    block = codes_of(rng)
    assert "Block stuck" in [frozen.fault(block, 1.0, 0.0) for _ in range(12)][-1]


def test_a_permit_expires() -> None:
    assert permit_expired(100.0, 14400.0) == ""
    assert "armed for 14500 s" in permit_expired(14500.0, 14400.0)


@pytest.mark.parametrize("value", [math.inf, math.nan, 0.0, -1.0])
def test_a_limit_that_would_switch_its_check_off_is_refused(value: float) -> None:
    with pytest.raises(InputError, match=r"safety\.loop\.jump_share is .* finite and above 0"):
        WatchdogSettings(jump_share=value)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"current_limit_a": math.inf}, "current_limit_a"),
        ({"rate_limit_v_per_s": math.inf}, "rate_limit_v_per_s"),
        ({"permit_age_s": math.nan}, "permit_age_s"),
        ({"loop": {"swings_per_s": math.inf}}, "loop.swings_per_s"),
        ({"loop": {"swing": 3.0}}, "no limit named 'swing'"),
    ],
)
def test_the_rig_file_takes_finite_limits_only(tmp_path: Path, table, reason) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    with pytest.raises(InputError, match=reason):
        safety_of(load_rig(path), table, path)


def test_the_rig_file_changes_a_limit_of_the_loop(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    settings = safety_of(load_rig(path), {"loop": {"swings_per_s": 30}}, path)
    assert settings.loop == WatchdogSettings(swings_per_s=30)
