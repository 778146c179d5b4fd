"""Compile the firmware and the co-simulation from the sources."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from haselab.base import InputError, ResultError
from haselab.firmware import ChipSettings, settings_header
from haselab.rig.chip.boards import Board, load_board, source_folder

__all__ = ["Firmware", "build_cosim", "build_firmware", "find_tool", "simavr_header"]

_STRICT = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion",
           "-Wdouble-promotion", "-Werror"]  # fmt: skip
_PATIENCE_S = 300.0
_BUILT_IN = "controller_pid.c"  # of firmware/app


@dataclass(frozen=True)
class Firmware:
    """A compiled firmware.

    Args:
        elf: program with symbols.
        hex: the same program for flashing.
        flash_bytes: used program memory.
        static_bytes: used RAM, without the stack.
    """

    elf: Path
    hex: Path
    flash_bytes: int
    static_bytes: int


def find_tool(name: str, package: str) -> str:
    """Find a program.

    Args:
        name: of the program.
        package: package that contains it.
    Returns:
        Its path.
    Raises:
        InputError: The program is not installed.
    """
    path = shutil.which(name)
    if path is None:
        raise InputError(f"{name} is not installed. Run:  sudo apt-get install -y {package}")
    return path


def _run(command: list[str], what: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_PATIENCE_S)
    if done.returncode != 0:
        said = (done.stderr or done.stdout).strip().splitlines()
        first = [line for line in said if "error" in line] or said
        raise ResultError(
            f"{what} failed: {first[0] if first else done.returncode}. Fix the source, or install "
            "the missing part of the compiler."
        )
    return done.stdout


def _sources(root: Path, *folders: str) -> list[str]:
    return [str(path) for folder in folders for path in sorted((root / folder).glob("*.c"))]


def build_firmware(
    settings: ChipSettings, folder: Path, board: str = "atmega2560", extra: tuple[str, ...] = ()
) -> Firmware:
    """Compile the firmware with its settings.

    Args:
        settings: gains, maps and limits.
        folder: for settings.h, firmware.elf and firmware.hex.
        board: a folder of firmware/board.
        extra: further compiler options.
    Returns:
        Files and sizes.
    Raises:
        InputError: Sources, board or compiler are missing, or the settings are for another
            converter.
        ResultError: The firmware does not compile.
    """
    root, chosen = source_folder(), load_board(board)
    _check_converter(settings, chosen)
    gcc, copy, sizes = (chosen.prefix + name for name in ("gcc", "objcopy", "size"))
    compiler = find_tool(gcc, chosen.package)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.h").write_text(settings_header(settings), encoding="ascii")
    elf, hex_file = folder / "firmware.elf", folder / "firmware.hex"
    include = [f"-I{path}" for path in (root / "core" / "include", root / "firmware" / "app",
                                        root / "firmware" / "protocol", folder)]  # fmt: skip
    sources = _sources(root, "core", "firmware/app", f"firmware/board/{board}")
    if settings.own is not None:
        own = folder / "controller.c"
        own.write_text(settings.own.source, encoding="utf-8")
        sources = [*(path for path in sources if Path(path).name != _BUILT_IN), str(own)]
    _run([compiler, *_STRICT, *chosen.flags, *extra, *include, *sources, *chosen.link,
          "-o", str(elf)], gcc)  # fmt: skip
    _run([find_tool(copy, chosen.package), "-O", "ihex", "-R", ".eeprom", str(elf),
          str(hex_file)], copy)  # fmt: skip
    reported = _run([find_tool(sizes, chosen.package), "-A", str(elf)], sizes)
    size = {
        name: int(count) for name, count in re.findall(r"^(\.\w+)\s+(\d+)", reported, re.MULTILINE)
    }
    flash = size.get(".text", 0) + size.get(".data", 0)
    static = sum(size.get(name, 0) for name in (".data", ".bss", ".noinit"))
    return Firmware(elf, hex_file, flash, static)


def _check_converter(settings: ChipSettings, board: Board) -> None:
    """Refuse settings for another converter, whose calibration and limits would be wrong."""
    have, needed = (
        (front.converter_v, front.converter_codes)
        for front in (settings.front_end, board.front_end)
    )
    if have != needed:
        raise InputError(
            f"The settings are for a converter of {have[1]} codes over {have[0]:g} V, but "
            f"{board.name} has {needed[1]} codes over {needed[0]:g} V. Use the board's front end."
        )


def simavr_header() -> str | None:
    """Find the header of libsimavr, for co-simulations; None if it is not installed.

    The program `simavr` of the same project is not needed.
    """
    bases = ("/usr/include", "/usr/local/include")
    paths = (Path(base, "simavr", "sim_avr.h") for base in bases)
    return next((str(path) for path in paths if path.is_file()), None)


def build_cosim(folder: Path) -> Path:
    """Compile the co-simulation, a separate program under the licence of libsimavr.

    Args:
        folder: for the program.
    Returns:
        The program.
    Raises:
        InputError: Sources, compiler or libsimavr are missing.
        ResultError: The program does not compile.
    """
    root = source_folder()
    compiler = find_tool("cc", "gcc libc6-dev")
    if simavr_header() is None:
        raise InputError(
            "libsimavr is not installed. Run:  sudo apt-get install -y libsimavr-dev libelf-dev"
        )
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "cosim"
    parts = ("firmware/sim/cosim.c", "native/twin/twin.c", "native/motion/motion.c")
    sources = [str(root / part) for part in parts]
    _run([compiler, "-std=gnu99", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{root / 'native'}",
          *sources, "-lsimavr", "-lelf", "-lm", "-o", str(program)], "cc")  # fmt: skip
    return program
