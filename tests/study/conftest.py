"""Whole quick studies, played once a session by processes of their own, two at a time.

Tests that use them run first and on one worker: see `pytest_collection_modifyitems`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

SEED = 11
PROCESSES = 2
# Another bench than the default: lighter, stiffer, more damped, with less creep and a denser oil.
OTHER_BENCH = """
name = "another bench"
reading = "hz"
[electrodes]
stiffness_n_per_m = 188.4
[viscosity]
share = [0.02, 0.02, 0.35]
damping_n_s_per_m = 2.775
[load]
mass_kg = 0.2
[dielectric]
permittivity = 3.5
"""


@dataclass(frozen=True)
class Played:
    """The folder of a run and what its results.json holds."""

    folder: Path
    results: dict[str, Any]

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        return {row["id"]: row for row in self.results["quantities"]}


def tell(*arguments: object) -> str:
    """One command in a process of its own; its standard output."""
    command = [sys.executable, "-W", "error", "-m", "haselab.app", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def _play(folder: Path, *arguments: object) -> Played:
    tell(*arguments, "--quick", "--keep-video", "none", "--out", folder)
    return Played(folder, json.loads((folder / "results.json").read_text()))


@pytest.fixture(scope="session")
def studies(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Future[Played]]]:
    root = tmp_path_factory.mktemp("studies")
    (root / "other.toml").write_text(OTHER_BENCH)
    orders = {
        "hz": ("reproduce", "--reading", "hz", "--seed", SEED),
        "rad": ("reproduce", "--reading", "rad", "--seed", SEED),
        "other": ("reproduce", "--twin", root / "other.toml", "--seed", SEED),
    }
    with ThreadPoolExecutor(PROCESSES) as pool:
        yield {name: pool.submit(_play, root / name, *order) for name, order in orders.items()}


@pytest.fixture(scope="session")
def played(studies: dict[str, Future[Played]]) -> Callable[[str], Played]:
    """A quick study by name: `hz`, `rad`, `other` (bench)."""
    return lambda name: studies[name].result()


@pytest.fixture(scope="session", params=["hz", "rad"])
def reading(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="session")
def run(reading: str, played: Callable[[str], Played]) -> Played:
    """The quick study under one reading of the paper's frequency axis."""
    return played(reading)


@pytest.fixture(scope="session")
def command() -> Callable[..., str]:
    return tell
