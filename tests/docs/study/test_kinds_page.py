"""The page on studies of other kinds of actuators: its commands, in their order."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.docs.page import Page

PAGE = Page("study/kinds.md")
COMMANDS = re.findall(r"^    (haselab .*)", PAGE.text, re.MULTILINE)
KINDS = Path(__file__).resolve().parents[3] / "examples" / "kinds"


def test_the_page_names_every_kind_that_has_an_example() -> None:
    assert len(COMMANDS) == 7
    for folder in KINDS.iterdir():
        assert f"`{folder.name}`" in PAGE.text


@pytest.mark.long
def test_the_commands_run_as_they_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    has_simulator = shutil.which("avr-gcc") and Path("/usr/include/simavr").is_dir()
    for command in COMMANDS:
        if has_simulator or not command.startswith("haselab firmware"):
            PAGE.run(command)
    rows = json.loads(Path("out/peano/results.json").read_text())["quantities"]
    strains = {row["id"]: row["measured"]["value"] for row in rows if "S18.strain" in row["id"]}
    # As the page says: -3.0 to 2.0 %, to the digit that it states.
    assert strains["S18.strain_min"] == pytest.approx(-0.030, abs=5e-4)
    assert strains["S18.strain_max"] == pytest.approx(0.020, abs=5e-4)
    assert "-3.0 to 2.0 %" in PAGE.text
    assert "Natural frequency" in Path("out/peano/report.html").read_text(encoding="utf-8")
