"""Folders in which the commands of a page run as they are written there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import venv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

_ROOT = Path(__file__).resolve().parents[2]
_GUARD_S = 900.0
_OFFLINE = "--no-deps --no-build-isolation --no-index --quiet --disable-pip-version-check"
_PROGRAMS = (("haselab", "haselab.cli", ""), ("pytest", "pytest -q", ""), ("pip", "pip", _OFFLINE))


@dataclass(frozen=True)
class Shell:
    """A folder, and an environment of its own with haselab and nothing else."""

    folder: Path
    programs: Path

    def run(self, command: str) -> subprocess.CompletedProcess[str]:
        path = f"{self.programs}{os.pathsep}{os.environ['PATH']}"
        return subprocess.run(
            command, shell=True, cwd=self.folder, env=os.environ | {"PATH": path}, text=True,
            check=False, capture_output=True, timeout=_GUARD_S,
        )  # fmt: skip

    def json(self, name: str) -> Any:
        """What a JSON file of the folder holds."""
        return json.loads((self.folder / name).read_text(encoding="utf-8"))

    def run_all(self, commands: list[str]) -> None:
        """Run commands that must succeed."""
        for command in commands:
            done = self.run(command)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def make_shell(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Shell]:
    """Makes a `Shell` in a new folder of a name, with copies of packages of examples/plugins."""

    def make(name: str, *packages: Path) -> Shell:
        folder = tmp_path_factory.mktemp(name)
        (folder / "rig.toml").write_text('kind = "twin"\n')
        for package in packages:
            ignore = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
            shutil.copytree(package, folder / package.relative_to(_ROOT), ignore=ignore)
        environment = folder / "environment"
        venv.EnvBuilder(with_pip=False, symlinks=True).create(environment)
        (site,) = environment.glob("lib/python*/site-packages")
        paths = [path for path in sys.path if path and Path(path).is_dir()]
        lines = [
            f"import site; site.addsitedir({path!r})" for path in paths
        ]  # with their .pth files
        (site / "tests.pth").write_text("\n".join(lines) + "\n")
        programs = environment / "bin"
        for program, call, options in _PROGRAMS:
            script = programs / program
            script.write_text(f'#!/bin/sh\nexec "{programs}/python" -m {call} "$@" {options}\n')
            script.chmod(0o755)
        return Shell(folder, programs)

    return make
