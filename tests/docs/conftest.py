"""Folders in which the commands of a page run as they are written there."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

_GUARD_S = 400.0
_PIP = "--no-deps --no-build-isolation --no-index --quiet --disable-pip-version-check"


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

    def run_all(self, commands: list[str]) -> None:
        """Run commands that must succeed."""
        for command in commands:
            done = self.run(command)
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def make_shell(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Shell]:
    """Makes a `Shell` in a new folder of a name."""

    def make(name: str) -> Shell:
        folder = tmp_path_factory.mktemp(name)
        environment = folder / "environment"
        venv.EnvBuilder(with_pip=False, symlinks=True).create(environment)
        (site,) = environment.glob("lib/python*/site-packages")
        paths = [path for path in sys.path if path and Path(path).is_dir()]
        (site / "tests.pth").write_text("\n".join(paths) + "\n")
        programs = environment / "bin"
        for program, call, options in (("haselab", "haselab.cli", ""), ("pip", "pip", _PIP)):
            script = programs / program
            script.write_text(f'#!/bin/sh\nexec "{programs}/python" -m {call} "$@" {options}\n')
            script.chmod(0o755)
        return Shell(folder, programs)

    return make
