"""`haselab doctor`: report what is installed, which instruments answer, how to fix the rest."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import json
import operator
import platform
import shutil
from collections.abc import Iterator
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import click

from haselab import __version__
from haselab.base import DeviceError, HaselabError
from haselab.cli.common import answer_options
from haselab.cli.doctor.extensions import extension_findings
from haselab.cli.doctor.machine import Finding, Machine
from haselab.cli.doctor.system import examine_system
from haselab.cli.options import shared_option
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile, opened_chip
from haselab.rig.chip.build import simavr_header
from haselab.rig.instruments.instrument import Instrument, SystemNeeds
from haselab.rig.instruments.registry import INSTRUMENTS, camera_of
from haselab.rig.real_bench import identify
from haselab.rig.rig_file import ReplayFile, RigFile, TwinFile, load_rig, opened_rig
from haselab.safety.gate import Gate
from haselab.store.folder import write_text

__all__ = ["command"]

_EXTENSIONS = (
    "_core",
    "_sense",
    "_twin",
    "_camera",
    "_track",
    "_identify",
    "_models",
    "_loops",
)
_PACKAGES = (
    "numpy",
    "scipy",
    "h5py",
    "pydantic",
    "click",
    "rich",
    "matplotlib",
    "jinja2",
    "av",
    "tifffile",
    "tomlkit",
    "pillow",
    "starlette",
    "uvicorn",
    "websockets",
    "pyserial",
)
# package: what it is for, and the extra that installs it
_OPTIONAL = {
    "nptdms": (".tdms files", "formats"),
    "pyMRAW": ("checking .mraw files", "formats"),
    "pynwb": ("NWB files", "formats"),
    "pyarrow": ("campaigns and Parquet files", "campaign"),
    "SALib": ("sensitivity indices of campaigns", "campaign"),
    "distributed": ("campaigns on a cluster", "dask"),
    "pandas": ("tables in Python", "frames"),
    "xarray": ("data sets in Python", "frames"),
    "control": ("models in python-control", "control"),
    "gymnasium": ("learning environments", "learning"),
    "cma": ("training a network", "learning"),
}
# program: what it is for, and the Debian package
_TOOLS = {
    "avr-gcc": ("building the firmware", "gcc-avr avr-libc"),
    "libsimavr": ("simulating the firmware and rows S26, S28", "libsimavr-dev libelf-dev"),
    "avrdude": ("writing the firmware to a board", "avrdude"),
}


def _package(name: str, kind: str, advice: str) -> Finding:
    try:
        return Finding(kind, name, True, metadata.version(name))
    except metadata.PackageNotFoundError:
        return Finding(kind, name, False, "not installed", advice)


def _opencv() -> Finding:
    """Check OpenCV, which comes in packages of several names."""
    if importlib.util.find_spec("cv2") is None:
        advice = "For checkerboards: pip install 'haselab[camera]'"
        return Finding("optional", "OpenCV", False, "not installed", advice)
    return Finding("optional", "OpenCV", True, "installed")


def _extension(name: str) -> Finding:
    try:
        importlib.import_module(f"haselab.{name}")
    except ImportError as error:
        return Finding("extension", name, False, str(error), "Build it: make setup")
    return Finding("extension", name, True, "loads")


def _tool(name: str) -> Finding:
    purpose, debian = _TOOLS[name]
    path = simavr_header() if name == "libsimavr" else shutil.which(name)
    if path is None:
        advice = f"For {purpose}: apt-get install {debian}"
        return Finding("program", name, False, "not found", advice)
    return Finding("program", name, True, path)


def _driver(kind: str, package: str) -> Iterator[Finding]:
    """Check what one kind of instrument needs on this computer."""
    try:
        instrument = INSTRUMENTS.find(kind)()
    except DeviceError as error:
        what, _, advice = str(error).rpartition(". ")
        yield Finding("driver", kind, False, what, advice)
        return
    needs = f"For {instrument.purpose or kind}"
    source = "pip install 'haselab[instruments]'" if package == "haselab" else f"see {package}"
    if package != "haselab":
        detail = f"section {instrument.section}, package {package}"
        yield Finding("driver", kind, True, detail)
    yield from (_package(name, "optional", f"{needs}: {source}") for name in instrument.packages)
    if instrument.library:
        yield _library(instrument, needs)


def _library(instrument: Instrument[Any], needs: str) -> Finding:
    """Check a library that is not a Python package."""
    try:
        instrument.check_driver()
    except DeviceError as error:
        what, _, advice = str(error).partition(". Run: ")
        return Finding("optional", instrument.library, False, what, f"{needs}: {advice}")
    return Finding("optional", instrument.library, True, "loads")


def _twin() -> Finding:
    """Read one block from the default rig."""
    try:
        bench = importlib.import_module("haselab.rig.twin.twin_bench")
        config = importlib.import_module("haselab.rig.twin.config")
        block = bench.TwinBench(config.TwinConfig(), 0).read()
    except ImportError as error:
        return Finding("rig", "twin", False, str(error), "Build the extensions: make setup")
    return Finding("rig", "twin", True, f"answers, {len(block)} samples per block")


def _chip(file: ChipFile, path: Path) -> Finding:
    """Identify a microcontroller on its port, or build it and run it in co-simulation."""
    try:
        with opened_chip(file, path, Gate()) as chip:
            return Finding("instrument", "chip", True, chip.identity)
    except HaselabError as error:
        what, _, advice = str(error).partition(". ")
        return Finding("instrument", "chip", False, what, advice)


def _simulated(file: TwinFile | ReplayFile, path: Path) -> Finding:
    """Open a twin, or a recorded session; the files that the rig file names may be missing."""
    try:
        with opened_rig(file, path, Gate()):
            return Finding("rig", file.kind, True, f"{path} is valid")
    except HaselabError as error:
        what, _, advice = str(error).partition(". ")
        return Finding("rig", file.kind, False, what, advice)


def _needs(file: object) -> SystemNeeds:
    """What the instruments of a rig file need from the operating system."""
    if isinstance(file, BenchConfig):
        needs = (each.instrument.system_needs(each.config) for each in file.instruments())
        return functools.reduce(operator.or_, needs)
    if isinstance(file, ChipFile):
        of_port = SystemNeeds(() if file.port is None else (file.port,))
        camera = file.camera
        return of_port if camera is None else of_port | camera_of(camera).system_needs(camera)
    return SystemNeeds()


def _instruments(file: RigFile, path: Path) -> list[Finding]:
    """Identify every instrument of a rig file, each on its own."""
    if isinstance(file, ChipFile):
        return [_chip(file, path)]
    if not isinstance(file, BenchConfig):
        return [_simulated(file, path)]
    found = []
    for name, reported in identify(file):
        wrong = reported if isinstance(reported, HaselabError) else None
        # The message's last sentences say what to do.
        what, _, advice = str(reported).partition(". ")
        found.append(Finding("instrument", name, wrong is None, what, advice if wrong else ""))
    return found


def _examine() -> list[Finding]:
    needed = "pip install haselab"
    return [
        Finding("runtime", "haselab", True, __version__),
        Finding("runtime", "python", True, platform.python_version()),
        *(_extension(name) for name in _EXTENSIONS),
        *(_package(name, "package", needed) for name in _PACKAGES),
        *(
            _package(name, "optional", f"For {purpose}: pip install 'haselab[{extra}]'")
            for name, (purpose, extra) in _OPTIONAL.items()
        ),
        _opencv(),
        *(finding for each in INSTRUMENTS.packages().items() for finding in _driver(*each)),
        *(_tool(name) for name in _TOOLS),
        *extension_findings(),
        _twin(),
    ]


@click.command("doctor")
@shared_option(
    "--rig", type=click.Path(path_type=Path),
    detail="Its instruments are then identified too. Default: none.",
)  # fmt: skip
@answer_options()
def command(rig: Path | None, as_json: bool, out: Path | None) -> None:
    """Report what is installed and which devices answer.

    If something is missing or does not answer, the command says how to fix it. It also examines
    serial ports, cameras, the network and the process priorities of the operating system. With
    --rig it identifies every instrument of that bench; outputs are not changed.
    """
    findings = _examine()
    file = None if rig is None else load_rig(rig)
    findings += examine_system(Machine(), _needs(file))
    if rig is not None and file is not None:
        findings += _instruments(file, rig)
    structured = {"findings": [asdict(item) for item in findings]}
    if out is not None:
        write_text(out, json.dumps(structured, indent=2) + "\n")
    if as_json:
        click.echo(json.dumps(structured, indent=2))
        return
    for item in findings:
        mark = "ok" if item.found else "--"
        advice = f"  {item.advice}" if item.advice else ""
        click.echo(f"{mark}  {item.kind:10s} {item.name:12s} {item.detail}{advice}")
