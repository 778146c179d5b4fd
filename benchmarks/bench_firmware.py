"""What the firmware takes and how fast it reacts, in exact cycles of the co-simulation.

Usage: python benchmarks/bench_firmware.py [--flips N]
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
import time
import tomllib
from collections import Counter
from pathlib import Path

from haselab.firmware import FrontEnd, settings_of_run
from haselab.firmware.messages import Fault, KeepAlive, Run, State, Status
from haselab.rig.mega import CoSim, Firmware, build_cosim, build_firmware, checkout
from haselab.rig.twin.bench import TwinBench
from haselab.rig.twin.config import twin_of_reading

DATA = checkout() / "tests" / "firmware" / "data"
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
    "conversions stop": ("stall", 5e-3),
    "breakdown": ("breakdown", 0.5e-3),
    "brown-out": ("brown_out", 20e-3),
}


def closed(chip: CoSim, duration_s: float) -> None:
    chip.run(0.02)
    chip.arm()
    chip.tell(Run(0.03))
    end_s = chip.time_s + duration_s
    while chip.time_s < end_s:
        chip.tell(KeepAlive(), 0.045)


def last_status(chip: CoSim) -> Status:
    return next(m for m in reversed(chip.messages) if isinstance(m, Status))


def off_after_s(chip: CoSim, at_s: float) -> float:
    """From the fault to the end of the output; infinite where it is still on."""
    if chip.outputs[-1].on:
        return float("inf")
    last_on = max(k for k, out in enumerate(chip.outputs) if out.on)
    return chip.outputs[last_on + 1].time_s - at_s


def budget(program: Path, built: Firmware, twin: TwinBench) -> None:
    with CoSim(program, built.elf, twin) as chip:
        closed(chip, 1.0)
        known, start, asleep = len(chip.messages), chip.counts["cycle"], chip.counts["asleep"]
        begun = time.perf_counter()
        for _ in range(100):
            chip.tell(KeepAlive(), 0.1)
        wall_s = time.perf_counter() - begun
        passed = chip.counts["cycle"] - start
        told = [m for m in chip.messages[known:] if isinstance(m, Status)]
        load = 1.0 - (chip.counts["asleep"] - asleep) / passed
        print(f"flash                       {built.flash_bytes} B")
        print(f"RAM, static + stack         {built.static_bytes} + {chip.counts['stack']:.0f} B")
        print(f"cycles, of 16,000 a ms      {16000 * load:.0f} ({100 * load:.1f} %)")
        print(f"longest update              {max(m.busy_cycles for m in told)} cycles")
        print(f"status frames               {len(told) / (passed / 16e6):.1f} a second")
        print(f"overruns                    {told[-1].overruns}")
        print(f"co-simulation               {passed / 16e6 / wall_s:.2f} s in a second")


def reactions(program: Path, built: Firmware, twin: TwinBench, tries: int = 20) -> None:
    print("\nfault | output off after, ms: least, most | allowed | told")
    for name, (fault, allowed_s) in FAULTS.items():
        times_s, told = [], Counter[str]()
        for k in range(tries):
            with CoSim(program, built.elf, twin) as chip:
                closed(chip, 0.15)
                chip.run(1e-3 * k / tries)
                at_s = chip.fault(fault)
                chip.run(0.06)
                times_s.append(off_after_s(chip, at_s))
                status = last_status(chip)
                told[Fault(status.fault).name.lower()] += 1
        worst = max(times_s)
        verdict = "" if worst <= allowed_s else "  TOO LATE"
        print(f"{name} | {1e3 * min(times_s):.2f}, {1e3 * worst:.2f} | {1e3 * allowed_s:g} | "
              f"{', '.join(told)}{verdict}")  # fmt: skip


def flip(program: Path, built: Firmware, twin: TwinBench, seed: int) -> tuple[str, str, bool]:
    """One bit at one instant: where, what became of it, and whether the clamp held."""
    rng = random.Random(seed)
    place = rng.choice(list(PLACES))
    with CoSim(program, built.elf, twin) as chip:
        closed(chip, 0.15)
        chip.run(rng.random() * 2e-3)
        chip.command(f"flip {rng.randrange(*PLACES[place])} {rng.randrange(8)}")
        known = len(chip.messages)
        for _ in range(3):
            chip.ask(KeepAlive(), 0.05)
        held = max(out.code for out in chip.outputs) <= CODE_HIGH
        told = [m for m in chip.messages[known:] if isinstance(m, Status)]
        if chip.counts["resets"] > 0 or chip.counts["crashes"] > 0:
            what = "reset by the watchdog"
        elif not told or chip.bad_frames > 1:
            what = "telemetry stopped or garbled"
        elif told[-1].state == State.TRIPPED:
            what = f"tripped: {Fault(told[-1].fault).name.lower()}"
        elif told[-1].state != State.RUNNING:
            what = "off or ramping down"
        elif any(m.reason for m in told):
            what = "updates without a strain, then on"
        else:
            what = "runs on"
        chip.run(0.75)
        if chip.outputs[-1].on:
            what += ", AND THE OUTPUT STAYS ON IN SILENCE"
    return place, what, held


def campaign(program: Path, built: Firmware, twin: TwinBench, flips: int) -> None:
    found = [flip(program, built, twin, seed) for seed in range(flips)]
    print(f"\n{flips} flipped bits; output above its clamp: {sum(not held for *_, held in found)}")
    for (place, what), count in sorted(Counter((p, w) for p, w, _ in found).items()):
        print(f"{place:18s} {what:45s} {count}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--flips", type=int, default=40)
    arguments = parser.parse_args()
    model = json.loads((DATA / "model.json").read_text(encoding="utf-8"))
    controller = tomllib.loads((DATA / "controller.toml").read_text(encoding="utf-8"))
    twin = TwinBench(twin_of_reading("hz"), 1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = settings_of_run(model, controller, "pid", FrontEnd())
        built = build_firmware(settings, folder)
        program = build_cosim(folder)
        budget(program, built, twin)
        reactions(program, built, twin)
        campaign(program, built, twin, arguments.flips)


if __name__ == "__main__":
    main()
