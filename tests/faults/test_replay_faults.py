"""Every fault while a session is replayed: 0 V asked for in time, the reason, no block lost."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from haselab.base import InputError
from haselab.rig.replay import ReplayBench


def _sibling(name: str) -> ModuleType:
    path = Path(__file__).with_name(f"{name}.py")
    key = f"fault_{name}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, path)
        assert spec is not None and spec.loader is not None
        sys.modules[key] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[key])
    return sys.modules[key]


campaign = _sibling("campaign")
replay = _sibling("replay_campaign")
CASES = [(fault, moment) for fault, (_, _, at) in replay.FAULTS.items() for moment in at]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = replay.record(tmp_path_factory.mktemp("replay") / "recorded")
    return path


@pytest.mark.skipif(sys.platform == "win32", reason="the guardian and signals are POSIX's")
@pytest.mark.parametrize(("fault", "moment"), CASES)
def test_a_fault_of_a_replay_ends_at_zero_with_its_reason_and_all_blocks(
    tmp_path: Path, recorded: Path, fault: str, moment: str
) -> None:
    outcome = replay.inside(recorded, tmp_path / "run", fault, moment)
    assert outcome.output_v == 0.0
    assert outcome.readable >= outcome.acknowledged
    assert re.search(replay.FAULTS[fault][1], outcome.told + " ".join(outcome.recorded.split()))
    assert outcome.told
    if moment != "before arming":
        assert outcome.highest_v > 4500.0
        assert re.search(replay.FAULTS[fault][1], " ".join(outcome.recorded.split()))


@pytest.mark.parametrize("how", ["cut short", "overwritten", "without its header"])
def test_a_damaged_session_is_refused_before_anything_is_armed(
    tmp_path: Path, recorded: Path, how: str
) -> None:
    copy = replay.damaged_file(recorded, tmp_path / "session.h5", how)
    with pytest.raises(
        InputError,
        match=r"(not a complete haselab session \(|The session was changed after).*session\.h5$",
    ):
        ReplayBench(copy)


@pytest.mark.skipif(sys.platform == "win32", reason="the guardian is POSIX's")
def test_without_a_fault_the_replay_gives_the_recorded_blocks(
    tmp_path: Path, recorded: Path
) -> None:
    counted: list[int] = []
    with ReplayBench(recorded) as bench:
        replay._play(bench, tmp_path, "never", lambda: None, counted)
    events, readable = campaign.left(tmp_path)
    assert counted == [readable] == [campaign.RAMP_BLOCKS + campaign.STRIKE_STEP + 40]
    said = events.splitlines()
    assert said[3].startswith("controller step: pid, kp = ")
    assert said[:3] + said[4:5] == ["start ramp", "end ramp", "start step", "end step"]
