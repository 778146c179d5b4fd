"""What the page on recordings shows is run here as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.store.manifest import Manifest
from haselab.store.session.writer import ExperimentPlan, SessionWriter

PAGE = Path(__file__).resolve().parents[2] / "docs" / "session.md"
TEXT = PAGE.read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
COMMANDS = re.findall(r"^    haselab ((?:.*\\\n)*.*)", TEXT, re.MULTILINE)
HEADER = {"rig": {"rate_hz": 200e3, "volt_per_code": 3.0517578125e-4}}


@pytest.fixture(autouse=True)
def reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run where the page has one; `DIR` is another name of it."""
    monkeypatch.chdir(tmp_path)
    folder = Path("out/reference")
    plans = [ExperimentPlan("triangle", "triangle", 1, {})]
    with (
        Manifest(folder, {}),
        SessionWriter(folder / "session.h5", plans, 2000, HEADER) as session,
    ):
        for k in range(30):
            block = np.full((2000, 2), k, np.int16)
            session.append_block("triangle", block, 125.0 + 0.01 * k, 1.0, float("nan"))
    Path("DIR").symlink_to(folder)


def test_the_page_has_what_is_run_here() -> None:
    assert (len(PYTHON), len(COMMANDS)) == (2, 3)


@pytest.mark.parametrize("code", PYTHON, ids=["follow", "xarray"])
def test_each_piece_of_python_runs(code: str) -> None:
    if "xarray" in code:
        pytest.importorskip("xarray")
        pytest.importorskip("h5netcdf")
    exec(compile(code, str(PAGE), "exec"), {})


def test_the_commands_run_in_their_order(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            main(shlex.split(command.replace("\\\n", " ")))
        assert not ended.value.code, capsys.readouterr().err
    assert Path("again/session.h5").is_file()
