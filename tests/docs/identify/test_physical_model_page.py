"""The commands of the section on predictions run as they stand on the page."""

import json
import re
from pathlib import Path

import pytest

from tests.cli.model.physical_files import played, table, written
from tests.docs.page import Page

PAGE = Page("identify/physical-model.md")
(SECTION,) = re.findall(r"^## Predict with it\n(.*?)^## ", PAGE.text, re.DOTALL | re.MULTILINE)
(BLOCK,) = re.findall(r"^```\n(.*?)^```$", SECTION, re.DOTALL | re.MULTILINE)


@pytest.mark.long
def test_the_commands_predict_a_session_and_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "actuator.toml")
    played(tmp_path / "out" / "tomorrow")
    table(tmp_path / "steps.csv")
    for command in BLOCK.strip().splitlines():
        PAGE.run(f"{command} --json")
        answer = json.loads(capsys.readouterr().out)
        assert answer["status"] == "ok" and answer["model"] == "physical", command
        for key in re.findall(r"^\| `(\w+)`", SECTION, re.MULTILINE):
            assert key in answer or key in answer["length"] or key == "length_offset_m", key
    assert (tmp_path / "prediction.svg").exists()
