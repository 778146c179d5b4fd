"""Rows S26 and S28 of a quick study, and what lies in its folder to repeat them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import pytest

from haselab.rig.rig_file import load_rig
from haselab.store.session.writer import SessionReader
from haselab.study.definition import load_step_study


@pytest.fixture(params=["chip", "miniature"])
def name(request: pytest.FixtureRequest, run: Any) -> str:
    """Of an experiment that was played; without the tools the report says what is missing."""
    known = json.loads((run.folder / "firmware" / "experiments.json").read_text())
    if request.param in known["left_out"]:
        reason = known["left_out"][request.param]
        assert "sudo apt-get install" in reason or "driver" in reason
        pytest.skip(reason)
    return str(request.param)


def test_the_rows_have_intervals(run: Any, name: str) -> None:
    row = {"chip": "S26", "miniature": "S28"}[name]
    for what in ("rise", "overshoot", "error", "phase_margin"):
        found = run.rows[f"{row}.{what}"]
        low, high = found["measured"]["ci95"]
        assert low < found["measured"]["value"] < high, what
        assert found["verdict"] == "not in paper"
    assert f"{row}.settling" in run.rows
    assert math.isfinite(run.rows[f"{row}.rise"]["measured"]["value"])
    assert abs(run.rows[f"{row}.error"]["measured"]["value"]) < 0.06
    assert run.rows[f"{row}.phase_margin"]["measured"]["value"] > 45.0


def test_the_recording_is_that_of_run(run: Any, name: str) -> None:
    with SessionReader(run.folder / name / "session.h5") as session:
        assert "chip-1" in session.names
        simulator = session.header["rig_config"]["simulator"]
    assert simulator["precondition_v"] == 2.0
    assert bool(simulator["supply"]) == (name == "miniature")
    place = run.folder / "firmware"
    assert load_rig(place / f"{name}.toml").kind == "chip"
    assert load_step_study(place / f"{name}-steps.toml").step_trials.trials == 1


def test_the_figures_pid_is_that_of_figure_6(played: Callable[[str], Any]) -> None:
    """The same gains on a sheet with the same history: the overshoot is the same, too."""
    run = played("hz")
    section = json.loads((run.folder / "analysis.json").read_text())["chip"]
    if "left_out" in section:
        pytest.skip(section["left_out"])
    assert list(section["loops"]) == ["desktop, 100 Hz", "desktop, 1000 Hz", "chip, 1000 Hz"]
    camera = run.rows["S25.overshoot_pid"]["measured"]
    desk = section["metrics"]["desktop, 100 Hz"]["overshoot"]
    # 20 frames a second see the peak of a rise of 0.1 s within half a frame: less by up to 0.01.
    assert abs(desk - camera["value"]) < 0.01 + 4.0 * camera["std"]
