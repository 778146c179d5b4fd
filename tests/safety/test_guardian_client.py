"""The program's side of the guardians: two threads that read their answers at the same time."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from haselab.base import DeviceError
from haselab.safety.guardian.client import Guardians
from haselab.safety.interlock import Interlock

SLOW = """
import os, sys, time
time.sleep(0.3)
print("ready", os.getpid(), sys.argv[1], flush=True)
for line in sys.stdin:
    if line.startswith("safe"):
        print("acted all off", flush=True)
    if line.startswith("bye"):
        break
"""


@pytest.fixture
def interlock(tmp_path: Path) -> Iterator[Interlock]:
    with contextlib.closing(Interlock(f"test-guardians-{tmp_path.name}")) as found:
        yield found


def guardians_of(interlock: Interlock, program: str, log: Path) -> Guardians:
    return Guardians([sys.executable, "-c", program, interlock.key], log, interlock)


def test_a_result_that_is_awaited_does_not_take_the_first_answer(
    interlock: Interlock, tmp_path: Path
) -> None:
    """STOP waits for the guardians of the last run while a page requests the next one."""
    guardians = guardians_of(interlock, SLOW, tmp_path / "guardian.log")
    starting = threading.Thread(target=guardians.start, daemon=True)
    starting.start()
    answers: list[str] = []
    waiting = threading.Thread(target=lambda: answers.append(guardians.outcome()), daemon=True)
    while len(guardians.pids) < 2:
        starting.join(0.001)
    waiting.start()
    starting.join(20.0)
    assert not starting.is_alive() and 0 not in guardians.pids
    guardians.make_safe("test")
    waiting.join(20.0)
    assert answers == [""] and "took the bench to 0 V" in guardians.lost()
    guardians.close()


@pytest.mark.parametrize(
    ("program", "why"),
    [
        ("print('failed no such rig')", "no such rig"),
        ("print('ready 1 another')", "ready 1 another"),
        ("", "it did not respond"),
    ],
)
def test_a_guardian_that_does_not_start_is_named_with_its_reason(
    program: str, why: str, interlock: Interlock, tmp_path: Path
) -> None:
    guardians = guardians_of(interlock, program, tmp_path / "guardian.log")
    with pytest.raises(DeviceError, match=f"Guardian 1 did not start: {why}"):
        guardians.start()
    assert guardians.pids == []
