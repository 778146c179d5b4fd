"""The page on file formats: its package in a fresh environment, its commands in their order."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("setuptools", reason="builds the package of the page")

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "extend" / "add-a-file-format.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:pip|haselab) .*)", TEXT, re.MULTILINE)
CLASS = re.search(r"```python\n(.*?)```", TEXT, re.DOTALL)
PROJECT = re.search(r"```toml\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.long
def test_the_commands_of_the_page_read_a_file_of_the_new_format(make_shell) -> None:
    assert CLASS is not None and PROJECT is not None
    shell = make_shell("format")
    package = shell.folder / "my-format"
    package.mkdir()
    (package / "my_format.py").write_text(CLASS[1])
    (package / "pyproject.toml").write_text(PROJECT[1])
    strain = np.linspace(0.0, 0.1, 50)
    record = {"c": list(5e-10 + 2e-9 * strain), "e": list(strain)}
    (shell.folder / "record.json").write_text(json.dumps(record))
    install, identify = COMMANDS
    assert "Files with the ending '.json' are not supported" in shell.run(identify).stderr
    shell.run_all([install])
    done = shell.run(f"{identify} --json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["slope"]["value"] == pytest.approx(1.0 / 2e-9, rel=1e-9)
    assert re.search(r"ok  file format +\.json +my-format 1\.0", shell.run("haselab doctor").stdout)
