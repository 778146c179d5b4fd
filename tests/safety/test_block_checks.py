"""Blocks that must stop the bench, and blocks of hard but honest work that must not."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.safety.state_machine import SafetySettings
from haselab.safety.watchdog.block_checks import BlockWatch

RIG = describe(TwinConfig())
CODE_PER_V = 65536 / 20.0
SETTINGS = SafetySettings()
AMPLIFIER_ALONE = dataclasses.replace(SETTINGS, current_limit_a=15e-3)


def block(volt: float = 0.0, ampere: float = 0.0) -> np.ndarray:
    """Constant monitors: volts of the drive, amperes of the output (2 mA a volt)."""
    codes = np.empty((2000, 2), np.int16)
    codes[:, 0], codes[:, 1] = round(volt * CODE_PER_V), round(ampere / 2e-3 * CODE_PER_V)
    return codes


@pytest.mark.parametrize(
    "config", [{}, {"acquisition": {"block_samples": 200, "output_delay_s": 2e-4}}]
)
def test_the_hardest_drives_of_an_honest_bench_never_trip(config: dict[str, object]) -> None:
    # Full steps up and down, noise over the whole range, the triangle: with the carrier on.
    twin = TwinBench(TwinConfig.model_validate(config), 7)
    rig = twin._description
    watch = BlockWatch(rig, SETTINGS)
    twin.sine(2000.0, 0.02)
    watch.carrier_v = 0.02
    rng = np.random.default_rng(1)
    drives = np.concatenate([
        np.repeat([0.0, 2.0, 0.0, 2.0, 1.0], 20), rng.uniform(0.0, 2.0, 300),
        np.abs(np.linspace(-2.0, 2.0, 200)),
    ])  # fmt: skip
    for value in drives:
        twin.write(float(value))
        assert watch.fault(twin.read(), float(value)) == ""


def test_outputs_that_are_queued_are_expected_when_they_take_effect() -> None:
    # One output is queued ahead: what is asked before a block shows in the block after it.
    rig = dataclasses.replace(RIG, switch_sample=2000 + 400)
    requested_v = [0.0, 0.0, 0.0, 0.5, 1.0, 2.0, 0.0, 1.5, 1.5, 0.7]
    honest, early = BlockWatch(rig, SETTINGS), BlockWatch(rig, SETTINGS)
    for k in range(2, len(requested_v)):
        codes = block(requested_v[k - 1])
        codes[:400] = block(requested_v[k - 2])[:400]
        assert honest.fault(codes, requested_v[k]) == ""
    reported = [early.fault(block(value), value) for value in requested_v]
    # Shown a block too early, all changes above a tenth of the range of 2 V are found.
    changes = np.flatnonzero(np.abs(np.diff(requested_v, prepend=0.0)) > 0.2)
    assert [k for k, text in enumerate(reported) if text] == changes.tolist()


@pytest.mark.parametrize(
    ("codes", "words"),
    [
        (block(0.1, 12e-3), r"Breakdown: output collapsed to 500\.\d V of 5000 V at 12 mA"),
        (block(1.0, 1.5e-3), r"Over-current: 1\.5 mA with the output settled \(limit 1 mA\)"),
        (block(0.0), r"Output does not follow: 0 V read back, requested 5000 V"),
        (block(1.25), r"Output does not follow: 6250 V read back"),
        (block(-1.0), r"Output does not follow: -5000 V read back"),
    ],
)
def test_a_block_with_a_fault_says_which(codes: np.ndarray, words: str) -> None:
    watch = BlockWatch(RIG, SETTINGS)
    watch.rest(1.0)
    assert watch.fault(block(1.0), 1.0) == ""
    assert re.search(words, watch.fault(codes, 1.0))


def test_a_current_at_the_end_of_its_range_trips_after_a_millisecond() -> None:
    watch = BlockWatch(RIG, AMPLIFIER_ALONE)
    watch.rest(1.0)
    for samples, trips in ((200, False), (201, True)):
        codes = block(1.0)
        codes[:samples, 1] = 32767
        assert ("end of its range" in watch.fault(codes, 1.0)) is trips


def test_a_few_sparks_in_the_wires_do_not_trip() -> None:
    watch = BlockWatch(RIG, SETTINGS)
    watch.rest(1.0)
    codes = block(1.0)
    codes[::25, 0] = 32000  # 4 % of the samples
    assert watch.fault(codes, 1.0) == ""
    codes[::15, 0] = 32000  # 7 %
    assert "does not follow" in watch.fault(codes, 1.0)


@pytest.mark.parametrize("carrier_v", [0.0, 0.01, 0.1])
def test_what_is_left_is_the_carrier_s_amplitude(carrier_v: float) -> None:
    twin = TwinBench(twin_of_reading("hz"), 2)
    twin.sine(2000.0, carrier_v)
    watch = BlockWatch(RIG, SETTINGS)
    for _ in range(2):
        left_v = watch.residual_v(twin.read())
    # The amplifier raises 2 kHz by 2.6 %; noise and quantisation: 0.3 mV rms are 2.1 V.
    assert left_v == pytest.approx(1.026 * 5000.0 * carrier_v, rel=0.01, abs=2.5)


def test_outputs_that_waited_may_be_skipped_where_blocks_may_be_passed_over() -> None:
    # A loop ends with a hard drive while three outputs wait; then the computer is late, the stream
    # is let go, and the last one stands at once.
    rig = dataclasses.replace(RIG, switch_sample=3 * 2000 + 400)
    requested_v = [1.8, 1.8, 1.7, 1.4, 0.9, 0.1, 0.0]
    for follows in (True, False):
        watch = BlockWatch(rig, SETTINGS)
        watch.rest(1.8)
        for value in requested_v[:-1]:
            watch.fault(block(1.8), value)
        fault = watch.fault(block(0.0), requested_v[-1], follows=follows)
        assert bool(fault) == follows
    # Soon only the last one asked for is right, whatever was passed over.
    for _ in range(8):
        assert watch.fault(block(0.0), 0.0, follows=False) == ""
    assert "does not follow" in watch.fault(block(1.0), 0.0, follows=False)
