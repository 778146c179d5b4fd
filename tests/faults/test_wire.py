"""Every fault on the real drivers' wires: 0 V in time, the reason recorded, no block lost."""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

NEEDED = ("nidaqmx", "grpc", "pyvisa", "pyvisa_py", "pymeasure", "serial")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]
if sys.platform == "win32":
    pytest.skip("signals and ptys are POSIX's", allow_module_level=True)
if MISSING:
    pytest.skip(f"pip install 'haselab[instruments]': no {MISSING}", allow_module_level=True)


def _campaign() -> ModuleType:
    path = Path(__file__).with_name("wire_campaign.py")
    spec = importlib.util.spec_from_file_location("fault_wire_campaign", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fault_wire_campaign"] = module
    spec.loader.exec_module(module)
    return module


wire = _campaign()


@pytest.fixture(scope="module")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    socket = tmp_path_factory.mktemp("forks") / "socket"
    with wire.links.Forks(Path(wire.__file__), socket) as started:
        yield started


def _checked(outcome: Any) -> Any:
    assert outcome.output_v < wire.campaign.SAFE_V
    assert outcome.readable >= outcome.acknowledged
    return outcome


@pytest.mark.parametrize(("fault", "moment"), [c for c in wire.cases() if c[0] in wire.FAULTS])
def test_a_fault_on_the_wire_ends_at_zero_with_its_reason_and_all_blocks(
    tmp_path: Path, forks: Any, fault: str, moment: str
) -> None:
    given = wire.FAULTS[fault]
    # Where the voltage never rose, the machine was too busy to open the bench within the drivers'
    # 0.5 s or to renew the guardian's lease: the bench was made safe, and nothing was struck.
    for attempt in range(3):
        outcome = _checked(wire.inside(tmp_path / f"{attempt}", fault, moment, forks))
        if outcome.highest_v > 0.0 or moment == "before arming":
            break
    assert outcome.highest_v > 4500.0 or moment == "before arming"
    recorded = " ".join(outcome.recorded.split())
    assert re.search(given.words, outcome.told if moment == "before arming" else recorded)
    if given.guardian and moment != "before arming":
        done = '"(confirmed_off|commanded_0_v)": true'
        assert re.search(done, recorded), "the guardian has acted"


@pytest.mark.parametrize(("name", "moment"), [c for c in wire.cases() if c[0] in wire.SIGNALS])
def test_a_signal_ends_a_program_behind_the_real_drivers_at_zero(
    tmp_path: Path, forks: Any, name: str, moment: str
) -> None:
    words, _ = wire.SIGNALS[name]
    outcome = _checked(wire.outside(tmp_path, name, moment, forks))
    if moment != "before arming":
        assert outcome.highest_v > 4500.0
        assert words in outcome.recorded


@pytest.mark.parametrize("slot", [0, 1])
@pytest.mark.parametrize("helper", ["SIGKILL", "SIGSTOP"])
@pytest.mark.parametrize("program", ["", "SIGKILL"])
def test_one_guardian_is_enough(
    tmp_path: Path, forks: Any, program: str, helper: str, slot: int
) -> None:
    """The program is killed at the same moment, or left alone: it is to notice."""
    outcome = _checked(
        wire.outside(tmp_path, program, "in ramp", forks, [(slot, helper)], patient=True)
    )
    assert outcome.highest_v > 4500.0
    assert re.search("(?i)program has ended|guardian", outcome.recorded)


def test_there_are_at_least_thirty_faults_on_the_wire() -> None:
    assert len(list(wire.cases())) >= 30


def test_without_a_fault_the_same_run_ends_well_and_the_guardian_rests(
    tmp_path: Path, forks: Any
) -> None:
    with wire.Bench(tmp_path, lambda bench: None) as bench:
        bench.configure("timeout_s = 30.0\n")  # a busy machine is no fault
        command = forks.command("guardian", str(tmp_path / "guardian.toml"))
        play = wire.Play(tmp_path, command, lambda what: None)
        play.run()
        assert bench.settled_v() < wire.campaign.SAFE_V
    assert play.recorder.blocks == wire.wires.RAMP_BLOCKS + wire.wires.STEP_BLOCKS
    recorded, readable = wire.campaign.left(tmp_path)
    said = recorded.splitlines()
    assert said[3].startswith("controller step: pid, kp = ")
    assert said[:3] + said[4:] == ["start ramp", "end ramp", "start step", "end step"]
    assert readable == play.recorder.blocks
    assert not (tmp_path / "guardian.log").exists()
