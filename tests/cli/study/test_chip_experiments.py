"""The chip's experiments of a study: tools that are missing, and the end of their process."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from haselab.base import Estimate
from haselab.cli.study.chip_experiments import ChipExperiments, main
from haselab.report.folder import read_folder
from haselab.report.page import compose_page
from haselab.rig.twin.config import twin_of_reading
from haselab.store.toml import toml_text
from haselab.study.chip.rows import chip_rows
from haselab.study.definition import builtin_study, step_study_of
from haselab.study.experiment import ExperimentResult
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops
from haselab.study.fits.maps import Maps

# What has to be fitted before they begin; its content is of no concern here.
FITTED = ExperimentResult(values=tuple(object.__new__(kind) for kind in (Maps, Dynamics, Loops)))
DATA = Path(__file__).resolve().parents[2] / "firmware" / "data"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The folder of a study whose controllers are designed."""
    for name in ("model.json", "controller.toml"):
        shutil.copy(DATA / name, tmp_path)
    place = tmp_path / "firmware"
    place.mkdir()
    steps = step_study_of(builtin_study(), quick=True)
    (place / "chip-steps.toml").write_text(toml_text(steps.model_dump(mode="json")))
    config = twin_of_reading("hz").model_dump(mode="json")
    (place / "twin.toml").write_text(toml_text(config))
    rig = {"kind": "chip", "run": "..", "simulator": {"twin": "twin.toml", "precondition_v": 2.0}}
    (place / "chip.toml").write_text(toml_text(rig))
    return tmp_path


@pytest.mark.long
def test_tools_that_are_missing_are_one_line_of_the_report(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(folder / "nothing"))
    parts = {}
    for name in ("chip", "miniature"):
        main(folder, "none", name)
        parts[name] = json.loads((folder / "firmware" / f"{name}.json").read_text())
        assert "is not installed. Run:  sudo apt-get install" in parts[name]["left_out"][
            name
        ].replace(". Run: ", ". Run:  ")
    known = {"left_out": {name: part["left_out"][name] for name, part in parts.items()}}
    (folder / "firmware" / "experiments.json").write_text(json.dumps(known))
    rows = chip_rows(folder, None)  # type: ignore[arg-type]
    assert rows.quantities == {}
    (folder / "results.json").write_text('{"quantities": [], "provenance": {}}')
    (folder / "analysis.json").write_text(json.dumps(rows.figures))
    page = compose_page(read_folder(folder))
    for name in ("chip", "miniature"):
        assert "was left out: cc is not installed" in page.left_out[name]
    assert page.html.count("sudo apt-get install -y") == 2


def test_a_study_without_such_experiments_has_no_rows_of_them_and_says_why(tmp_path: Path) -> None:
    rows = chip_rows(tmp_path, None)  # type: ignore[arg-type]
    assert (rows.quantities, rows.notes) == ({}, {})
    for name in ("chip", "miniature"):  # figures 11 and 12 say why, so that no number is missing
        assert "only 'haselab reproduce' plays it" in rows.figures[name]["left_out"]


def test_a_recording_that_is_damaged_is_left_out_with_its_reason(tmp_path: Path) -> None:
    (tmp_path / "chip").mkdir()
    (tmp_path / "chip" / "session.h5").write_bytes(b"no HDF5 file")
    rows = chip_rows(tmp_path, None)  # type: ignore[arg-type]
    assert rows.quantities == {}
    assert rows.figures["chip"]["left_out"].startswith("no result from its recording. ")


@dataclass
class Sleeper:
    """A process in the place of the experiments'."""

    code: str

    def popen(self, command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        del command
        return subprocess.Popen([sys.executable, "-c", self.code], **options)


def started(
    folder: Path, code: str, monkeypatch: pytest.MonkeyPatch
) -> tuple[ChipExperiments, list[subprocess.Popen[bytes]]]:
    beside = ChipExperiments(folder, builtin_study(), twin_of_reading("hz"), 1, True, "none")
    processes: list[subprocess.Popen[bytes]] = []

    def popen(command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        processes.append(Sleeper(code).popen(command, **options))
        return processes[-1]

    module = sys.modules[ChipExperiments.__module__]
    monkeypatch.setattr(module, "write_design", lambda *_: None)
    patched = type("Patched", (), {**vars(subprocess), "Popen": staticmethod(popen)})
    monkeypatch.setattr(module, "subprocess", patched)
    beside.prepare()
    beside.start(FITTED)
    return beside, processes


@pytest.mark.long
def test_the_end_of_the_study_ends_them(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    beside, processes = started(folder, "import sys; sys.stdin.read()", monkeypatch)
    time.sleep(0.1)
    assert [process.poll() for process in processes] == [None, None]
    beside.stop()
    assert [process.poll() for process in processes] == [0, 0]


@pytest.mark.long
def test_a_study_that_ends_before_its_design_ends_the_prepared_processes(folder: Path) -> None:
    beside = ChipExperiments(folder, builtin_study(), twin_of_reading("hz"), 1, True, "none")
    beside.prepare()
    processes = list(beside._processes.values())
    assert beside.finish() == {}
    beside.stop()
    assert None not in [process.poll() for process in processes]
    assert not (folder / "chip").exists() and not (folder / "miniature").exists()


@pytest.mark.long
def test_a_process_that_fails_is_reported_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    beside, _ = started(folder, "raise SystemExit('no room on the disk')", monkeypatch)
    left_out = beside.finish()
    beside.stop()
    assert left_out == dict.fromkeys(
        ("S26", "S28"), "its process ended early: no room on the disk."
    )
    printed = chip_rows(folder, None).figures["chip"]["left_out"]  # type: ignore[arg-type]
    assert printed == "its process ended early: no room on the disk."


def test_the_rows_are_in_the_table() -> None:
    from haselab.study.results import quantity_rows

    ids = [f"{row}.{name}" for row in ("S26", "S28")
           for name in ("rise", "settling", "overshoot", "error", "phase_margin")]  # fmt: skip
    rows = quantity_rows({key: Estimate.normal(1.0, 0.1, "") for key in ids}, {}, {})
    assert [row["id"] for row in rows] == ids
