"""What the page on the FMU shows is run here as it stands, and its tables name what the FMU has."""

import re
from pathlib import Path

import pytest

from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.fmu import twin_fmu
from tests.docs.page import Page

PAGE = Page("bench/fmu.md")


def test_the_commands_and_the_simulation_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for command in PAGE.commands:
        PAGE.run(command)
    (code,) = PAGE.python
    capsys.readouterr()
    PAGE.execute(code)
    printed = capsys.readouterr().out
    assert 0.1 < float(printed.splitlines()[-1].split()[0]) < 5.0, "mm at 5 kV, after 0.9 s"


def test_the_tables_name_all_inputs_and_outputs() -> None:
    fmu = twin_fmu(TwinConfig())
    rows = [line for line in PAGE.text.splitlines() if line.startswith("| `")]
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])}
    assert named == {*fmu.inputs, *fmu.outputs}
    for name in re.findall(r"`([a-z]+\.\w+)`", PAGE.text):
        if name != "acquisition.block_samples" and not name.startswith("model."):
            assert name in fmu.parameters or name in fmu.constants, name
