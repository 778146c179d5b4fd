"""Every fault at every moment: 0 V in time, the reason recorded, no block lost."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest


def _campaign() -> ModuleType:
    path = Path(__file__).with_name("campaign.py")
    spec = importlib.util.spec_from_file_location("fault_campaign", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fault_campaign"] = module
    spec.loader.exec_module(module)
    return module


campaign = _campaign()
IN_TIME_S = 0.1
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="signals and pipes are POSIX's")


@pytest.fixture(scope="module")
def programs() -> Iterator[Any]:
    with campaign.Programs() as started:
        yield started


def _assert_kept(outcome: Any) -> None:
    assert abs(outcome.output_v) < campaign.SAFE_V
    assert outcome.readable >= outcome.acknowledged


@POSIX
@pytest.mark.parametrize(
    ("fault", "moment"), [case for case in campaign.cases() if case[0] not in campaign.SIGNALS]
)
def test_a_fault_ends_at_zero_in_time_with_its_reason_and_all_blocks(
    tmp_path: Path, fault: str, moment: str
) -> None:
    _, words, _ = campaign.FAULTS[fault]
    # The machine may be late once; then it is the fault's turn again.
    for trial in range(3):
        outcome = campaign.inside(tmp_path / str(trial), fault, moment)
        if outcome.after_s < IN_TIME_S:
            break
    assert outcome.after_s < IN_TIME_S
    _assert_kept(outcome)
    assert outcome.highest_v > 4500.0 or moment == "before arming"
    reasons = outcome.told if moment == "before arming" else outcome.recorded.replace("\n", " ")
    assert re.search(words, reasons)
    if fault in campaign.PUT_RIGHT:
        assert outcome.told == ""
    elif moment != "in closing":  # there the output is down already, and the record says it
        assert re.search(words, outcome.told)


@POSIX
@pytest.mark.parametrize(
    ("name", "moment"), [case for case in campaign.cases() if case[0] in campaign.SIGNALS]
)
def test_a_signal_ends_at_zero_in_time_with_its_reason_and_all_blocks(
    tmp_path: Path, programs: Any, name: str, moment: str
) -> None:
    words, limit_s = campaign.SIGNALS[name]
    for trial in range(3):
        outcome = programs.outside(tmp_path / str(trial), name, moment)
        if outcome.after_s < limit_s:
            break
    assert outcome.after_s < limit_s
    _assert_kept(outcome)
    if moment == "before arming":
        assert outcome.highest_v == 0.0
    else:
        assert outcome.highest_v >= 2500.0
        assert words in outcome.recorded


def test_there_are_at_least_sixty_faults() -> None:
    assert len(list(campaign.cases())) >= 60


def test_without_a_fault_the_same_run_ends_well(tmp_path: Path) -> None:
    trouble = campaign.Trouble(
        campaign.TwinBench(campaign.twin_of_reading("hz"), 3), lambda trouble: None
    )
    count: list[int] = []
    campaign.play(tmp_path, trouble, "never", campaign.SafetySettings(), count)
    assert count == [campaign.RAMP_BLOCKS + campaign.STRIKE_STEP + 40]
    assert trouble.twin.output_v == pytest.approx(0.0, abs=1.0)
    assert not (tmp_path / "guardian.log").exists()
