"""The page on a study of one experiment: its file and its commands, in their order."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "study" / "one-experiment.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:echo|haselab) .*)", TEXT, re.MULTILINE)
STUDY = re.search(r"```toml\n(.*?)```", TEXT, re.DOTALL)
TABLES = re.findall(r"^\| `\[(\w+)\]` \|", TEXT, re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("triangle")
    assert STUDY is not None
    (made / "study.toml").write_text(STUDY[1])
    programs = made / "bin"
    programs.mkdir()
    (programs / "haselab").write_text(f'#!/bin/sh\nexec {sys.executable} -m haselab.cli "$@"\n')
    (programs / "haselab").chmod(0o755)
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    for command in COMMANDS:
        done = subprocess.run(
            command, shell=True, cwd=made, env=os.environ | {"PATH": path}, text=True, check=False,
            capture_output=True, timeout=400,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return made


def results(folder: Path, name: str) -> Any:
    return json.loads((folder / "out" / name / "results.json").read_text())


def test_the_page_has_what_is_run_here() -> None:
    from haselab.study.registry import EXPERIMENTS

    assert len(COMMANDS) == 6
    assert list(EXPERIMENTS.packages()) == TABLES


def test_a_study_of_one_triangle_has_its_results_and_no_others(folder: Path) -> None:
    found = results(folder, "triangle")
    rows = {row["id"]: row for row in found["quantities"]}
    assert {key.partition(".")[0] for key in rows} == {"S13", "S14", "S15"}
    assert found["not_played"] == []
    for row in rows.values():
        assert row["paper"] is None and row["recomputed"] is None
        assert row["verdict"] == "not in paper" and "paper" not in row["note"]
        assert not {"set_in_twin", "set_in_study", "follows_from_twin"} & set(row)
    # Zero strain is at the middle of the triangle, where the voltage map has to lead.
    assert abs(rows["S14.zero"]["measured"]["value"] - 1.0) < 0.02
    assert not (folder / "out/triangle/controller.toml").exists()


def test_its_report_is_about_the_triangle_alone(folder: Path) -> None:
    page = (folder / "out/triangle/report.html").read_text()
    assert "<title>SIMULATED: one triangle</title>" in page
    for word in ("<th>Paper</th>", "IROS", "The study row by row", "recomputed", "left out", "eq."):
        assert word not in page, word
    drawn = {path.stem for path in (folder / "out/triangle/figures").glob("*.svg")}
    assert drawn == {"fig2", "fig3"}


def test_its_analysis_gives_the_same_numbers(folder: Path) -> None:
    first, again = results(folder, "triangle"), results(folder, "again")
    assert [row["measured"] for row in first["quantities"]] == [
        row["measured"] for row in again["quantities"]
    ]
