"""`haselab firmware`: builds the microcontroller's program, tries it on the twin, writes it."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from matplotlib.figure import Figure

from haselab.base import DeviceError, InputError, to_plain
from haselab.cli.actuator_file import load_run
from haselab.cli.common import REAL, SEED, answer_options, emit, refuse_two_twins
from haselab.cli.output import OutputRule
from haselab.control import PidGains
from haselab.firmware import FrontEnd
from haselab.report import write_report
from haselab.report.analysis import Section
from haselab.report.chart_file import write_figure
from haselab.report.figures.chip import draw_loops
from haselab.report.style import house_style
from haselab.rig.chip import (
    Firmware,
    MegaFile,
    build_firmware,
    find_tool,
    load_board,
    read_design,
)
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import load_twin, twin_of_reading
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import write_json
from haselab.study.chip.loops import StepPlan, loop_row, section_of, step_experiment

__all__ = ["build", "command", "flash", "simulate"]

_BAUD = 115_200  # of the boot loader
_UPDATE_CYCLES = 16_000
_HIGHEST_PAGE = "0003"  # of 64 kB, as Intel HEX writes it
_structure = click.option(
    "--controller",
    "--structure",
    "structure",
    metavar="KIND",
    help="Kind or name of the controller in the actuator file.  [default: that of [controller], or "
    "the name of the file of --controller-source]",
)
_source = click.option(
    "--controller-source", "source", type=click.Path(path_type=Path),
    help="Compile this C file in place of the PID.  [default: the C step that the kind brings]",
)  # fmt: skip


@click.group("firmware")
def command() -> None:
    """The controller on an ATmega2560."""


def _mega_file(rig: Path, board: str) -> MegaFile:
    file = load_rig(rig)
    if not isinstance(file, MegaFile) or board != "atmega2560":
        raise InputError(
            f"--rig with kind {file.kind!r} and --board {board}, allowed are 'mega' and "
            f"atmega2560: the one rig with a chip. Leave one of them out. {rig}"
        )
    return file


def _sizes(built: Firmware) -> dict[str, Any]:
    return {"flash_bytes": built.flash_bytes, "static_ram_bytes": built.static_bytes}


@command.command("build")
@click.argument("run", type=click.Path(path_type=Path))
@_structure
@_source
@click.option(
    "--to", "folder", type=click.Path(path_type=Path), default=Path("out/firmware"),
    show_default=True, help="Folder of settings.h, firmware.elf and firmware.hex.",
)  # fmt: skip
@click.option(
    "--board", default="atmega2560", show_default=True, help="A folder of firmware/board.",
)  # fmt: skip
@click.option(
    "--rig", type=click.Path(path_type=Path),
    help="A rig file of kind 'mega', whose [front_end] and limits the program gets.",
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
    """Compile the firmware with the maps, limits and gains in RUN.

    RUN is an actuator file or the folder of a study. `haselab firmware simulate` counts stack and
    cycles.
    """
    load_run(run)  # warns of misspelled keys
    file = None if rig is None else _mega_file(rig, board)
    front_end = load_board(board).front_end if file is None else file.front_end.front_end()
    settings = read_design(run, structure, front_end, source).settings
    if file is not None:
        settings = file.limited(settings)
    built = build_firmware(settings, folder, board)
    emit({**_sizes(built), "hex": str(built.hex)}, as_json=as_json, out=out)


@command.command("simulate")
@click.argument("run", type=click.Path(path_type=Path))
@_structure
@_source
@click.option("--twin", type=click.Path(path_type=Path), help="Use the twin of TWIN.toml.")
@click.option("--reading", type=click.Choice(["hz", "rad"]),
              help="Use the default twin of this interpretation of the paper's frequency axis.  "
              "[default: hz]")  # fmt: skip
@click.option("--step", "step", type=(REAL, REAL), default=(0.0, 0.04), show_default=True,
              help="Desired strain before and after.")  # fmt: skip
@click.option("--hold", type=REAL, default=10.0, show_default=True, help="Seconds before the step.")
@click.option("--last", type=REAL, default=10.0, show_default=True, help="Seconds after it.")
@click.option("--precondition", type=REAL, default=2.0, show_default=True,
              help="Drive that the sheet has seen before, in V; 0: a new sheet.")  # fmt: skip
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of the twin's noise.")
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
    """The step experiment: chip in co-simulation, and the desktop's loops, on one twin.

    RUN is an actuator file, or the folder of a study, whose report shows the three side by side
    afterwards. The desktop's
    loop at 1 kHz has the chip's delay and limits. All three are calibrated with one reference
    capacitor first.
    """
    refuse_two_twins(options["reading"], options["twin"])
    refuse_linked_folders(run, "firmware", "figures")
    design = read_design(run, structure, FrontEnd(), source)
    settings, zero_m, plant = design.settings, design.zero_length_m, design.plant
    twin, reading = options["twin"], options["reading"]
    config = twin_of_reading(reading or "hz") if twin is None else load_twin(twin)
    before, after = options["step"]
    precondition_v = options["precondition"]
    plan = StepPlan(before, after, options["hold"], options["last"], zero_m, precondition_v)
    found = step_experiment(settings, config, options["seed"], plan)
    runs, chip = found.runs, found.chip
    gains = None
    if settings.own is None:
        gains = PidGains(settings.kp, settings.ki, settings.kd, settings.derivative_filter_s)
    answer = {
        **_sizes(found.built),
        "stack_bytes": chip.stack_bytes,
        "load": chip.load,
        "longest_update_cycles": chip.busy_cycles,
        "cycles_of_an_update": _UPDATE_CYCLES,
        "overruns": chip.overruns,
        "calibration": found.correction,
        "highest_code": chip.highest_code,
        "loops": [loop_row(loop, gains, plant) for loop in runs],
    }
    section = to_plain(section_of(runs, answer["loops"]))
    if plot is not None:
        with house_style():
            write_figure(_draw(section), "Step by the chip and by the computer", plot)
    if (run / "results.json").is_file():
        write_json(run / "firmware" / "simulation.json", section)
        write_report(run)
    emit(answer, as_json=as_json, out=out)


def _draw(section: Mapping[str, Any]) -> Figure:
    """The responses of `section_of` in one figure."""
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    draw_loops(figure, Section("chip", section))
    return figure


def _check_image(path: Path) -> None:
    """Refuse an image for another chip: its addresses lie beyond the ATmega2560's flash."""
    lines = path.read_text(encoding="ascii", errors="replace").split()
    pages = [line[9:13] for line in lines if line[7:9] == "04"]
    good = bool(lines) and all(line[:1] == ":" for line in lines)
    if not good or any(page > _HIGHEST_PAGE for page in pages):
        raise InputError(
            "Not a program for the ATmega2560 (Intel HEX, below 256 kB), which is all that this "
            f"command writes. Build without --board, or use the other chip's own tool. {path}"
        )


@command.command("flash")
@click.argument("firmware", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--port", required=True, help="Serial port of the board.")
@click.confirmation_option("--yes", prompt="Is the high-voltage module off and unplugged?")
@answer_options()
def flash(firmware: Path, port: str, as_json: bool, out: Path | None) -> None:
    """Write FIRMWARE (.hex) to a board with the Arduino Mega's boot loader, by avrdude."""
    _check_image(firmware)
    tool = find_tool("avrdude", "avrdude")
    line = [tool, "-p", "m2560", "-c", "wiring", "-P", port, "-b", str(_BAUD), "-D",
            "-U", f"flash:w:{firmware}:i"]  # fmt: skip
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=120.0)
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip().splitlines() or ["nothing"]
        raise DeviceError(f"avrdude failed: {said[-1]}. Check port, cable and boot loader. {port}")
    emit({"written": str(firmware), "port": port}, as_json=as_json, out=out)
