"""A run that trips in its last experiment costs the results of that one alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from haselab.base import SafetyError
from haselab.cli.main import main
from haselab.controllers import Measurement
from haselab.runtime.loop import RunningController

ACTUATOR = """\
[actuator]
name = "maps alone"
kind = "planar-hasel"
[actuator.geometry]
zero_length_m = 0.05023
[sensing]
carrier_hz = 2000.0
[sensing.strain_map]
slope_per_f = 4.9e8
offset = -0.27
[drive]
low_v = 0.0
high_v = 2.0
[drive.voltage_map]
a1_v = 1.324
b1 = 3.124
a2_v = -0.2805
b2 = -26.92
"""
STUDY = """\
name = "two kinds of trials"
[control]
kind = "open-loop"
[steps]
step = 0.02
zero_s = 1.1
step_s = 2.0
rest_s = 0.2
frame_rate_hz = 20.0
open_trials = 1
pi_trials = 0
pid_trials = 0
custom_trials = 1
"""
REASON = "Controller 'mine' returned nan"
OWN = {"S25.rise_own", "S25.overshoot_own", "S25.error_own"}


def command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and the line on stderr."""
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1, printed
    assert isinstance(stop.value.code, int)
    return stop.value.code, printed


def test_what_was_complete_before_a_controller_failed_is_analysed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(self: RunningController, reference: float, measurement: Measurement) -> float:
        raise SafetyError(REASON)

    monkeypatch.setattr(RunningController, "step", fail)
    for name, text in (("a", ACTUATOR), ("study", STUDY), ("rig", 'kind = "twin"\n')):
        (tmp_path / f"{name}.toml").write_text(text)
    out = tmp_path / "out"
    code, said = command(
        ["run", str(tmp_path / "study.toml"), "--rig", str(tmp_path / "rig.toml"), "--actuator",
         str(tmp_path / "a.toml"), "--keep-video", "none", "--out", str(out)], capsys,
    )  # fmt: skip
    assert code == 4
    assert REASON in said
    assert f"results of the complete experiments with: haselab analyse {out}" in said
    code, said = command(["report", str(out)], capsys)
    assert code == 2
    assert f"haselab analyse {out}" in said

    code, said = command(["analyse", str(out)], capsys)
    assert code == 3
    assert f"The run ended in 'own-1': {REASON}" in said
    results = json.loads((out / "results.json").read_text())
    measured = {row["id"] for row in results["quantities"] if row["measured"]}
    assert "S24.rise_open" in measured
    assert not OWN & measured
    (missing,) = [one for one in results["not_played"] if REASON in one["reason"]]
    assert set(missing["ids"]) == OWN
    assert "returned nan" in (out / "report.html").read_text()
