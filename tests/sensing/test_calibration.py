"""Calibration: closed forms, simulated noise, and every refusal."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.sensing import Lockin, LockinConfig
from haselab.sensing.calibration import (
    Calibration,
    Reference,
    ReferenceReading,
    fit_calibration,
    read_reference,
)

CARRIER_HZ, RATE_HZ = 2000.0, 200e3
OMEGA = 2 * np.pi * CARRIER_HZ
SCALE_S = 4e-7 / 1.12 * np.exp(0.03j)
STRAY_S = 1j * OMEGA * 30e-12


def reading_of(reference: Reference, noise: complex = 0.0, std: float = 1e-6) -> ReferenceReading:
    """What monitors of this scale and stray show, from the series circuit itself."""
    z = reference.series_ohm + 1 / (1j * OMEGA * reference.capacitance_f)
    return ReferenceReading((1 / z + STRAY_S) / SCALE_S + noise, std, (0.001, -0.002))


def fitted(references: list[Reference], readings: list[ReferenceReading]) -> Calibration:
    return fit_calibration(
        references,
        readings,
        carrier_hz=CARRIER_HZ,
        rate_hz=RATE_HZ,
        amplifier="one",
        date="2026-01-01",
    )


def calibration_of(*references: Reference) -> Calibration:
    return fitted(list(references), [reading_of(r) for r in references])


TWO = (Reference(0.47e-9), Reference(2.2e-9, 50.0))
CONFIG = LockinConfig(RATE_HZ, 2000, CARRIER_HZ, 2.5e-6, 2.5e6)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_scale_and_stray_come_back_exactly_without_noise(count):
    references = [Reference(c, 20.0) for c in np.geomspace(0.3e-9, 5e-9, count)]
    c = calibration_of(*references)
    assert c.scale_s == pytest.approx(SCALE_S, rel=1e-9)
    assert c.stray_s == pytest.approx(STRAY_S, rel=1e-7)
    assert c.stray_f == pytest.approx(30e-12, rel=1e-7)
    assert c.residual < 1e-9
    assert c.offsets_v == pytest.approx((0.001, -0.002))
    other = Reference(1.234e-9, 7e3)
    assert c.capacitance_f(reading_of(other).ratio) == pytest.approx(1.234e-9, rel=1e-9)


@pytest.mark.long
def test_the_stated_uncertainty_is_the_scatter_over_many_calibrations():
    """4,000 draws of noise and of values within tolerance: their scatter is known to 1.1 %."""
    rng = np.random.default_rng(5)
    stated = [Reference(0.5e-9, 0.0, 0.01), Reference(2e-9, 0.0, 0.005), Reference(4e-9)]
    std = (0.05, 0.2, 0.1)
    found, sizes = [], []
    target = reading_of(Reference(1e-9, 5e3)).ratio
    for _ in range(4000):
        readings = []
        for r, s in zip(stated, std, strict=True):
            off = rng.uniform(-r.tolerance, r.tolerance)
            noise = s * complex(*rng.standard_normal(2))
            true = replace(r, capacitance_f=r.capacitance_f * (1 + off))
            readings.append(reading_of(true, noise, s))
        c = fitted(stated, readings)
        found.append(c.capacitance_f(target))
        sizes.append(abs(c.scale_s))
    # Five times 1.1 %, and 1 % for the weights' own dependence on the draw.
    assert c.capacitance_std_f(1e-9, 5e3) == pytest.approx(np.std(found), rel=0.065)
    assert c.scale_std_s == pytest.approx(np.std(sizes), rel=0.065)
    assert np.mean(found) == pytest.approx(1e-9, abs=5 * np.std(found) / np.sqrt(4000) + 1e-13)


def test_a_tolerance_of_all_references_is_that_of_the_result():
    exact = calibration_of(Reference(0.5e-9), Reference(4e-9))
    loose = calibration_of(Reference(0.5e-9, 0.0, 0.01), Reference(4e-9, 0.0, 0.01))
    assert exact.capacitance_std_f(4e-9) < 1e-5 * 4e-9
    # At a reference, the fit is that reference: a half-width of 1 % is 1 % / sqrt 3.
    assert loose.capacitance_std_f(4e-9) == pytest.approx(0.01 * 4e-9 / np.sqrt(3), rel=1e-3)


def test_the_better_reference_counts_more():
    exact, loose = Reference(1e-9), Reference(1e-9, 0.0, 0.2)
    low = Reference(0.3e-9)
    wrong = reading_of(Reference(1.1e-9))  # within the tolerance of `loose` alone
    c = fitted([low, exact, loose], [reading_of(low), reading_of(exact), wrong])
    assert abs(c.scale_s / SCALE_S - 1) < 1e-6
    assert c.residual == pytest.approx(0.1 / np.sqrt(3), rel=0.15)


def test_readings_are_averaged_and_their_noise_is_that_of_the_mean():
    rng = np.random.default_rng(2)
    blocks, sigma, v, i = 200, 1e-3, 0.02, 0.2
    angle = OMEGA * np.arange(2000) / RATE_HZ
    clean = np.stack([v * np.cos(angle) + 0.01, i * np.cos(angle + 1.5) - 0.02], axis=1)
    record = clean + sigma * rng.standard_normal((blocks, 2000, 2))
    reading = read_reference(record, rate_hz=RATE_HZ, carrier_hz=CARRIER_HZ)
    per_quadrature = sigma * np.sqrt(2 / 2000)
    expected = i / v * per_quadrature * np.hypot(1 / v, 1 / i) / np.sqrt(blocks)
    assert reading.ratio_std == pytest.approx(expected, rel=5 / np.sqrt(4 * blocks))
    assert abs(reading.ratio - i / v * np.exp(1.5j)) < 5 * np.sqrt(2) * expected
    assert reading.offsets_v == pytest.approx((0.01, -0.02), abs=5 * sigma / np.sqrt(4e5))
    lsb_v = 20 / 2**16
    codes = np.round(record / lsb_v).astype(np.int16)
    same = read_reference(codes, rate_hz=RATE_HZ, carrier_hz=CARRIER_HZ, volt_per_reading=lsb_v)
    assert abs(same.ratio - reading.ratio) < 5 * reading.ratio_std
    assert same.offsets_v == pytest.approx(reading.offsets_v, abs=1e-5)


def test_an_applied_calibration_makes_the_lock_in_absolute():
    c = calibration_of(*TWO)
    config = c.apply(CONFIG, amplifier="one", volt_per_reading=20 / 2**16)
    assert config.scale_s == c.scale_s
    assert config.stray_s == c.stray_s
    assert config.offsets == pytest.approx((0.001 * 2**16 / 20, -0.002 * 2**16 / 20))
    truth = Reference(1.5e-9, 5e3)
    angle = OMEGA * np.arange(2000) / RATE_HZ
    wave = np.exp(1j * angle)
    ratio = reading_of(truth).ratio
    block = np.stack([(300 * wave).real, (300 * ratio * wave).real], axis=1)
    # Readings without noise; the lock-in's sums are in float32 at the least.
    sensed = Lockin(config).sense(block[np.newaxis])
    assert sensed.capacitance_f[0] == pytest.approx(1.5e-9, rel=1e-5)
    assert sensed.resistance_ohm[0] == pytest.approx(5e3, rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "amplifier", "words"),
    [
        ({"carrier_hz": 2010.0}, "one", r"carrier of 2000 Hz, not 2010 Hz\. Sense at"),
        ({"rate_hz": 100e3}, "one", r"rate of 200000 Hz, not 100000 Hz"),
        ({}, "two", r"amplifier 'one', not 'two'\. Calibrate this amplifier"),
    ],
)
def test_another_carrier_rate_or_amplifier_is_refused(changes, amplifier, words):
    with pytest.raises(InputError, match=words):
        calibration_of(*TWO).apply(replace(CONFIG, **changes), amplifier=amplifier)


def test_a_generator_that_is_a_few_parts_in_a_million_off_is_the_same_carrier():
    near = replace(CONFIG, carrier_hz=CARRIER_HZ * (1 + 5e-7))
    assert calibration_of(*TWO).apply(near, amplifier="one").scale_s is not None


def test_fewer_than_two_references_are_refused():
    with pytest.raises(InputError, match=r"1 reference capacitor.* at least 2"):
        calibration_of(Reference(1e-9))
    with pytest.raises(InputError, match=r"2 references and 1 readings"):
        fitted(list(TWO), [reading_of(TWO[0])])


@pytest.mark.parametrize(
    "references",
    [
        (Reference(1e-9), Reference(1e-9)),
        (Reference(1e-9, 0.0, 0.05), Reference(1.1e-9, 0.0, 0.05)),
    ],
)
def test_references_that_are_equal_within_tolerance_are_refused(references):
    with pytest.raises(InputError, match=r"equal within noise.* Add|equal readings within"):
        calibration_of(*references)


def test_a_reference_that_was_not_exchanged_is_refused():
    same = reading_of(TWO[0], std=0.01)
    again = ReferenceReading(same.ratio + 0.02, 0.01, (0.0, 0.0))
    with pytest.raises(InputError, match=r"equal readings within noise.* connected in turn"):
        fitted(list(TWO), [same, again])


def test_references_that_contradict_each_other_are_refused_and_the_worst_is_named():
    three = [Reference(0.5e-9), Reference(1e-9), Reference(4e-9)]
    readings = [reading_of(r) for r in (three[0], Reference(1.05e-9), three[2])]
    with pytest.raises(ResultError, match=r"contradict each other .* the worst is 1e-09 F"):
        fitted(three, readings)
    tolerant = [replace(r, tolerance=0.05) for r in three]
    assert fitted(tolerant, readings).residual > 0.01


@pytest.mark.parametrize(
    "values",
    [(0.0,), (-1e-9,), (float("nan"),), (1e-9, -1.0), (1e-9, 0.0, 1.0), (1e-9, 0.0, -0.1)],
)
def test_a_reference_that_cannot_be_is_refused(values):
    with pytest.raises(InputError, match=r"Reference of .* must be in .* 1e-9 for 1 nF"):
        Reference(*values)


def test_too_few_blocks_and_a_missing_carrier_are_refused():
    no_carrier = np.random.default_rng(1).standard_normal((8, 2000, 2))
    with pytest.raises(InputError, match="at least 8 blocks"):
        read_reference(no_carrier[:7], rate_hz=RATE_HZ, carrier_hz=CARRIER_HZ)
    with pytest.raises(ResultError, match=r"8 of 8 blocks show no carrier at 2000 Hz"):
        read_reference(no_carrier, rate_hz=RATE_HZ, carrier_hz=CARRIER_HZ)


@pytest.mark.parametrize("mistake", ["swapped channels", "reversed polarity"])
def test_miswired_monitors_are_named_as_such(rng, mistake):
    angle = 2 * np.pi * 2000.0 * np.arange(8 * 2000) / 200e3
    record = np.stack([np.cos(angle), -0.5 * np.sin(angle)], axis=1)  # of a capacitor
    wrong = record[:, ::-1] if mistake == "swapped channels" else record * [1.0, -1.0]
    noisy = (wrong + 1e-3 * rng.standard_normal(record.shape)).reshape(8, 2000, 2)
    with pytest.raises(ResultError, match=r"8 of 8 blocks have a phase .* polarity .* swapped"):
        read_reference(noisy, rate_hz=RATE_HZ, carrier_hz=CARRIER_HZ)


def test_a_clipped_converter_is_no_reference(rng):
    angle = 2 * np.pi * 2000.0 * np.arange(20 * 2000) / 200e3
    record = np.stack([1000 * np.cos(angle), -40000 * np.sin(angle)], axis=1)
    codes = np.clip(record + rng.standard_normal(record.shape), -32768, 32767).round()
    with pytest.raises(ResultError, match=r"20 blocks are clipped\. Lower the amplitude"):
        read_reference(
            codes.astype(np.int16).reshape(20, 2000, 2), rate_hz=200e3, carrier_hz=2000.0
        )
