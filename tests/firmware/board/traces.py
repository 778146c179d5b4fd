"""Updates that the co-simulated chip reported one by one, for the tests of its bits."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path

from haselab.firmware.messages import VERSION, Hello, Run, SetReference, SetTelemetry, Trace
from haselab.rig.chip import CoSim, Firmware
from haselab.rig.twin.twin_bench import TwinBench

UPDATES = 10_000


def bits(value: float) -> str:
    return struct.pack(">f", value).hex()


def latched(trace: Trace) -> str:
    """One line of input for `firmware/sim/replay.c`."""
    return f"{' '.join(map(str, trace.codes))} {trace.event} {trace.alarms} {bits(trace.reference)}"


def reported(trace: Trace) -> list[str]:
    """State, code, strain and drive, as `replayed` returns them."""
    return [str(trace.state), str(trace.code), bits(trace.strain), bits(trace.corrected)]


def replayed(program: Path, lines: list[str]) -> list[list[str]]:
    """What `firmware/sim/replay.c` makes of such lines."""
    done = subprocess.run(
        [str(program)], input="\n".join(lines), capture_output=True, text=True, check=True
    )
    rows = [line.split() for line in done.stdout.splitlines()]
    return [[row[0], row[3], row[5], row[6]] for row in rows]


def traced(
    firmware: Firmware, cosim_program: Path, twin: TwinBench, references: tuple[float, ...]
) -> list[Trace]:
    """Arming, the loop closed, steps: every update of 10 s, as the chip reported it."""
    with CoSim(cosim_program, firmware.elf, twin) as chip:
        chip.run(0.02)
        chip.query(Hello(VERSION))
        chip.execute(SetTelemetry(0, 1))
        chip.arm()
        chip.execute(Run(0.0))
        while len(chip.messages) < UPDATES + 200:
            chip.execute(SetReference(references[int(chip.time_s) % len(references)]), 0.1)
        assert chip.bad_frames == 0
    return [message for message in chip.messages if isinstance(message, Trace)]
