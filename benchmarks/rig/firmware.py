"""Resources and reaction times of the firmware, in exact cycles of the co-simulation.

`python -m benchmarks.rig.firmware [--flips 200] [--tries 20] [--seeds 3]`: tries are instants of
a frame, seeds those of the noise in the steps compared with the desktop.
"""

from __future__ import annotations

import argparse
import random
import statistics
import tempfile
import time
from collections import Counter
from pathlib import Path

from benchmarks.rows import Row
from haselab.base import InputError
from haselab.control import step_metrics
from haselab.firmware import FrontEnd
from haselab.firmware.messages import Fault, KeepAlive, Run, State, Status
from haselab.rig.chip import (
    CoSim,
    Firmware,
    build_cosim,
    build_firmware,
    read_design,
    source_folder,
)
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench
from haselab.study.chip.loops import StepPlan, step_experiment

DATA = source_folder() / "tests" / "firmware" / "data"
WORKED_IN_V = 2.0  # as in the study, whose triangle goes so far before anything is fitted
CODE_HIGH = 3800
# Registers, input and output, memory, stack.
PLACES = {"registers": (0x00, 0x20), "input and output": (0x20, 0x137),
          "memory": (0x200, 0x420), "stack": (0x2180, 0x2200)}  # fmt: skip
FAULTS = {
    "main program hangs": ("hang", 20e-3),
    "main program hangs, interrupts off": ("hang_blind", 20e-3),
    "carrier lost": ("carrier", 5e-3),
    "voltage monitor lost": ("wire_v", 5e-3),
    "current monitor lost": ("wire_i", 5e-3),
    "level monitor lost": ("level", 20e-3),
    "conversions stop": ("stall", 5e-3),
    "breakdown": ("breakdown", 0.5e-3),
    "brown-out": ("brown_out", 20e-3),
}


def closed(chip: CoSim, duration_s: float) -> None:
    chip.run(0.02)
    chip.arm()
    chip.execute(Run(0.03))
    end_s = chip.time_s + duration_s
    while chip.time_s < end_s:
        chip.execute(KeepAlive(), 0.045)


def last_status(chip: CoSim) -> Status:
    return next(m for m in reversed(chip.messages) if isinstance(m, Status))


def off_after_s(chip: CoSim, at_s: float) -> float:
    """From the fault to the end of the output; infinite where it is still on."""
    if chip.outputs[-1].on:
        return float("inf")
    last_on = max(k for k, out in enumerate(chip.outputs) if out.on)
    return chip.outputs[last_on + 1].time_s - at_s


def budget(program: Path, built: Firmware, twin: TwinBench) -> list[Row]:
    with CoSim(program, built.elf, twin) as chip:
        closed(chip, 1.0)
        known, start, asleep = len(chip.messages), chip.counts["cycle"], chip.counts["asleep"]
        begun = time.perf_counter()
        for _ in range(100):
            chip.execute(KeepAlive(), 0.1)
        wall_s = time.perf_counter() - begun
        passed = chip.counts["cycle"] - start
        statuses = [m for m in chip.messages[known:] if isinstance(m, Status)]
        load = 1.0 - (chip.counts["asleep"] - asleep) / passed
        ram = built.static_bytes + chip.counts["stack"]
        note = f"{16_000 * load:.0f} of 16,000 cycles"
        longest = max(m.busy_cycles for m in statuses)
        return [
            Row("chip: PID at 1 kHz, share of the cycles", load, "", 0.6, False, note),
            Row("chip: longest update", longest, "cycles", 16_000, False),
            Row("chip: updates not ready in time", statuses[-1].overruns, "", 0, False),
            Row("chip: status frames", len(statuses) / (passed / 16e6), "1/s", 100 * 0.999),
            Row("chip: flash", built.flash_bytes, "B", 16_384, False),
            Row("chip: RAM with the deepest stack", ram, "B", 1024, False),
            Row("co-simulation", passed / 16e6 / wall_s, "s / s"),
        ]


def reactions(program: Path, built: Firmware, twin: TwinBench, tries: int) -> list[Row]:
    found = []
    for name, (fault, allowed_s) in FAULTS.items():
        times_s, faults = [], Counter[str]()
        for k in range(tries):
            with CoSim(program, built.elf, twin) as chip:
                closed(chip, 0.15)
                chip.run(1e-3 * k / tries)
                at_s = chip.fault(fault)
                chip.run(0.06)
                times_s.append(off_after_s(chip, at_s))
                faults[Fault(last_status(chip).fault).name.lower()] += 1
        note = f"least {1e3 * min(times_s):.2f}; reported as {', '.join(faults)}"
        row = Row(
            f"chip: output off, {name}", 1e3 * max(times_s), "ms", 1e3 * allowed_s, False, note
        )
        found.append(row)
    return found


def loops(seeds: int) -> list[Row]:
    """The chip's step and the desktop's at its rate, delay and limits; medians over seeds."""
    found = []
    for reading, data in (("hz", DATA), ("rad", DATA / "rad")):
        design = read_design(data, "pid", FrontEnd())
        settings, zero_m = design.settings, design.zero_length_m
        config, plan = (
            twin_of_reading(reading),
            StepPlan(0.0, 0.04, 10.0, 10.0, zero_m, WORKED_IN_V),
        )
        numbers = []
        for seed in range(1, seeds + 1):
            pair = step_experiment(settings, config, seed, plan).runs[1:]
            numbers.append([step_metrics(r.time_s, r.strain, r.reference).trials[0] for r in pair])
        for what, unit, limit in (("rise_time_s", "", 0.05), ("overshoot", "of the step", 0.05),
                                  ("steady_state_error", "of the step", 0.05)):  # fmt: skip
            desk, chip = (
                statistics.median(getattr(pair[k], what) for pair in numbers) for k in (0, 1)
            )
            off = abs(chip / desk - 1.0) if what == "rise_time_s" else abs(chip - desk)
            note = f"chip {chip:.4g}, desktop {desk:.4g}"
            found.append(Row(f"chip: {reading}, {what} off the desktop's", off, unit, limit, False,
                             note))  # fmt: skip
    return found


def flip(program: Path, built: Firmware, twin: TwinBench, seed: int) -> tuple[str, str, bool]:
    """One bit at one instant: where, its effect, and whether the output stayed below the clamp."""
    rng = random.Random(seed)
    place = rng.choice(list(PLACES))
    with CoSim(program, built.elf, twin) as chip:
        closed(chip, 0.15)
        chip.run(rng.random() * 2e-3)
        chip.command(f"flip {rng.randrange(*PLACES[place])} {rng.randrange(8)}")
        known = len(chip.messages)
        for _ in range(3):
            chip.query(KeepAlive(), 0.05)
        held = max(out.code for out in chip.outputs) <= CODE_HIGH
        statuses = [m for m in chip.messages[known:] if isinstance(m, Status)]
        if chip.counts["resets"] > 0 or chip.counts["crashes"] > 0:
            what = "reset by the watchdog"
        elif not statuses or chip.bad_frames > 1:
            what = "telemetry stopped or garbled"
        elif statuses[-1].state == State.TRIPPED:
            what = f"tripped: {Fault(statuses[-1].fault).name.lower()}"
        elif statuses[-1].state != State.RUNNING:
            what = "off or ramping down"
        elif any(m.reason for m in statuses):
            what = "updates without a strain, then on"
        else:
            what = "runs on"
        chip.run(0.75)
        if chip.outputs[-1].on:
            what += ", AND THE OUTPUT STAYS ON IN SILENCE"
    return place, what, held


def campaign(program: Path, built: Firmware, twin: TwinBench, flips: int) -> list[Row]:
    found = [flip(program, built, twin, seed) for seed in range(flips)]
    above = sum(not held for *_, held in found)
    ends = Counter((place, what) for place, what, _ in found)
    return [
        Row(f"chip: {flips} flipped bits, output above its clamp", above, "", 0, False),
        *(Row(f"  {place}: {what}", count, "") for (place, what), count in sorted(ends.items())),
    ]


def rows(flips: int = 40, tries: int = 5, seeds: int = 1) -> list[Row]:
    twin = TwinBench(twin_of_reading("hz"), 1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = read_design(DATA, "pid", FrontEnd()).settings
        try:
            built, program = build_firmware(settings, folder), build_cosim(folder)
        except InputError as error:
            return [Row(f"chip: {error}", float("nan"), "")]
        return [
            *budget(program, built, twin),
            *reactions(program, built, twin, tries),
            *campaign(program, built, twin, flips),
            *loops(seeds),
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=200)
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    for row in rows(arguments.flips, arguments.tries, arguments.seeds):
        print(row)


if __name__ == "__main__":
    main()
