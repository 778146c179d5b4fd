"""Every fault at every moment: 0 V in time, the reason recorded, no block lost."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from haselab.safety.state_machine import Stage


def _campaign() -> ModuleType:
    path = Path(__file__).with_name("campaign.py")
    spec = importlib.util.spec_from_file_location("fault_campaign", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fault_campaign"] = module
    spec.loader.exec_module(module)
    return module


campaign = _campaign()


@pytest.mark.parametrize(("fault", "moment"), list(campaign.cases()))
def test_a_fault_ends_at_zero_with_its_reason_and_all_blocks_and_stays_there(
    tmp_path: Path, fault: str, moment: str
) -> None:
    _, words, _ = campaign.FAULTS[fault]
    outcome = campaign.inside(tmp_path, fault, moment)
    assert abs(outcome.output_v) < campaign.SAFE_V
    assert outcome.readable >= outcome.acknowledged
    live = moment in campaign.MOMENTS[1:] or moment in ("at its end", "in the gap")
    assert outcome.highest_v > 4500.0 or not live
    if fault in campaign.PUT_RIGHT:
        assert outcome.told == ""
    elif moment not in ("in closing", "at rest"):  # there the output is down already
        assert re.search(words, outcome.told)
    if live and fault != "drive refuses 0 V once":
        assert re.search(words, outcome.recorded.replace("\n", " "))


def test_the_moments_are_all_stages_of_the_safety_chain() -> None:
    """A stage that is added to the state machine has to be added to the matrix."""
    stages = {"requested", "armed", "running", "tripped", "off"}
    assert {stage.value for stage in Stage} == stages
    assert {"before arming", "at rest", "requested", "armed"} <= set(campaign.STAGES) | set(
        campaign.MOMENTS
    )


def test_there_are_at_least_forty_five_faults() -> None:
    assert len(list(campaign.cases())) >= 45


def test_without_a_fault_the_same_run_ends_well(tmp_path: Path) -> None:
    trouble = campaign.Trouble(
        campaign.TwinBench(campaign.twin_of_reading("hz"), 3), lambda trouble: None
    )
    count: list[int] = []
    campaign.play(tmp_path, trouble, "never", campaign.SafetySettings(), count)
    assert count == [campaign.RAMP_BLOCKS + campaign.STRIKE_STEP + 40]
    assert trouble.twin.output_v == pytest.approx(0.0, abs=1.0)
