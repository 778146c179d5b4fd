"""`python -m benchmarks.rig.safety [--twin N] [--wire N] [--trials N]`: the safety chain.

The time from the loss of a guardian to an output below 50 V on a served twin, by the wall clock;
then random interleavings of commands, faults and safe acts, with a count of what happened in them.
A count of 0 leaves a part out.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import statistics
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test

from benchmarks.rows import CHECKOUT, Row

TESTS = CHECKOUT / "tests"
STEPS = 30
CASES = [
    (slot, helper, program)
    for helper in ("SIGKILL", "SIGSTOP")
    for program in ("", "SIGKILL")
    for slot in (0, 1)
]


def load(folder: str, name: str) -> Any:
    path = TESTS / folder / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"{folder}_{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[f"{folder}_{name}"] = module
    spec.loader.exec_module(module)
    return module


def interleavings(twin: int, wire: int) -> Iterator[Row]:
    """A case that breaks the invariant ends the run with its shortest list of steps."""
    module = load("safety", "interleavings")
    for name, machine, count in (
        ("twin", module.Interleavings, twin),
        ("wire", module.WireInterleavings, wire),
    ):
        if not count:
            continue
        module.COUNTS.clear()
        given = settings(
            max_examples=count, stateful_step_count=STEPS, deadline=None, database=None,
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        try:
            run_state_machine_as_test(machine, settings=given)
        finally:
            module.WireUnderTest.stop()
        for what, number in sorted(module.COUNTS.items()):
            yield Row(f"{name}: {what}", number, "times")
        yield Row(f"{name}: above 50 V without a permission", 0, "times", 0, False)


def lost_guardians(trials: int) -> Iterator[Row]:
    wire = load("faults", "wire_campaign")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        with wire.links.Forks(TESTS / "faults" / "wire_campaign.py", root / "socket") as forks:
            for slot, helper, program in CASES if trials else ():
                times_s = []
                for trial in range(trials):
                    place = root / f"{slot}-{helper}-{program}-{trial}"
                    outcome = wire.outside(place, program, "in ramp", forks, [(slot, helper)])
                    assert outcome.highest_v > 4500.0
                    times_s.append(outcome.after_s)
                word = {"SIGKILL": "killed", "SIGSTOP": "stopped"}[helper]
                also = " and the program killed" if program else ""
                yield Row(
                    f"guardian {slot + 1} {word}{also}", 1e3 * statistics.median(times_s), "ms",
                    500.0, False, f"worst {1e3 * max(times_s):.0f} ms of {len(times_s)}",
                )  # fmt: skip


def rows(twin: int = 1000, wire: int = 200, trials: int = 20) -> Iterator[Row]:
    """All figures, each as soon as it is known."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HASELAB_INTERLOCKS"] = folder
        yield from lost_guardians(trials)
        yield from interleavings(twin, wire)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for option, default in (("--twin", 1000), ("--wire", 200), ("--trials", 20)):
        parser.add_argument(option, type=int, default=default)
    given = parser.parse_args()
    for row in rows(given.twin, given.wire, given.trials):
        print(row, flush=True)
