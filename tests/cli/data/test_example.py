"""`haselab example`: each README is run as it stands."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.pipelines.examples import recordings
from haselab.pipelines.examples.data_sets import DATA_SETS
from haselab.pipelines.examples.packages import PACKAGES
from haselab.rig.twin.config import twin_of_reading
from haselab.store.columns.table import read_table

KINDS = Path(__file__).resolve().parents[3] / "examples" / "kinds"


def code_of(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_the_examples_are_listed(capsys):
    assert code_of("example", "--json") == 0
    listed = list(json.loads(capsys.readouterr().out))
    assert listed == [*(each.name for each in DATA_SETS), *PACKAGES]
    assert code_of("example") == 0
    assert "Write one with: haselab example NAME --out DIR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("chrip", "--out", "x"), "There is no example 'chrip'. Use one of monitors, cycles"),
        (("chirp",), "Missing option '--out'"),
        (("--out", "x"), "--out needs the NAME of an example"),
        (("haselab-mysupply",), "Missing option '--out': the folder for the example haselab-my"),
    ],
)
def test_bad_use_is_one_line(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert code_of("example", *words) == 2
    printed = capsys.readouterr().err
    assert said in printed and printed.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_is_a_copy_of_the_example_that_the_tests_install(tmp_path, capsys, name):
    source = Path(__file__).resolve().parents[3] / "examples" / "plugins" / name
    assert code_of("example", name, "--out", tmp_path / "mine", "--json") == 0
    files = [Path(file) for file in json.loads(capsys.readouterr().out)["files"]]
    assert {"pyproject.toml", "README.md"} <= {file.name for file in files}
    assert not any("__pycache__" in file.parts for file in files)
    for file in files:
        assert file.suffix != ".md" or "](.." not in file.read_text()  # no link out of the copy
        assert file.read_bytes() == (source / file.relative_to(tmp_path / "mine")).read_bytes()


@pytest.mark.parametrize("name", [each.name for each in DATA_SETS])
def test_the_commands_of_each_readme_run_in_their_order(tmp_path, monkeypatch, capsys, name):
    assert code_of("example", name, "--out", tmp_path / name) == 0
    capsys.readouterr()
    monkeypatch.chdir(tmp_path / name)
    text = Path("README.md").read_text(encoding="utf-8")
    assert "SIMULATED" in text
    commands = [line.strip() for line in text.splitlines() if line.startswith("    haselab ")]
    assert commands
    for command in commands:
        words = shlex.split(command)[1:]
        if words[:2] == ["run", "study.toml"]:
            continue  # tests/study/test_kinds.py plays these studies, for half a minute each
        assert code_of(*words) == 0, capsys.readouterr().err
        printed = capsys.readouterr().out
        assert max(map(len, printed.splitlines())) <= 250, "no dictionaries on one line"
        for option in ("--plot", "--out"):
            if option in words:
                assert Path(words[words.index(option) + 1]).exists()
    assert sum(path.stat().st_size for path in Path().glob("*.csv")) < 4_000_000


@pytest.mark.parametrize("name", [path.name for path in sorted(KINDS.iterdir())])
def test_the_study_of_a_kind_is_a_copy_of_the_one_that_the_tests_play(tmp_path, name):
    assert code_of("example", name, "--out", tmp_path) == 0
    for file in (KINDS / name).iterdir():
        assert (tmp_path / file.name).read_bytes() == file.read_bytes()


def test_the_data_are_the_same_each_time(tmp_path):
    for folder in ("one", "other"):
        assert code_of("example", "release", "--out", tmp_path / folder) == 0
    one, other = ((tmp_path / name / "release.csv").read_bytes() for name in ("one", "other"))
    assert one == other


def test_the_monitors_show_the_electrodes_of_the_twin(tmp_path, monkeypatch):
    """The oracle is the twin's own parameter, which no command has been given."""
    monkeypatch.chdir(tmp_path)
    assert code_of("example", "monitors", "--out", "m") == 0
    assert code_of("sense", "m/monitors.csv", "--v", "U Monitor", "--i", "I Monitor",
                   "--carrier-hz", recordings.CARRIER_HZ, "--skew-s", 2.5e-6, "--out",
                   "c.csv") == 0  # fmt: skip
    truth_ohm = twin_of_reading("rad").dielectric.series_ohm
    measured_ohm = np.median(read_table("c.csv", ["resistance_ohm"])["resistance_ohm"])
    assert measured_ohm == pytest.approx(truth_ohm, rel=0.1)
