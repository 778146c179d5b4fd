"""The page on controllers: its package in a fresh environment, its commands in their order."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.base import table_at
from haselab.controllers import Measurement
from haselab.rig.chip.build import simavr_header
from haselab.store.actuator_file import ACTUATOR, read_run, write_sections
from haselab.store.session.writer import SessionReader

pytest.importorskip("setuptools", reason="builds the package of the page")

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "examples" / "plugins" / "haselab-mycontroller"
TEXT = (ROOT / "docs" / "extend" / "add-a-controller.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:cp|pip|haselab) .*)", TEXT, re.MULTILINE)
SNIPPET = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
PROJECT = re.search(r"```toml\n(\[project\]\n.*?)```", TEXT, re.DOTALL)
STUDY = re.search(r"```toml\n(name = .*?)```", TEXT, re.DOTALL)
OWN = [command for command in COMMANDS if re.search(r"my-package|mine\.toml", command)]
CONTROL = re.search(r"```toml\n(\[control\]\n.*?)```", TEXT, re.DOTALL)


@pytest.fixture(scope="module")
def lab(make_shell):
    return make_shell("controller", PACKAGE)


def test_the_page_says_what_the_example_is() -> None:
    source = PACKAGE / "src" / "haselab_mycontroller"
    python = len((source / "__init__.py").read_text().splitlines())
    c = len((source / "mycontroller.c").read_text().splitlines())
    assert python <= 40 and c <= 60
    assert f"{python} lines of Python and {c} lines of C" in TEXT
    study = tomllib.loads((PACKAGE / "study.toml").read_text())
    assert CONTROL is not None
    assert tomllib.loads(CONTROL[1])["control"] == study["control"]


def test_the_class_of_the_page_is_a_controller() -> None:
    assert SNIPPET is not None
    names: dict[str, object] = {}
    exec(SNIPPET[1], names)
    controller = names["KIND"].choose().make()  # type: ignore[attr-defined]
    assert controller.step(0.04, Measurement(0.02, 6e-10, 1.0, 0.0)) == pytest.approx(0.05)


@pytest.mark.long
def test_the_study_of_the_page_plays_its_controller_alone(lab) -> None:
    assert SNIPPET is not None and PROJECT is not None and STUDY is not None and len(OWN) == 2
    package = lab.folder / "my-package"
    package.mkdir()
    (package / "my_package.py").write_text(SNIPPET[1])
    (package / "pyproject.toml").write_text(PROJECT[1])
    (lab.folder / "mine.toml").write_text(STUDY[1])
    lab.run_all(OWN)
    results = lab.json("out/proportional/results.json")
    rows = {row["id"]: row for row in results["quantities"]}
    opened, own = (rows[key]["measured"]["value"] for key in ("S24.error_open", "S25.error_own"))
    assert f"{-100 * opened:.0f} % of the step in open loop" in TEXT
    assert f"{-100 * own:.0f} % with this controller" in TEXT
    # y = G (r + k (r - y)) with G = y / r of the open loop; 0.35 % is the camera's resolution, and
    # the maps are not quite linear.
    assert own == pytest.approx(opened / (1.0 + 0.5 * (1.0 - opened)), abs=0.01)
    assert "S24.rise_closed" not in rows and "S25.rise_pid" not in rows
    shown = lab.json("out/proportional/analysis.json")["steps"]["groups"]
    assert list(shown) == ["open loop", "proportional"]
    shutil.rmtree(lab.folder / "out")


@pytest.mark.slow
def test_the_commands_of_the_page_do_what_it_says(lab) -> None:
    has_chip = shutil.which("avr-gcc") is not None and simavr_header() is not None
    wanted = lab.run(f"haselab run {PACKAGE}/study.toml --rig rig.toml --out out/none")
    assert wanted.returncode == 2
    assert "Use one of open-loop, pi, pid, " in wanted.stderr
    assert ", or install the package" in wanted.stderr
    assert not (lab.folder / "out").exists()
    told = {}
    for command in (one for one in COMMANDS if one not in OWN):
        if not has_chip and re.search("firmware|chip", command):
            continue
        done = lab.run(command)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        told[command] = done.stdout
    check_study(lab.folder / "out")
    if has_chip:
        check_chip(lab.folder / "out", told)


def test_the_commands_for_the_chip_work_with_the_maps_of_any_study(make_shell) -> None:
    """The page's last commands alone, on the small study of the firmware's tests."""
    if shutil.which("avr-gcc") is None or simavr_header() is None:
        pytest.skip("avr-gcc or libsimavr is not installed")
    shell = make_shell("chip", PACKAGE)
    run = read_run(ROOT / "tests" / "firmware" / "data")
    assert CONTROL is not None
    control = tomllib.loads(CONTROL[1])["control"]
    mine = {"kind": control.pop("kind"), "parameters": control}
    controller = dict(table_at(run, "controller")) | {"alternatives": [mine]}
    write_sections(shell.folder / "out" / "mine" / ACTUATOR, dict(run) | {"controller": controller})
    told = {}
    others = [command for command in COMMANDS if command not in OWN]
    for command in (one for one in others if re.search("example|pip|firmware|chip", one)):
        done = shell.run(command)
        assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
        told[command] = done.stdout
    assert "CRC-32" in (shell.folder / "out" / "mine-firmware" / "settings.h").read_text()
    simulated = next(text for command, text in told.items() if "simulate" in command)
    assert "not compared: only the step of a PI or PID is predicted" in simulated
    assert re.findall(r"loop +(.*)", simulated) == [
        "desktop, 100 Hz", "desktop, 1000 Hz", "chip, 1000 Hz"
    ]  # fmt: skip
    _, fast, chip = map(float, re.findall(r"steady_state_error +(\S+)", simulated))
    # The two sense with different instruments: 0.5 % strain of a step of 4 %, as in test_safety.py.
    assert abs(chip - fast) < 5e-3 / 0.04
    check_steps(shell.folder / "out")


def check_study(out: Path) -> None:
    """Recorded, analysed again with the same numbers, exported, reported."""
    rows = {
        name: {row["id"]: row for row in
               json.loads((out / name / "results.json").read_text())["quantities"]}
        for name in ("mine", "mine-again")
    }  # fmt: skip
    own = {key: row for key, row in rows["mine"].items() if key.endswith("_own")}
    assert set(own) == {"S25.rise_own", "S25.overshoot_own", "S25.error_own"}
    for key, row in own.items():
        assert row["measured"] == rows["mine-again"][key]["measured"]
        assert "controller 'mycontroller' (gain_per_s = 1, smoothing_s = 0.1)" in row["note"]
    # An integral leaves no steady-state error but what creep moves within the step.
    assert abs(own["S25.error_own"]["measured"]["value"]) < 0.05
    held = tomllib.loads((out / "mine" / "actuator.toml").read_text())["controller"]
    (mine,) = (one for one in held["alternatives"] if one["kind"] == "mycontroller")
    assert mine["parameters"] == {"gain_per_s": 1.0, "smoothing_s": 0.1}
    with SessionReader(out / "mine" / "session.h5") as session:
        events = [what for _, what in session.events()]
        drive_v = session.experiment("own-1").drive_v
    said = "controller own-1: mycontroller, gain_per_s = 1 1/s, smoothing_s = 0.1 s"
    assert said in events
    assert np.ptp(drive_v) > 0.1
    assert list((out / "mine-csv").rglob("*own-1*"))
    assert "mycontroller" in (out / "mine" / "report.html").read_text(encoding="utf-8")


def check_chip(out: Path, told: dict[str, str]) -> None:
    """The C step on the chip does what the Python step does at the chip's rate."""
    assert "CRC-32" in (out / "mine-firmware" / "settings.h").read_text()
    simulated = next(text for command, text in told.items() if "simulate" in command)
    assert "overruns" in simulated
    shown = json.loads((out / "mine" / "firmware" / "simulation.json").read_text())["loops"]
    ends = {
        name: float(np.mean(loop["strain"][-200:])) for name, loop in shown.items()
    }  # fmt: skip
    assert set(ends) == {"desktop, 100 Hz", "desktop, 1000 Hz", "chip, 1000 Hz"}
    # The two sense with different instruments: 0.5 % strain, as in test_safety.py.
    assert abs(ends["chip, 1000 Hz"] - ends["desktop, 1000 Hz"]) < 5e-3
    check_steps(out)


def check_steps(out: Path) -> None:
    """The trial on the chip ends at its reference, but for what creep moves within the step."""
    rows = json.loads((out / "mine-chip" / "results.json").read_text())["quantities"]
    error = next(row for row in rows if row["id"] == "S26.error")["measured"]["value"]
    assert abs(error) < 0.05
