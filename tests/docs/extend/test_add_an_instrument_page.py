"""The page on instruments, as it stands: its package in a fresh environment, its commands in order.

The supply is the package's own emulator; the other instruments are the served twin.
"""

from __future__ import annotations

import importlib.util
import json
import re
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin

for needed in ("pty", "serial", "pymeasure", "pyvisa_py", "nidaqmx", "grpc"):
    pytest.importorskip(needed, reason="the served twin's drivers")
pytest.importorskip("setuptools", reason="builds the package of the page")

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "examples" / "plugins" / "haselab-mysupply"
TEXT = (ROOT / "docs" / "extend" / "add-an-instrument.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:cp|pip|python|haselab) .*)", TEXT, re.MULTILINE)
SECTION = re.search(r"```toml\n(\[supply\]\n.*?)```", TEXT, re.DOTALL)


def emulator_of_package() -> Any:
    spec = importlib.util.spec_from_file_location("emulator", PACKAGE / "tests" / "emulator.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Emulator()


@dataclass
class Lab:
    """A folder with a bench, and an environment that has haselab and nothing of the package."""

    shell: Any
    emulator: Any
    twin: ServedTwin


@pytest.fixture(scope="module")
def lab(make_shell) -> Iterator[Lab]:
    shell = make_shell("instrument", PACKAGE)
    # The commands work in a checkout too, whose settings pytest would otherwise take.
    (shell.folder / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    with ExitStack() as opened:
        emulator = opened.enter_context(emulator_of_package())
        twin = opened.enter_context(ServedTwin(twin_of_reading("hz"), 1, pace=0.0))
        assert SECTION is not None
        supply = SECTION[1].replace('"192.168.1.20"', '"127.0.0.1"')
        supply = supply.replace("port = 5025", f"port = {emulator.port}")
        text = re.sub(r"\[supply\]\n.*?\n\n", lambda _: f"{supply}\n", twin.rig_file(), flags=re.S)
        assert tomllib.loads(text)["supply"]["kind"] == "mysupply"
        (shell.folder / "bench.toml").write_text(text)
        yield Lab(shell, emulator, twin)


def test_the_rig_file_of_the_page_is_that_of_the_example() -> None:
    shown = re.search(r'```python\n(RIG = """.*?""")\n```', TEXT, re.DOTALL)
    assert shown is not None
    assert shown[1] in (PACKAGE / "tests" / "test_mysupply.py").read_text(encoding="utf-8")


def test_the_emulator_runs_as_a_program() -> None:
    script = PACKAGE / "tests" / "emulator.py"
    assert f"python haselab-mysupply/tests/{script.name}`; it prints its `host` and `port`" in TEXT
    with subprocess.Popen([sys.executable, script, "0"], stdout=subprocess.PIPE, text=True) as run:
        try:
            assert run.stdout is not None
            at = tomllib.loads(run.stdout.readline() + run.stdout.readline())
            with socket.create_connection((at["host"], at["port"]), 10.0) as line:
                line.sendall(b"*IDN?\n")
                assert line.makefile().readline().startswith("ACME,HV-3000,A1234")
        finally:
            run.send_signal(signal.SIGINT)
    assert run.returncode == 0


def test_the_driver_is_as_short_as_the_page_says() -> None:
    lines = (PACKAGE / "haselab_mysupply.py").read_text().splitlines()
    assert f"SCPI over TCP: {len(lines)} lines" in TEXT
    assert len(lines) <= 150


def test_the_commands_of_the_page_do_what_it_says(lab: Lab) -> None:
    before = lab.shell.run("haselab rig check bench.toml")
    assert before.returncode == 2
    assert "no supply of kind 'mysupply'; use one of 'petapicovoltron', or install" in before.stderr
    assert [command.split()[0] for command in COMMANDS] == [
        "haselab", "pip", "python", *["haselab"] * 4
    ]  # fmt: skip
    told = {}
    for command in COMMANDS:
        if "rig safe" in command:
            lab.emulator.answer("VOLT 1500;:OUTP ON")  # left on by a program that has vanished
        done = lab.shell.run(command)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        told[command] = done.stdout
    assert "20 passed" in told["python -m pytest haselab-mysupply/tests"]
    doctor = told["haselab doctor --rig bench.toml"]
    assert re.search(r"ok  driver +mysupply +section supply, package haselab-mysupply 0\.1", doctor)
    assert re.search(r"ok  instrument supply +ACME,HV-3000,A1234", doctor)
    live = told["haselab rig check bench.toml --live --yes"]
    assert re.search(r"ok +dry +supply +ACME,HV-3000,A1234", live)
    assert re.search(r"ok +live +supply +\S+ V read back, 200 V requested", live)
    assert re.search(r"ok +safe +supply +off", told["haselab rig safe bench.toml"])
    assert not lab.emulator.is_on and lab.emulator.set_v == 0.0


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_the_supply_off(lab: Lab) -> None:
    """The guardians load the package too: nobody else is left to switch the supply off."""
    assert (
        lab.shell.run("pip install --upgrade ./examples/plugins/haselab-mysupply").returncode == 0
    )
    program = (
        "import os, signal\n"
        "from haselab.rig.checks import live\n"
        "set_on = live._see_supply\n"
        "def killed(supply, wanted_v):\n"
        "    supply.set_voltage(wanted_v)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "live._see_supply = killed\n"
        "from haselab.cli.main import main\n"
        "main(['rig', 'check', 'bench.toml', '--live', '--yes', '--acknowledge'])\n"
    )
    (lab.shell.folder / "killed.py").write_text(program)
    log = lab.shell.folder / "bench.guardian.log"
    log.unlink(missing_ok=True)
    done = lab.shell.run("exec python killed.py")
    assert done.returncode == -9
    for _ in range(600):
        if log.exists() and log.read_text().endswith("\n"):
            break
        lab.shell.run("sleep 0.1")
    records = [json.loads(line) for line in log.read_text().splitlines()]
    supply = next(each for each in records[0]["instruments"] if each["name"] == "supply")
    assert supply == {"name": "supply", "confirmed_off": True, "fault": ""}
    assert "VOLT 200.0;:OUTP ON;:VOLT?" in lab.emulator.commands  # it was on
    assert not lab.emulator.is_on and lab.emulator.set_v == 0.0
