"""The doctor's list of packages: complete, so that nothing is missing only when it is used."""

import json
import re
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

from haselab.cli.doctor.command import command

PROJECT = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
DEVELOPERS = {"test", "lint", "docs", "bench", "comparison"}
EXTRAS = sorted(PROJECT["optional-dependencies"].keys() - DEVELOPERS)
# What comes in packages of several names is reported under its own.
NAMES = {"opencv-python-headless": "opencv", "nidaqmx": "grpcio"}


@pytest.fixture(scope="module")
def reported() -> dict[str, dict[str, object]]:
    done = CliRunner().invoke(command, ["--json"])
    answer = json.loads(done.stdout)
    findings = answer if isinstance(answer, list) else answer["findings"]
    return {finding["name"].lower(): finding for finding in findings}


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_each_package_that_a_user_may_need_is_reported(reported, extra: str) -> None:
    needed = PROJECT["optional-dependencies"][extra] if extra else PROJECT["dependencies"]
    names = {re.split(r"[\[>=<; ]", line)[0].lower() for line in needed} - {"haselab"}
    assert {NAMES.get(name, name) for name in names} <= reported.keys()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "twin"\ntwin = "lost.toml"\n', "No such twin file"),
        ('kind = "replay"\nsession = "lost/session.h5"\n', "No session here"),
    ],
)
def test_a_rig_file_that_names_a_missing_file_is_not_valid(
    text: str, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    done = CliRunner().invoke(command, ["--rig", str(path), "--json"])
    found = json.loads(done.stdout)["findings"][-1]
    assert (found["kind"], found["found"]) == ("rig", False)
    assert words in found["detail"]
    assert found["advice"]
