"""The step experiment on one twin with three loops: two on the desktop, one on the chip."""

from __future__ import annotations

import math
import tempfile
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import InputError, JsonObject
from haselab.control import PidGains, margins, step_metrics
from haselab.controllers import (
    CONTROLLERS,
    ChosenController,
    ControllerSetting,
    KnownActuator,
    Measurement,
    pid_controller,
)
from haselab.controllers.chip.loop import chip_setting
from haselab.firmware import UPDATE_DELAY_S as CHIP_DELAY_S
from haselab.firmware import ChipSettings
from haselab.firmware.messages import Run, SetReference, Status
from haselab.models.plant import Plant
from haselab.rig.chip import REFERENCE, Calibrated, CoSim, Firmware, calibrated_firmware
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.runtime.lockin import BLANKING_S
from haselab.sensing import Lockin, LockinConfig

__all__ = [
    "CHIP_DELAY_S",
    "FAST",
    "SLOW",
    "UPDATE_CYCLES",
    "ChipRun",
    "LoopRun",
    "StepExperiment",
    "StepPlan",
    "chip_experiment",
    "chip_loop",
    "controller_of",
    "desktop_loop",
    "loop_row",
    "section_of",
    "step_experiment",
]

UPDATE_CYCLES = 16_000  # of the processor, from one update to the next
_CARRIER_V = 0.05
_REFERENCE_BLOCKS = 50
_SETTLED = 10  # of them, before the carrier has settled
_TICK_S = 1e-3
_SLOTS = 8  # of a tick
_ALIVE_S = 0.1
_SHOWN_FROM_S, _SHOWN = -1.0, 5000


@dataclass(frozen=True)
class StepPlan:
    """A step of the reference while the loop is closed.

    Args:
        before: desired strain until the step.
        after: desired strain from it on.
        hold_s: time before the step, in s.
        last_s: time after it, in s.
        zero_length_m: length of the sheet at zero strain, in m.
        precondition_v: highest drive before the step, see `precondition`.
        actuator: for controllers whose output is the voltage.
    """

    before: float
    after: float
    hold_s: float
    last_s: float
    zero_length_m: float
    precondition_v: float = 0.0
    actuator: KnownActuator | None = None


@dataclass(frozen=True)
class LoopRun:
    """The response of a loop.

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
    """The response of the chip's loop, and its use of the processor.

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


@dataclass(frozen=True)
class _Desk:
    """Rate and timing of a loop on the desktop.

    Args:
        rate_hz: updates a second.
        carrier_hz: of the sensing signal.
        blank_s: from a new output until samples are used.
        output_delay_s: from a block's end to the new output.
        wait: blocks for which an output waits after the first one.
        averaged: updates whose strain is averaged.
        limited: whether the chip's limit for changes of the drive applies.
    """

    rate_hz: float
    carrier_hz: float
    blank_s: float
    output_delay_s: float
    wait: int = 0
    averaged: int = 1
    limited: bool = False

    def twin(self, config: TwinConfig) -> TwinConfig:
        """The bench with blocks of this rate."""
        samples = round(config.acquisition.rate_hz / self.rate_hz)
        changed = {"block_samples": samples, "output_delay_s": self.output_delay_s}
        daq = config.acquisition.model_copy(update=changed)
        return config.model_copy(update={"acquisition": daq})

    def delay_s(self, middle_s: float) -> float:
        """Age of the mean strain when its output takes effect, in s.

        Args:
            middle_s: middle of the samples that are used, from the start of their block.
        """
        period_s = 1.0 / self.rate_hz
        older_s = 0.5 * (self.averaged - 1) * period_s
        return period_s - middle_s + older_s + self.wait * period_s + self.output_delay_s


# The bench of the study, and the chip's timing on the desktop's instruments: an update uses 2 ms of
# samples, and its output follows 1.8 ms after their middle.
SLOW = _Desk(100.0, 2e3, BLANKING_S, 2e-3)
FAST = _Desk(1000.0, 10e3, 5e-4, 1e-4, wait=1, averaged=2, limited=True)


def controller_of(settings: ChipSettings) -> ChosenController:
    """Return the chip's controller for the desktop.

    Args:
        settings: of the chip.
    Raises:
        InputError: the kind of the controller is not registered on this computer.
    """
    s, own = settings, settings.own
    if own is not None:
        return CONTROLLERS.find(own.kind).choose(dict(own.parameters))
    return pid_controller(s.kp, s.ki, s.kd, s.derivative_filter_s)


def desktop_loop(
    config: TwinConfig, seed: int, settings: ChipSettings, desk: _Desk, plan: StepPlan
) -> LoopRun:
    """Run the desktop's loop in simulated time, with the functions of the core.

    Args:
        config: of the twin.
        seed: of its noise.
        settings: gains and maps.
        desk: rate and timing: `SLOW` or `FAST`.
        plan: of the step.
    Returns:
        The response.
    """
    config = desk.twin(config)
    bench, rig, s = _sheet(config, seed, plan), describe(config), settings
    blank = rig.switch_sample + round(desk.blank_s * rig.rate_hz)
    sensing = LockinConfig(
        rig.rate_hz, rig.block_samples, desk.carrier_hz, rig.skew_s,
        rig.i_monitor_v_per_a / rig.v_monitor_v_per_v, blank=(0, blank),
        full_scale=rig.top_code,
    )  # fmt: skip
    share = _reference_share(bench, Lockin(sensing), desk.carrier_hz)
    lockin = Lockin(replace(sensing, scale_s=sensing.admittance_scale_s * share))
    chosen, in_volts = controller_of(s), s.own is not None and s.own.in_volts
    setting = ControllerSetting(1.0 / desk.rate_hz, s.strain_low, s.strain_high, s.strain_start)
    if in_volts:
        assert plan.actuator is not None, "the kind needs it"
        setting = chip_setting(plan.actuator, s.drive_high_v, s.rise_v_per_s)
    controller = chosen.make()
    controller.start(setting)
    bench.sine(desk.carrier_hz, _CARRIER_V)
    held, after = round(plan.hold_s * desk.rate_hz), round(plan.last_s * desk.rate_hz)
    reference = np.r_[np.full(held, plan.before), np.full(after, plan.after)]
    waiting: deque[float] = deque([0.0] * desk.wait)
    strains: deque[float] = deque(maxlen=desk.averaged)
    most_v = s.rise_v_per_s / desk.rate_hz if desk.limited else math.inf
    length_m, drive_v = np.empty(held + after), 0.0
    for k, wanted in enumerate(reference):
        farad, _, valid = lockin.step(bench.read())
        if valid:
            strains.append(_core.strain_from_capacitance(*s.strain_map, farad))
        if len(strains) == desk.averaged:
            strain = sum(strains) / desk.averaged
            sensed_f = math.nan if in_volts else farad  # on the chip, the strain is by the map
            seen = Measurement(strain, sensed_f, drive_v, (k + 1) / desk.rate_hz)
            drive = controller.step(float(wanted), seen)
            wanted_v = drive
            if not in_volts:
                corrected = min(max(drive, s.strain_low), s.strain_high)
                wanted_v = _core.voltage_from_strain(*s.voltage_map, corrected)
            change_v = min(max(wanted_v - drive_v, -most_v), most_v)
            drive_v = min(max(drive_v + change_v, 0.0), s.drive_high_v)
        waiting.append(drive_v)
        bench.write(waiting.popleft())
        length_m[k] = bench.length_m
    time_s = (np.arange(1, held + after + 1) - held) / desk.rate_hz
    true_strain = length_m / plan.zero_length_m - 1.0
    name = f"desktop, {desk.rate_hz:g} Hz"
    delay_s = desk.delay_s(lockin.middle_s)
    return LoopRun(name, delay_s, desk.rate_hz, time_s, true_strain, reference)


def _sheet(config: TwinConfig, seed: int, plan: StepPlan) -> TwinBench:
    """Make the twin, preconditioned as the plan says."""
    bench = TwinBench(config, seed)
    precondition(bench, plan.precondition_v)
    return bench


def _check_capacitance(settings: ChipSettings, bench: TwinBench) -> None:
    """Refuse a twin whose capacitance at 0 V the microcontroller would take for a lost signal."""
    found_f = bench.native.capacitance(bench.length_m)
    low_f, high_f = settings.capacitance_range_f
    if not low_f <= found_f <= high_f:
        raise InputError(
            f"The actuator of the twin has {1e12 * found_f:.4g} pF at 0 V, but the microcontroller "
            f"accepts {1e12 * low_f:.4g} to {1e12 * high_f:.4g} pF, from the strain map and the "
            "limits of the controller. A simulation needs a physical model of this actuator, which "
            "maps and [model] do not replace: run 'haselab identify actuator RECORDS --actuator "
            "A.toml' and add --twin A.toml, or state its parameters in --twin TWIN.toml (haselab "
            "twin new). Without one, 'haselab design A.toml' predicts the step from [model], and "
            "'haselab firmware build' works. Or check the unit and the scales of the capacitance."
        )


def _reference_share(bench: TwinBench, lockin: Lockin, carrier_hz: float) -> float:
    """Ratio of a reference capacitor to its measured capacitance."""
    bench.connect(*REFERENCE)
    bench.sine(carrier_hz, _CARRIER_V)
    found = [lockin.step(bench.read())[0] for _ in range(_REFERENCE_BLOCKS)]
    bench.off()
    bench.connect(None)
    return REFERENCE[0] / float(np.mean(found[_SETTLED:]))


def chip_loop(program: Path, elf: Path, config: TwinConfig, seed: int, plan: StepPlan) -> ChipRun:
    """Run the loop on the chip, in co-simulation.

    Args:
        program: of the co-simulation.
        elf: the firmware.
        config: of the twin.
        seed: of its noise.
        plan: of the step.
    Returns:
        The response, and the use of the processor.
    Raises:
        DeviceError: the chip refused a command.
    """
    with CoSim(program, elf, _sheet(config, seed, plan)) as chip:
        chip.run(0.02)
        chip.arm()
        chip.execute(Run(plan.before))
        chip.command(f"track {_SLOTS}")
        start, asleep = chip.counts["cycle"], chip.counts["asleep"]
        for wanted, duration_s in ((plan.before, plan.hold_s), (plan.after, plan.last_s)):
            for _ in range(round(duration_s / _ALIVE_S)):
                chip.execute(SetReference(wanted), _ALIVE_S)
        load = 1.0 - (chip.counts["asleep"] - asleep) / (chip.counts["cycle"] - start)
        length_m = np.array([track.length_m for track in chip.tracks])
        status = [m for m in chip.messages if isinstance(m, Status)]
        stack = int(chip.counts["stack"])
        highest = max(out.code for out in chip.outputs)
    held = round(plan.hold_s / _ALIVE_S) * round(_ALIVE_S / _TICK_S)
    time_s = np.asarray((np.arange(1, length_m.size + 1) - held) * _TICK_S, dtype=np.float64)
    reference = np.where(time_s <= 0.0, plan.before, plan.after)
    strain = np.asarray(length_m / plan.zero_length_m - 1.0, dtype=np.float64)
    loop = LoopRun("chip, 1000 Hz", CHIP_DELAY_S, 1.0 / _TICK_S, time_s, strain, reference)
    return ChipRun(
        loop, load, max(m.busy_cycles for m in status), stack, status[-1].overruns, highest
    )


def loop_row(
    loop: LoopRun, gains: PidGains | None, plant: Plant, feedthrough: float = 0.0
) -> JsonObject:
    """Metrics of a loop's step, and the margins of the fitted plant with its rate and delay.

    Args:
        loop: its response.
        gains: of its PID; None: it is not a PID, so no margins are computed.
        plant: as it was identified.
        feedthrough: of the measured strain, see `LoopSetting`.
    """
    found = step_metrics(loop.time_s, loop.strain, loop.reference).trials[0]
    robust = None
    if gains is not None:
        robust = margins(
            plant, gains, loop_delay_s=loop.delay_s, rate_hz=loop.rate_hz, feedthrough=feedthrough
        )
    return {
        "loop": loop.name,
        "delay_s": loop.delay_s,
        "rise_time_s": found.rise_time_s,
        "raw_rise_time_s": found.raw_rise_time_s,
        "overshoot": found.overshoot,
        "peak_excess": found.peak_excess,
        "settling_time_s": found.settling_time_s,
        "steady_state_error": found.steady_state_error,
        "phase_margin_deg": robust.phase_margin_deg if robust else None,
        "gain_margin_db": robust.gain_margin_db if robust else None,
    }


def section_of(runs: list[LoopRun], rows: list[JsonObject]) -> JsonObject:
    """Section of analysis.json about the loops, from 1 s before the step.

    Args:
        runs: the loops.
        rows: their metrics, in the same order.
    """

    def shown(run: LoopRun, values: NDArray[np.float64]) -> dict[str, Any]:
        some = np.flatnonzero(run.time_s > _SHOWN_FROM_S)
        some = some[:: max(1, some.size // _SHOWN)]
        return {"time_s": run.time_s[some], "strain": values[some]}

    return {
        "desired": shown(runs[-1], runs[-1].reference),
        "loops": {run.name: shown(run, run.strain) for run in runs},
        "metrics": {
            str(row["loop"]): {
                "rise_time_s": row["rise_time_s"],
                "settling_time_s": row["settling_time_s"],
                "overshoot": row["overshoot"],
                "peak_excess": row["peak_excess"],
                "error": row["steady_state_error"],
                "delay_s": row["delay_s"],
                "phase_margin_deg": row["phase_margin_deg"],
            }
            for row in rows
        },
    }


@dataclass(frozen=True)
class StepExperiment:
    """The step with all three loops.

    Args:
        runs: desktop at 100 Hz, desktop at the chip's rate, chip; only the chip if its controller
            is not registered on this computer.
        chip: its use of the processor.
        built: the firmware with its calibration.
        correction: of the calibration.
    """

    runs: list[LoopRun]
    chip: ChipRun
    built: Firmware
    correction: float


def chip_experiment(
    settings: ChipSettings, config: TwinConfig, seed: int, plan: StepPlan
) -> tuple[ChipRun, Calibrated]:
    """Build and calibrate the chip's program, and play one step with it.

    Args:
        settings: gains and maps.
        config: of the twin.
        seed: of its noise.
        plan: of the step.
    Returns:
        The response with the use of the processor; the firmware, whose files are deleted.
    Raises:
        InputError: a compiler or libsimavr is missing, or the twin is of another actuator.
        DeviceError: the chip refused a command.
    """
    _check_capacitance(settings, _sheet(config, seed, plan))
    with tempfile.TemporaryDirectory() as folder:
        made = calibrated_firmware(settings, config, seed, Path(folder))
        return chip_loop(made.program, made.firmware.elf, config, seed, plan), made


def step_experiment(
    settings: ChipSettings, config: TwinConfig, seed: int, plan: StepPlan
) -> StepExperiment:
    """Build and calibrate the chip's program, and play one step with it and the desktop's loops.

    Args:
        settings: gains and maps.
        config: of the twin.
        seed: of its noise.
        plan: of the step.
    Returns:
        The responses.
    Raises:
        InputError: a compiler or libsimavr is missing, or the twin is of another actuator.
        DeviceError: the chip refused a command.
    """
    chip, made = chip_experiment(settings, config, seed, plan)
    alone = settings.own is not None and settings.own.kind not in CONTROLLERS.packages()
    fast_only = settings.own is not None and settings.own.in_volts  # designed for the chip's rate
    desks = [
        desktop_loop(config, seed, settings, desk, plan)
        for desk in (() if alone else (FAST,) if fast_only else (SLOW, FAST))
    ]
    return StepExperiment([*desks, chip.loop], chip, made.firmware, made.correction)
