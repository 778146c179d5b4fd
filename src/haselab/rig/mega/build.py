"""Compiles the firmware and the co-simulation from the sources of a checkout."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from haselab.base import InputError, ResultError
from haselab.firmware import ChipSettings, settings_header

__all__ = ["Firmware", "build_cosim", "build_firmware", "checkout", "find_tool"]

_STRICT = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion",
           "-Wdouble-promotion", "-Werror"]  # fmt: skip
# Measured: -O3 takes a tenth of the cycles of an update off, relaxed jumps and floats kept whole
# another twentieth.
_CHIP = ["-mmcu=atmega2560", "-DF_CPU=16000000UL", "-O3", "-mrelax", "-mstrict-X",
         "-fno-split-wide-types", "-flto", "-fuse-linker-plugin", "-ffunction-sections",
         "-fdata-sections", "-Wl,--gc-sections"]  # fmt: skip
_PATIENCE_S = 300.0


@dataclass(frozen=True)
class Firmware:
    """A firmware that was built.

    Args:
        elf: program with its symbols.
        hex: the same for a programmer.
        flash_bytes: of the program memory.
        static_bytes: of the RAM, without the stack.
    """

    elf: Path
    hex: Path
    flash_bytes: int
    static_bytes: int


def checkout() -> Path:
    """The folder of the sources.

    Returns:
        The root of the checkout that this package runs from.
    Raises:
        InputError: this package was installed without them.
    """
    root = Path(__file__).resolve().parents[4]
    if not (root / "firmware" / "app" / "main.c").is_file():
        raise InputError(
            "The firmware's sources are not part of an installed package; needed is a checkout. "
            f"Clone the project and run it from there. {root}"
        )
    return root


def find_tool(name: str, package: str) -> str:
    """Path of a program.

    Args:
        name: of the program.
        package: that brings it.
    Returns:
        Its path.
    Raises:
        InputError: it is not installed.
    """
    path = shutil.which(name)
    if path is None:
        raise InputError(f"{name} is not installed. Type:  sudo apt-get install -y {package}")
    return path


def _run(command: list[str], what: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_PATIENCE_S)
    if done.returncode != 0:
        first = (done.stderr or done.stdout).strip().splitlines()
        raise ResultError(
            f"{what} failed: {first[0] if first else done.returncode}. Correct the source, or "
            "install the compiler's missing part."
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
        folder: where settings.h, firmware.elf and firmware.hex go.
        board: a folder of firmware/board.
        extra: more options for the compiler.
    Returns:
        Files and sizes.
    Raises:
        InputError: no sources, no compiler.
        ResultError: it does not compile.
    """
    root = checkout()
    compiler = find_tool("avr-gcc", "gcc-avr avr-libc")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.h").write_text(settings_header(settings), encoding="ascii")
    elf, hex_file = folder / "firmware.elf", folder / "firmware.hex"
    include = [f"-I{path}" for path in (root / "core" / "include", root / "firmware" / "app",
                                        root / "firmware" / "protocol", folder)]  # fmt: skip
    sources = _sources(root, "core", "firmware/app", f"firmware/board/{board}")
    _run([compiler, *_STRICT, *_CHIP, *extra, *include, *sources, "-o", str(elf)], "avr-gcc")
    copy = find_tool("avr-objcopy", "binutils-avr")
    _run([copy, "-O", "ihex", "-R", ".eeprom", str(elf), str(hex_file)], "avr-objcopy")
    told = _run([find_tool("avr-size", "binutils-avr"), "-A", str(elf)], "avr-size")
    size = {name: int(count) for name, count in re.findall(r"^(\.\w+)\s+(\d+)", told, re.MULTILINE)}
    flash = size.get(".text", 0) + size.get(".data", 0)
    static = sum(size.get(name, 0) for name in (".data", ".bss", ".noinit"))
    return Firmware(elf, hex_file, flash, static)


def build_cosim(folder: Path) -> Path:
    """Compile the co-simulation: a program of its own, under the licence of libsimavr.

    Args:
        folder: where it goes.
    Returns:
        The program.
    Raises:
        InputError: no sources, no compiler, no libsimavr.
        ResultError: it does not compile.
    """
    root = checkout()
    compiler = find_tool("cc", "gcc libc6-dev")
    if not any(Path(base, "simavr", "sim_avr.h").is_file()
               for base in ("/usr/include", "/usr/local/include")):  # fmt: skip
        raise InputError(
            "libsimavr is not installed. Type:  sudo apt-get install -y libsimavr-dev libelf-dev"
        )
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "cosim"
    sources = [str(root / "firmware" / "sim" / "cosim.c"), str(root / "native" / "twin.c")]
    _run([compiler, "-std=gnu99", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{root / 'native'}",
          *sources, "-lsimavr", "-lelf", "-lm", "-o", str(program)], "cc")  # fmt: skip
    return program
