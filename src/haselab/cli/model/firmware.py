"""`haselab firmware`: build, simulate and flash the microcontroller's program."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import click

from haselab.base import DeviceError, InputError, JsonObject, ResultError, table_at, to_plain
from haselab.cli.actuator_file import warn_misspelled_in
from haselab.cli.common import REAL, SEED, Real, answer_options, emit
from haselab.cli.model.doubts import warn_doubts
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.run_path import ACTUATOR_FILE
from haselab.cli.study.twin_option import draw_option, name_origin, twin_of_options
from haselab.control import PidGains, Saturation
from haselab.control.reach import default_step
from haselab.controllers import known_actuator
from haselab.firmware import CURRENT_SHARE, ChipSettings, FrontEnd
from haselab.models.plant import Plant
from haselab.pipelines.actuator_bench import refuse_other_kind
from haselab.pipelines.design.stated_margins import controller_doubt, drive_doubt, model_doubt
from haselab.rig.chip import (
    ChipDesign,
    ChipFile,
    Firmware,
    ModuleLimits,
    build_firmware,
    find_tool,
    load_board,
    read_design,
)
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import read_json, write_json
from haselab.study.chip.loops import (
    UPDATE_CYCLES,
    LoopRun,
    StepPlan,
    loop_row,
    section_of,
    step_experiment,
)
from haselab.study.simulated.agreement import (
    Agreement,
    StepCase,
    agreement_of,
    check_stable,
    predicted_loop,
)
from haselab.study.simulated.scatter import scatter_of
from haselab.study.simulated.truth import twin_of

__all__ = ["build", "command", "flash", "simulate"]

_BAUD = 115_200  # baud rate of the boot loader
_BOARD = "atmega2560"
_GAIN_TOLERANCE = 0.02  # of two statements of the same gain
_FILLED = 0.8  # of the converter's range, by the current of the largest capacitance
_PREDICTED = (
    "rise_time_s", "raw_rise_time_s", "overshoot", "settling_time_s", "steady_state_error",
)  # fmt: skip
_HIGHEST_PAGE = "0003"  # of 64 kB, as Intel HEX writes it
_DURATION = Real(0.1, 600.0)  # s; the microcontroller gets the desired strain every 0.1 s
_structure = shared_option(
    "--controller", "--structure", "structure",
    detail="It is the kind or the name of a controller in the actuator file. Default: that of "
    "[controller], or the file name of --controller-source.",
)  # fmt: skip
_source = shared_option(
    "--controller-source", "source", type=click.Path(path_type=Path),
    detail="Default: the C file of the controller's kind, if it has one.",
)  # fmt: skip


@click.group("firmware")
def command() -> None:
    """Build, simulate or flash the microcontroller's program."""


def _chip_file(rig: Path, board: str) -> ChipFile:
    file = load_rig(rig)
    if not isinstance(file, ChipFile) or board != _BOARD:
        raise InputError(
            f"--rig has kind {file.kind!r} and --board is {board}, but only kind 'chip' with board "
            f"{_BOARD} is supported. Leave one of the options out. {rig}"
        )
    return file


def _sizes(built: Firmware) -> dict[str, Any]:
    return {"flash_bytes": built.flash_bytes, "static_ram_bytes": built.static_bytes}


@command.command("build")
@click.argument("run", type=click.Path(path_type=Path))
@_structure
@_source
@click.option(
    "--build-dir", "folder", type=click.Path(path_type=Path), default=Path("out/firmware"),
    show_default=True, help="Write settings.h, firmware.elf and firmware.hex to this folder.",
)  # fmt: skip
@shared_option(
    "--board", default=_BOARD, show_default=True, metavar="BOARD",
    detail="It is the name of a folder in firmware/board.",
)  # fmt: skip
@shared_option(
    "--rig", type=click.Path(path_type=Path),
    detail="It must have kind 'chip'; its [front_end] and limits are compiled in. Default: none.",
)  # fmt: skip
@answer_options(OutputRule(built=("folder",)))
def build(
    run: Path,
    structure: str | None,
    source: Path | None,
    folder: Path,
    board: str,
    rig: Path | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Compile the firmware with the gains in RUN.

    RUN is an actuator file or the folder of a run, with the maps, limits and gains to compile in.
    `haselab firmware simulate` measures how much stack and processor time the firmware uses.
    """
    warn_misspelled_in(run)
    for doubt in (model_doubt(run), controller_doubt(run, structure)):
        if doubt:
            raise InputError(doubt)
    if doubt := drive_doubt(run):
        click.echo(f"haselab: warning: {doubt}", err=True)
    file = None if rig is None else _chip_file(rig, board)
    front_end = load_board(board).front_end if file is None else file.front_end.front_end()
    module = ModuleLimits() if file is None else file.module
    design = read_design(run, structure, front_end, source, module)
    _check_gain(
        design.tables.drive.gain_v_per_v, front_end.gain, run,
        "state its gain as gain in [front_end] of a rig file with kind 'chip', and build with "
        "--rig (docs/control/firmware.md, 'The rig file of a microcontroller')",
    )  # fmt: skip
    _check_current(design, front_end, run, "Lower its gain:")
    settings = design.settings if file is None else file.limited(design.settings)
    _say_narrowed(settings, design.limits, run)
    built = build_firmware(settings, folder, board)
    limits = {"strain_low": settings.strain_low, "strain_high": settings.strain_high}
    emit({**_sizes(built), **limits, "hex": str(built.hex)}, as_json=as_json, out=out)


def _check_gain(recorded: float | None, module: float, run: Path, advice: str) -> None:
    """Refuse a module that turns the voltages of the map into another high voltage."""
    if recorded is not None and abs(module / recorded - 1.0) > _GAIN_TOLERANCE:
        raise InputError(
            f"[drive] gain_v_per_v is {recorded:g}, but the high-voltage module of the front end "
            f"has a gain of {module:g}: it would put out {module / recorded:.3g} times the high "
            f"voltage of the records. If your module has another gain, {advice}. Else identify the "
            f"voltage map from the drive that this module needs: {run}"
        )


def _check_current(design: ChipDesign, front_end: FrontEnd, run: Path, advice: str) -> None:
    """Refuse capacitances whose current saturates the converter or is lost: the chip would trip."""
    _check_least_current(design.settings.capacitance_range_f[1], front_end, run)
    recorded_f = design.tables.strain_map().range_f
    if recorded_f is None:
        return
    highest_f = recorded_f[1]
    most, codes = 0.5 * front_end.converter_codes, front_end.current_codes(highest_f)
    if codes > most:
        raise InputError(
            f"The strain map reaches {1e9 * highest_f:.3g} nF, but the current channel of the "
            f"front end saturates at {1e9 * highest_f * most / codes:.3g} nF. {advice} "
            f"i_stage = {front_end.i_stage * _FILLED * most / codes:.2g} in [front_end] of a rig "
            f"file with kind 'chip' (haselab firmware build --rig). {run}"
        )


def _check_least_current(highest_f: float, front_end: FrontEnd, run: Path) -> None:
    """Refuse a current channel whose carrier is below the limit of the chip at each capacitance."""
    least, codes = CURRENT_SHARE * front_end.carrier_codes, front_end.current_codes(highest_f)
    if codes < least:
        raise InputError(
            f"At {1e9 * highest_f:.3g} nF, the highest capacitance of the strain map, the carrier "
            f"has {codes:.2g} codes in the current channel of the front end, but the chip needs "
            f"{least:.0f}. Check i_stage and ampere_per_monitor_volt in [front_end] of the rig "
            f"file (haselab firmware build --rig). {run}"
        )


def _say_narrowed(settings: ChipSettings, designed: tuple[float, float], run: Path) -> None:
    """Warn of a chip whose output does not reach the limits of the design."""
    low, high = settings.strain_low, settings.strain_high
    if (low, high) != designed:
        click.echo(
            "haselab: warning: [drive] and the chip's output, which reaches "
            f"{settings.drive_high_v:g} V, limit the drive, so the controller's output is limited "
            f"to strains of {low:.4g} to {high:.4g} instead of {designed[0]:.4g} to "
            f"{designed[1]:.4g}: {run}",
            err=True,
        )


@command.command("simulate")
@click.argument("run", type=click.Path(path_type=Path))
@_structure
@_source
@shared_option("--twin", type=ACTUATOR_FILE, detail="Default: see --reading.")
@draw_option
@shared_option(
    "--reading", type=click.Choice(["rad", "hz"]),
    detail="Default: the twin of the run in RUN, else hz.",
)  # fmt: skip
@click.option(
    "--step",
    "step",
    type=(REAL, REAL),
    metavar="BEFORE AFTER",
    help="Set the desired strain before and after the step. Default: 0, and the step of the "
    "design; without such a step 0.04, or half of what the limits allow.",
)
@click.option(
    "--before-s",
    type=_DURATION,
    default=10.0,
    show_default=True,
    help="Set the time before the step in s.",
)
@click.option(
    "--after-s",
    type=_DURATION,
    default=10.0,
    show_default=True,
    help="Set the time after the step in s.",
)
@click.option(
    "--precondition",
    type=REAL,
    default=2.0,
    show_default=True,
    help="Set the highest drive that the actuator has had before, in V; 0: a new actuator.",
)
@shared_option("--seed", type=SEED, default=1, show_default=True)
@answer_options(plot=True)
def simulate(
    run: Path,
    structure: str | None,
    source: Path | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Simulate the firmware in a step experiment.

    RUN is an actuator file or the folder of a run. Three loops control the same twin: the
    microcontroller in co-simulation, and two loops on the desktop at 100 Hz and 1 kHz. The one at
    1 kHz has the delay and the limits of the microcontroller. All three are first calibrated with a
    reference capacitor. If RUN is a folder, its report then shows the three loops. For a PI or PID,
    the simulated step of the microcontroller is compared with the step that [model] predicts. The
    tolerated difference comes from `frequency_spread`, the band of the strain map, the error of the
    microcontroller's sensing and the noise. If the difference is larger at any time, the command
    names the cause and exits with code 3. It also exits with code 3 if no comparison is possible:
    the loop is unstable for a natural frequency within `frequency_spread`, or the tolerated
    difference is as large as the step.
    """
    config = _twin(run, options["reading"], options["twin"], options["draw"])
    refuse_linked_folders(run, "firmware", "figures")
    warn_doubts(run, structure)
    front_end = FrontEnd()
    design = read_design(run, structure, front_end, source)
    refuse_other_kind(design.tables, run, config)
    _check_gain(
        design.tables.drive.gain_v_per_v, front_end.gain, run,
        "'firmware simulate' cannot simulate it; build the firmware with --rig",
    )  # fmt: skip
    _check_current(
        design, front_end, run, "It cannot be simulated with another gain; build it with"
    )
    settings, zero_m = design.settings, design.zero_length_m
    _say_narrowed(settings, design.limits, run)
    before, after = options["step"] or (0.0, _step_of(design))
    _check_step(before, after, settings)
    precondition_v = options["precondition"]
    _check_precondition(precondition_v, config)
    in_volts = settings.own is not None and settings.own.in_volts
    known = known_actuator(design.tables, run) if in_volts else None
    plan = StepPlan(
        before, after, options["before_s"], options["after_s"], zero_m, precondition_v, known
    )
    case = None
    if settings.own is None:
        gains = PidGains(settings.kp, settings.ki, settings.kd, settings.derivative_filter_s)
        case = StepCase(design, gains, config, plan, options["seed"])
        check_stable(case)
    found = step_experiment(settings, config, options["seed"], plan)
    runs, chip = found.runs, found.chip
    rows = [_row(loop, case, design.plant, plan) for loop in runs]
    agreement = None if case is None else agreement_of(runs[-2], runs[-1], case)
    answer = {
        **_sizes(found.built),
        "stack_bytes": chip.stack_bytes,
        "load": chip.load,
        "longest_update_cycles": chip.busy_cycles,
        "cycles_of_an_update": UPDATE_CYCLES,
        "overruns": chip.overruns,
        "calibration": found.correction,
        "highest_code": chip.highest_code,
        "loops": rows,
        **_compared(agreement),
        **({} if case is None else _scattered(runs[-1], case)),
    }
    section = to_plain(section_of(runs, rows))
    if plot is not None:
        _draw(section, plot)
    if (run / "results.json").is_file():
        from haselab.report import write_report  # matplotlib takes half a second to import

        write_json(run / "firmware" / "simulation.json", section)
        write_report(run)
    emit(answer, as_json=as_json, out=out)
    if agreement is not None and not agreement.agrees:
        raise ResultError(f"{answer['comparison']} {run}")


def _step_of(design: ChipDesign) -> float:
    """The step for which the controller was designed, else one that its limits allow."""
    controller = design.tables.controller
    demanded = None if controller is None else controller.demands.get("step")
    if demanded is not None:
        return float(demanded)
    limits = Saturation(design.settings.strain_low, design.settings.strain_high)
    return default_step(design.plant, limits)


def _check_step(before: float, after: float, settings: ChipSettings) -> None:
    """Refuse a step that is none, or that the microcontroller does not accept."""
    if before == after:
        raise InputError(
            f"--step is {before:g} {after:g}, which does not change the desired strain. Give two "
            "different strains."
        )
    low, high = settings.reference_limits
    if not (low <= before <= high and low <= after <= high):
        raise InputError(
            f"--step is {before:g} {after:g}, but the microcontroller accepts only strains of "
            f"{low:.4g} to {high:.4g}, the limits of the controller and of [drive]. Give --step "
            "BEFORE AFTER within them, or widen the limits."
        )


def _check_precondition(precondition_v: float, config: TwinConfig) -> None:
    """Refuse a drive that the twin does not have."""
    most_v = config.acquisition.drive_high_v
    if not 0.0 <= precondition_v <= most_v:
        raise InputError(
            f"--precondition is {precondition_v:g} V, but it must be 0 to {most_v:g} V, the drive "
            "of the twin before its amplifier."
        )


def _twin(
    run: Path, reading: Literal["rad", "hz"] | None, twin: Path | None, draw: int | None
) -> TwinConfig:
    """The twin of the options, else that of the run in this folder, else the default one."""
    if twin is not None or draw is not None:
        config = twin_of_options(reading, twin, 1, draw).configuration(Path())
        name_origin(config)
        return config
    results = (run if run.is_dir() else run.parent) / "results.json"
    if reading is None and results.is_file():
        known = twin_of(table_at(read_json(results), "provenance", "rig_config"))
        if known is not None:
            return known
    return twin_of_reading(reading or "hz")


def _row(loop: LoopRun, case: StepCase | None, plant: Plant, plan: StepPlan) -> JsonObject:
    """Metrics of a loop's step, and those of its prediction."""
    row = _metrics(loop, loop.name, case, plant, plan)
    if case is not None:
        expected = _metrics(predicted_loop(loop, case), "prediction", None, plant, plan)
        row["predicted"] = {name: expected[name] for name in _PREDICTED}
    return row


def _metrics(
    loop: LoopRun, name: str, case: StepCase | None, plant: Plant, plan: StepPlan
) -> JsonObject:
    try:
        if case is None:
            return loop_row(loop, None, plant)
        return loop_row(loop, case.gains, plant, case.loop.feedthrough)
    except InputError:
        raise InputError(
            f"After the step from {plan.before:g} to {plan.after:g}, the strain ({name}) does not "
            f"move in the direction of the step within --after-s {plan.last_s:g}. Give a longer "
            "--after-s, or a larger --step."
        ) from None


def _compared(found: Agreement | None) -> dict[str, Any]:
    """Status and comparison for the answer."""
    if found is None:
        return {"status": "not compared: only the step of a PI or PID is predicted"}
    if found.says_nothing:
        return {
            "deviation": found.deviation,
            "deviation_tolerated": None,
            "deviation_at_s": found.at_s,
            "comparison": f"The chip's step was not compared with the predicted one: "
            f"{found.says_nothing}.",
            "status": f"not compared: {found.says_nothing}",
        }
    sentence = (
        f"{abs(found.at_s):.3g} s {'after' if found.at_s > 0.0 else 'before'} the step, the chip's "
        f"strain differs from the predicted one by {100.0 * found.deviation:.3g} % of the step; "
        "frequency_spread, the band of the strain map and the chip's sensing explain up to "
        f"{100.0 * found.covered:.3g} % there."
    )
    if not found.agrees:
        sentence += f" Cause: {'; '.join(found.causes) or 'none of those that are checked'}."
    return {
        "deviation": found.deviation,
        "deviation_tolerated": found.covered,
        "deviation_at_s": found.at_s,
        "comparison": sentence,
        "status": "ok" if found.agrees else "differs from the prediction",
    }


def _scattered(chip: LoopRun, case: StepCase) -> dict[str, Any]:
    """How much the strain of the chip scatters at rest, and why."""
    found = scatter_of(chip, case)
    answer = {
        "scatter": found.simulated,
        "scatter_predicted": found.predicted,
        "scatter_without_rate_limit": found.linear,
    }
    return {**answer, "scatter_cause": found.cause} if found.cause else answer


def _draw(section: Mapping[str, Any], path: Path) -> None:
    """Draw the responses of `section_of` in one figure."""
    from matplotlib.figure import Figure  # it takes half a second to import

    from haselab.report.analysis import Section
    from haselab.report.chart_file import write_figure
    from haselab.report.figures.chip import draw_loops
    from haselab.report.style import figure_style

    with figure_style():
        figure = Figure(figsize=(7.0, 3.6), layout="constrained")
        draw_loops(figure, Section("chip", section))
        write_figure(figure, "Step by the chip and by the computer", path)


def _check_image(path: Path) -> None:
    """Refuse an image for another chip, whose addresses are beyond the ATmega2560's flash."""
    lines = path.read_text(encoding="ascii", errors="replace").split()
    pages = [line[9:13] for line in lines if line[7:9] == "04"]
    good = bool(lines) and all(line[:1] == ":" for line in lines)
    if not good or any(page > _HIGHEST_PAGE for page in pages):
        raise InputError(
            "The file is not a program for the ATmega2560 (Intel HEX, below 256 kB), the only chip "
            "that this command supports. Build without --board, or use the tool of the other chip. "
            f"{path}"
        )


@command.command("flash")
@click.argument("firmware", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--port", required=True, metavar="PORT", help="Name the serial port of the board.")
@click.confirmation_option(
    "--yes", prompt="Is the high-voltage module off and unplugged?",
    help="Permit this step without a question. First switch off and unplug the high-voltage "
    "module: the command then does not ask whether you did.",
)  # fmt: skip
@answer_options()
def flash(firmware: Path, port: str, as_json: bool, out: Path | None) -> None:
    """Write FIRMWARE, a .hex file, to a board with avrdude.

    The board needs the boot loader of the Arduino Mega.
    """
    _check_image(firmware)
    tool = find_tool("avrdude", "avrdude")
    line = [tool, "-p", "m2560", "-c", "wiring", "-P", port, "-b", str(_BAUD), "-D",
            "-U", f"flash:w:{firmware}:i"]  # fmt: skip
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=120.0)
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip().splitlines() or ["nothing"]
        raise DeviceError(f"avrdude failed: {said[-1]}. Check port, cable and boot loader: {port}")
    emit({"written": str(firmware), "port": port}, as_json=as_json, out=out)
