"""The step experiment on one twin by three controllers: two of the desktop, and the chip."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from haselab.control import PidGains, Saturation
from haselab.firmware import ChipSettings
from haselab.firmware.messages import Run, SetReference, Status
from haselab.models.maps import VoltageMap
from haselab.report.style import GREEN, PALETTE, house_style, legend_below
from haselab.rig.mega import REFERENCE, CoSim
from haselab.rig.twin.bench import TwinBench, describe
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.fast_loop import make_control
from haselab.runtime.runner import BLANKING_S, LoopSettings, StrainMap
from haselab.sensing import LockinConfig

__all__ = [
    "CHIP_DELAY_S",
    "ChipRun",
    "LoopRun",
    "StepPlan",
    "chip_loop",
    "desktop_loop",
    "draw",
]

# From the middle of the readings that count to their frame's end 7.5 slots of 125 us, and on to the
# output 7 more.
CHIP_DELAY_S = 14.5 * 125e-6
_CARRIER_V = 0.05
_SETTLED = 10  # readings of it that come before the carrier has settled
_TICK_S = 1e-3
_SLOTS = 8  # of a tick
_ALIVE_S = 0.1


@dataclass(frozen=True)
class StepPlan:
    """A step of the reference while the loop is closed.

    Args:
        before: desired strain until the step.
        after: desired strain from it on.
        hold_s: time before the step, in s.
        last_s: time after it, in s.
        zero_length_m: length of the sheet at zero strain, in m.
    """

    before: float
    after: float
    hold_s: float
    last_s: float
    zero_length_m: float


@dataclass(frozen=True)
class LoopRun:
    """What a loop did.

    Args:
        name: of the controller.
        delay_s: age of the strain when its output takes effect, in s.
        rate_hz: updates a second.
        time_s: since the step, in s. Shape `(N,)`.
        strain: the true one. Shape `(N,)`.
        reference: desired. Shape `(N,)`.
    """

    name: str
    delay_s: float
    rate_hz: float
    time_s: NDArray[np.float64]
    strain: NDArray[np.float64]
    reference: NDArray[np.float64]


@dataclass(frozen=True)
class ChipRun:
    """What the chip did, and what it took.

    Args:
        loop: its response.
        load: share of the cycles.
        busy_cycles: of the longest update.
        stack_bytes: the deepest.
        overruns: updates that were not ready in time.
        highest_code: of the output.
    """

    loop: LoopRun
    load: float
    busy_cycles: int
    stack_bytes: int
    overruns: int
    highest_code: int


def _at_rate(config: TwinConfig, rate_hz: float) -> tuple[TwinConfig, float, float]:
    """The twin with blocks of that rate; carrier in Hz, and its time to settle, in s."""
    daq = config.acquisition
    samples = round(daq.rate_hz / rate_hz)
    if rate_hz < 500.0:
        return _with_blocks(config, samples, daq.output_delay_s), 2e3, BLANKING_S
    return _with_blocks(config, samples, 1e-4), 10e3, 3e-4


def _with_blocks(config: TwinConfig, samples: int, output_delay_s: float) -> TwinConfig:
    changed = {"block_samples": samples, "output_delay_s": output_delay_s}
    daq = config.acquisition.model_copy(update=changed)
    return config.model_copy(update={"acquisition": daq})


def desktop_loop(
    config: TwinConfig, seed: int, settings: ChipSettings, rate_hz: float, wait: int, plan: StepPlan
) -> LoopRun:
    """The desktop's loop, its body in C, in the twin's own time.

    Args:
        config: of the twin.
        seed: of its noise.
        settings: gains and maps.
        rate_hz: updates a second.
        wait: blocks that an output waits beyond the first.
        plan: of the step.
    Returns:
        The response.
    """
    config, carrier_hz, blank_s = _at_rate(config, rate_hz)
    bench, rig = TwinBench(config, seed), describe(config)
    blank = rig.switch_sample + round(blank_s * rig.rate_hz)
    sensing = LockinConfig(
        rig.rate_hz, rig.block_samples, carrier_hz, rig.skew_s,
        rig.i_monitor_v_per_a / rig.v_monitor_v_per_v, blank=(0, blank),
    )  # fmt: skip
    s = settings
    loop = LoopSettings(
        PidGains(s.kp, s.ki, s.kd, s.derivative_filter_s),
        Saturation(s.strain_low, s.strain_high),
        VoltageMap(*s.voltage_map),
        StrainMap(*s.strain_map),
    )
    limits = (0.0, s.drive_high_v)
    bench.connect(*REFERENCE)
    bench.sine(carrier_hz, _CARRIER_V)
    found = [make_control(sensing, loop, limits).step(bench.read(), np.nan)[2] for _ in range(50)]
    bench.off()
    bench.connect(None)
    share = REFERENCE[0] / float(np.mean(found[_SETTLED:]))
    sensing = replace(sensing, scale_s=sensing.admittance_scale_s * share)
    control = make_control(sensing, loop, limits)
    bench.sine(carrier_hz, _CARRIER_V)
    held, after = round(plan.hold_s * rate_hz), round(plan.last_s * rate_hz)
    reference = np.r_[np.full(held, plan.before), np.full(after, plan.after)]
    waiting: deque[float] = deque([0.0] * wait)
    length_m = np.empty(held + after)
    for k, wanted in enumerate(reference):
        waiting.append(control.step(bench.read(), float(wanted))[0])
        bench.write(waiting.popleft())
        length_m[k] = bench.length_m
    delay_s = 0.5 * (rig.block_samples - blank) / rig.rate_hz
    delay_s += wait / rate_hz + rig.switch_sample / rig.rate_hz
    time_s = (np.arange(1, held + after + 1) - held) / rate_hz
    strain = length_m / plan.zero_length_m - 1.0
    return LoopRun(f"desktop, {rate_hz:g} Hz", delay_s, rate_hz, time_s, strain, reference)


def chip_loop(program: Path, elf: Path, config: TwinConfig, seed: int, plan: StepPlan) -> ChipRun:
    """The same on the chip in co-simulation.

    Args:
        program: of the co-simulation.
        elf: the firmware.
        config: of the twin.
        seed: of its noise.
        plan: of the step.
    Returns:
        The response, and what it took.
    Raises:
        DeviceError: the chip refused a command.
    """
    with CoSim(program, elf, TwinBench(config, seed)) as chip:
        chip.run(0.02)
        chip.arm()
        chip.tell(Run(plan.before))
        chip.command(f"track {_SLOTS}")
        start, asleep = chip.counts["cycle"], chip.counts["asleep"]
        for wanted, duration_s in ((plan.before, plan.hold_s), (plan.after, plan.last_s)):
            for _ in range(round(duration_s / _ALIVE_S)):
                chip.tell(SetReference(wanted), _ALIVE_S)
        load = 1.0 - (chip.counts["asleep"] - asleep) / (chip.counts["cycle"] - start)
        length_m = np.array([track.length_m for track in chip.tracks])
        status = [m for m in chip.messages if isinstance(m, Status)]
        stack = int(chip.counts["stack"])
        highest = max(out.code for out in chip.outputs)
    held = round(plan.hold_s / _TICK_S)
    time_s = np.asarray((np.arange(1, length_m.size + 1) - held) * _TICK_S, dtype=np.float64)
    reference = np.where(time_s <= 0.0, plan.before, plan.after)
    strain = np.asarray(length_m / plan.zero_length_m - 1.0, dtype=np.float64)
    loop = LoopRun("chip, 1000 Hz", CHIP_DELAY_S, 1.0 / _TICK_S, time_s, strain, reference)
    return ChipRun(
        loop, load, max(m.busy_cycles for m in status), stack, status[-1].overruns, highest
    )


def draw(runs: list[LoopRun]) -> Figure:
    """The responses in one figure."""
    with house_style():
        figure = Figure(figsize=(7.0, 3.6), layout="constrained")
        axes = figure.subplots()
        first = runs[-1]
        shown = first.time_s > -1.0
        axes.plot(first.time_s[shown], 100.0 * first.reference[shown], color=GREEN, lw=1.8,
                  label="desired")  # fmt: skip
        for k, run in enumerate(runs):
            shown = run.time_s > -1.0
            axes.plot(run.time_s[shown], 100.0 * run.strain[shown], color=PALETTE[k],
                      lw=1.2, label=run.name)  # fmt: skip
        axes.set_xlabel("Time (s)")
        axes.set_ylabel("Strain (%)")
        legend_below(figure, axes, 4)
    return figure
