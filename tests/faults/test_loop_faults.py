"""A closed loop that misbehaves trips with the right reason within 0.5 s of its own time."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest


def _loop_faults() -> ModuleType:
    path = Path(__file__).with_name("loop_faults.py")
    spec = importlib.util.spec_from_file_location("loop_faults", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["loop_faults"] = module
    spec.loader.exec_module(module)
    return module


faults = _loop_faults()
IN_TIME_S = 0.5


def check(case, reading: str, seed: int) -> None:
    outcome = faults.play(case, reading, seed)
    assert re.search(case.reason, outcome.reason), outcome
    assert 0.0 <= outcome.after_s <= IN_TIME_S + 1e-9, outcome
    assert outcome.output_v == 0.0


def test_the_board_has_at_least_26_misbehaviours() -> None:
    assert len({case.name for case in faults.CASES}) >= 26


@pytest.mark.parametrize("case", faults.CASES, ids=lambda case: case.name)
def test_a_misbehaviour_trips_in_time_with_its_reason(case) -> None:
    check(case, case.readings[0], 1 if case.misses else 0)  # one that is missed now and then


@pytest.mark.slow
@pytest.mark.parametrize("case", faults.CASES, ids=lambda case: case.name)
def test_it_does_at_random_moments_and_operating_points(case) -> None:
    missed = 0
    for reading in case.readings:
        for seed in range(1, 6):
            outcome = faults.play(case, reading, seed)
            if outcome.reason == "":
                missed += 1
            else:
                check(case, reading, seed)
    assert missed <= case.misses


@pytest.mark.parametrize("reading", ["hz", "rad"])
@pytest.mark.parametrize("reference", ["hold", "step", "sine"])
@pytest.mark.parametrize("video", [False, True], ids=["capacitance", "video"])
def test_a_loop_without_a_fault_does_not_trip(reading: str, reference: str, video: bool) -> None:
    case = faults.Case("nothing", "", reference=reference, video=video)
    assert faults.play(case, reading, 3, blocks_after=300).reason == ""


def test_a_square_reference_near_the_resonance_does_not_trip() -> None:
    case = faults.Case("nothing", "", reference="square")
    assert faults.play(case, "hz", 3, blocks_after=900).reason == ""


def test_a_reference_beyond_reach_saturates_without_a_trip() -> None:
    case = faults.Case("nothing", "", reference="step", loop=faults.gains(0.4, 5.0))
    assert faults.play(case, "hz", 4, blocks_after=300).reason == ""
