"""The chip and this machine make the same bits of the same readings."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from haselab.firmware.messages import Event, Trace
from haselab.rig.chip import Firmware, source_folder
from haselab.rig.twin.twin_bench import TwinBench
from tests.firmware.board.traces import UPDATES, latched, replayed, reported, traced

ROOT = source_folder()
CORE = sorted((ROOT / "core").glob("*.c"))
REPLAY = [
    *CORE,
    ROOT / "firmware/app/app.c",
    ROOT / "firmware/app/controller_pid.c",
    ROOT / "firmware/sim/replay.c",
]
REFERENCES = (0.0, 0.03, 0.06, 0.02, -0.02, 0.045, 0.01, 0.08, -0.039, 0.03)
KEPT = 1000
GOLDEN = Path(__file__).resolve().parent / "data" / "trace.txt"


@pytest.fixture(scope="module")
def traces(firmware: Firmware, cosim_program: Path, twin: TwinBench) -> list[Trace]:
    found = traced(firmware, cosim_program, twin, REFERENCES)
    if os.environ.get("KEEP_TRACE"):
        lines = [f"{latched(trace)} | {' '.join(reported(trace))}\n" for trace in found[:KEPT]]
        GOLDEN.write_text("".join(lines), encoding="ascii")
    return found


def test_ten_thousand_updates_in_a_row_are_traced(traces: list[Trace]) -> None:
    numbers = [trace.update for trace in traces]
    assert len(numbers) >= UPDATES
    assert all(b == (a + 1) % 65536 for a, b in itertools.pairwise(numbers))
    assert {Event.ARM, Event.RUN, Event.SET_REFERENCE} <= {trace.event for trace in traces}
    assert len({trace.code for trace in traces}) > 300  # the loop moved


@pytest.mark.parametrize("flags", [("-O0",), ("-O3",), ("-O3", "-march=native")], ids=" ".join)
def test_strain_controller_and_code_of_the_chip_are_this_machines_bit_by_bit(
    flags: tuple[str, ...], traces: list[Trace], host: Callable[..., Path]
) -> None:
    program = host(f"replay{len(flags)}{flags[0]}", REPLAY, *flags)
    rows = replayed(program, [latched(trace) for trace in traces])
    # The first window reaches back to readings from before the first trace.
    different = [k for k, trace in enumerate(traces) if k > 0 and rows[k] != reported(trace)]
    assert len(rows) == len(traces)
    assert not different, (different[:5], traces[different[0]], rows[different[0]])


@pytest.mark.parametrize("flags", [("-O0",), ("-O3", "-march=native")], ids=" ".join)
def test_without_a_simulator_kept_traces_prove_the_same(
    flags: tuple[str, ...], host: Callable[..., Path]
) -> None:
    """`data/trace.txt`: what the chip latched | what it reported, of a co-simulation."""
    kept = [line.split(" | ") for line in GOLDEN.read_text(encoding="ascii").splitlines()]
    program = host(f"golden{len(flags)}", REPLAY, *flags)
    rows = replayed(program, [line for line, _ in kept])
    assert [" ".join(row) for row in rows][1:] == [answer for _, answer in kept][1:], (
        "settings or firmware changed: keep a new trace by KEEP_TRACE=1 pytest " + __file__
    )
