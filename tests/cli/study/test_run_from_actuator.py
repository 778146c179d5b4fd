"""`haselab run --actuator`: what the file knows is used where the study does not find it out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.store.session.writer import SessionReader

TRIANGLE = """\
name = "maps"
[operating_point]
baseline_v = 1.0
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = 0.25
cycles = 3
skipped_cycles = 1
frame_rate_hz = 50.0
"""
STEPS = """\
name = "steps by the file alone"
[steps]
step = 0.03
zero_s = 4.0
step_s = 6.0
rest_s = 10.0
frame_rate_hz = 20.0
open_trials = 1
pi_trials = 1
pid_trials = 0
custom_trials = 1
"""
CONTROLLER = """
[controller]
kind = "pi"
[controller.parameters]
kp = 0.1
ki = 1.5
[controller.limits]
low = -0.04
high = 0.06
"""


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    return int(str(stop.value.code))


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The actuator file of a triangle, with a controller that was typed."""
    folder = tmp_path_factory.mktemp("known")
    (folder / "triangle.toml").write_text(TRIANGLE)
    (folder / "steps.toml").write_text(STEPS)
    (folder / "rig.toml").write_text('kind = "twin"\n')
    out = folder / "maps"
    arguments = ("--rig", folder / "rig.toml", "--keep-video", "none", "--out", out)
    assert run("run", folder / "triangle.toml", *arguments) == 0
    text = (out / "actuator.toml").read_text()
    (folder / "leg.toml").write_text(text.partition("\n[controller]")[0] + CONTROLLER)
    return folder


@pytest.mark.long
def test_a_study_of_steps_alone_is_played_with_the_maps_and_the_controller_of_the_file(
    known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, leg = known / "rig.toml", known / "leg.toml"
    out = tmp_path / "steps"
    arguments = ("--rig", rig, "--keep-video", "none", "--out", out)
    assert run("run", known / "steps.toml", *arguments, "--actuator", leg) == 0
    said = capsys.readouterr().err
    assert "does not play steps.pi_trials = 1:" in said and "no [chirp]" in said
    rows = {r["id"]: r for r in json.loads((out / "results.json").read_text())["quantities"]}
    own = rows["S25.error_own"]
    # An integral leaves what creep moves within the step: the same bound as on the page.
    assert abs(own["measured"]["value"]) < 0.05
    assert "controller 'pi' (kp = 0.1, ki = 1.5)" in own["note"]
    assert rows["S24.rise_open"]["measured"] is not None
    with SessionReader(out / "session.h5") as session:
        said = [what for _, what in session.events()]
        drive_v = session.experiment("own-1").drive_v
    assert "controller own-1: pi, kp = 0.1, ki = 1.5 1/s" in said
    assert np.ptp(drive_v) > 0.1
    # The same numbers from the recording alone.
    assert run("analyse", out, "--out", tmp_path / "again") == 0
    again = json.loads((tmp_path / "again" / "results.json").read_text())["quantities"]
    assert {r["id"]: r["measured"] for r in again} == {k: r["measured"] for k, r in rows.items()}


@pytest.mark.long
def test_without_the_file_such_a_study_says_what_is_missing(
    known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run("run", known / "steps.toml", "--rig", known / "rig.toml", "--out", tmp_path / "o")
    assert code == 2
    assert "Add operating_point.baseline_v" in capsys.readouterr().err


def test_a_controller_that_needs_the_physical_model_is_refused_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, rig, out = tmp_path / "s.toml", tmp_path / "rig.toml", tmp_path / "o"
    study.write_text(TRIANGLE + STEPS.partition("\n")[2] + '[control]\nkind = "network"\n')
    rig.write_text('kind = "twin"\n')
    assert run("run", study, "--rig", rig, "--out", out) == 2
    assert "kind 'network' needs the physical model of the actuator" in capsys.readouterr().err
    assert not (out / "session.h5").exists()


@pytest.mark.long
def test_the_highest_field_of_the_file_limits_the_drive(
    known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The twin's amplifier gives 5000 V/V: 1.5e7 V/m in 0.5 mm are 1.5 V of drive."""
    leg = tmp_path / "leg.toml"
    text = (known / "leg.toml").read_text()
    text = text.replace("[drive]\n", "[drive]\nhighest_field_v_per_m = 1.5e7\n", 1)
    leg.write_text(text)
    arguments = ("--rig", known / "rig.toml", "--actuator", leg, "--out", tmp_path / "o")
    assert run("run", known / "triangle.toml", *arguments) == 2
    assert "actuator.geometry.gap_m is missing" in capsys.readouterr().err
    geometry = "[actuator.geometry]\n"
    leg.write_text(text.replace(geometry, f"{geometry}gap_m = 0.5e-3\n", 1))
    assert run("run", known / "triangle.toml", *arguments) == 2
    said = f"[0, 1.5] V. Lower the request, or widen the limit in [drive] of {leg}."
    assert said in capsys.readouterr().err


@pytest.mark.long
def test_a_calibration_of_the_file_is_used_and_one_for_another_carrier_refused(
    known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The twin's monitors are off by a few percent, which the calibration takes out."""
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    assert run("init", "leg", "--out", tmp_path / "leg.toml") == 0
    leg = tmp_path / "leg.toml"
    two = ("--capacitor", "0.47e-9", "--capacitor", "2.2e-9", "--duration-s", 0.3)
    code = run("calibrate", "--rig", tmp_path / "rig.toml", *two, "--actuator", leg)
    assert code == 0, capsys.readouterr().err
    out = tmp_path / "maps"
    arguments = ("--rig", tmp_path / "rig.toml", "--keep-video", "none", "--actuator", leg)
    assert run("run", known / "triangle.toml", *arguments, "--out", out) == 0
    with SessionReader(out / "session.h5") as session:
        calibration = session.header["rig"]["calibration"]
    assert len(calibration["scale_s"]) == 2
    other = tmp_path / "other.toml"
    other.write_text(TRIANGLE + "[sensing]\ncarrier_hz = 1000.0\n")
    assert run("run", other, *arguments, "--out", tmp_path / "no") == 2
    assert "is for a carrier of 2000 Hz, not 1000 Hz" in capsys.readouterr().err
