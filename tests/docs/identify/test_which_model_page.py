"""Every command and every piece of Python on the page about verdicts runs as it stands."""

import json
from pathlib import Path

import numpy as np
import pytest

from haselab.base import Estimate
from haselab.models import VoltagePlant
from haselab.signals import linear_chirp, square
from tests.docs.page import Page

PAGE = Page("identify/which-model.md")
KEY, UNIT = "natural_frequency_rad_s", "rad/s"


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of, from a plant with electrical creep."""
    folder = tmp_path_factory.mktemp("records")
    plant = VoltagePlant("electrical", (0.05, 0.004), 5.11, 0.1, 0.01, 0.35, 3.0)
    rng = np.random.default_rng(1)
    quarter, rest = np.full(500, 1.5), np.ones(500)
    turns = 1.5 * square(0.5, 5.0, 100.0)
    drives = {
        "chirp": 1.0 + 0.5 * linear_chirp(0.1, 8.0, 10.0, 100.0),
        "step": np.concatenate([np.full(500, 1.04), np.full(1500, 1.4)]),
        "alternation": np.concatenate([rest[:100], quarter, turns, rest, turns]),
    }
    for name, drive_v in drives.items():
        time_s = np.arange(drive_v.size) / 100.0
        strain = plant.simulate(drive_v, 100.0, time_s) + 1e-3 * rng.normal(size=time_s.size)
        np.savetxt(folder / f"{name}.csv", np.column_stack([time_s, drive_v, strain]), "%.6f", ",",
                   header="time_s,drive_v,strain", comments="")  # fmt: skip
    for name, value in (("from-chirp", 5.11), ("from-decay", 6.61)):
        answer = {KEY: Estimate.normal(value, 0.1, UNIT).to_dict()}
        (folder / f"{name}.json").write_text(json.dumps(answer))
    (folder / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    (folder / "twin.toml").write_text('reading = "rad"\n[acquisition]\ndrive_low_v = -2.0\n')
    return folder


def test_every_command_of_the_page_runs_and_says_what_the_plant_is(
    records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(records)
    assert len(PAGE.commands) >= 7
    said = []
    for line in PAGE.commands:
        PAGE.run(line)
        said.append(capsys.readouterr().out.splitlines()[0])
    assert said[0] == "supports rad"
    assert said[3] == "supports electrical"
    assert said[4] == "supports one"
    assert said[5] == "disagree: from-chirp and from-decay"
    drive = np.loadtxt(records / "drive.csv", delimiter=",", skiprows=2)
    assert drive[:, 1].min() < 0.0


@pytest.mark.parametrize("code", PAGE.python)
def test_the_python_of_the_page_runs(code: str) -> None:
    PAGE.execute(code)
