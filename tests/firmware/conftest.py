"""Firmware and co-simulation, built once a session; tests without the tools say which they lack."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.firmware import ChipSettings, FrontEnd, settings_header
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

DATA = Path(__file__).resolve().parent / "data"
ROOT = source_folder()
CC = os.environ.get("CC", "cc")
STRICT = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion",
          "-Wdouble-promotion", "-Werror"]  # fmt: skip


@pytest.fixture(scope="session")
def settings() -> ChipSettings:
    """Of a study of the twin: its maps, and the PID that it designed."""
    return read_design(DATA, "pid", FrontEnd()).settings


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("firmware")


@pytest.fixture(scope="session")
def firmware(settings: ChipSettings, folder: Path) -> Firmware:
    try:
        return build_firmware(settings, folder)
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def twin() -> TwinBench:
    return TwinBench(twin_of_reading("hz"), 1)


@pytest.fixture(scope="session")
def cosim_program(folder: Path) -> Path:
    try:
        return build_cosim(folder)
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture
def chip(firmware: Firmware, cosim_program: Path, twin: TwinBench) -> Iterator[CoSim]:
    """A chip that was just switched on, with the weight on the twin."""
    with CoSim(cosim_program, firmware.elf, twin) as chip:
        chip.run(0.02)
        yield chip


@pytest.fixture(scope="session")
def host(settings: ChipSettings, folder: Path) -> Callable[..., Path]:
    """Builds a program of firmware sources for this machine."""
    (folder / "host").mkdir(exist_ok=True)
    (folder / "host" / "settings.h").write_text(settings_header(settings), encoding="ascii")

    def build(name: str, sources: list[Path], *flags: str) -> Path:
        out = folder / "host" / name
        places = ["core/include", "firmware/app", "firmware/protocol"]
        include = [f"-I{ROOT / place}" for place in places] + [f"-I{folder / 'host'}"]
        command = [CC, *STRICT, *flags, *include, *map(str, sources), "-o", str(out), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return out

    return build
