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

import h5py
import numpy as np
import pytest

from haselab.study import definition

SEED = 11
PROCESSES = 2
# Another bench than the default: lighter, stiffer, more damped, with less creep and a denser oil.
OTHER_BENCH = """
name = "another bench"
reading = "hz"
[electrodes]
stiffness_n_per_m = 180.0
[mullins]
share = 0.0
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


class Experiment:
    """One experiment of the session in physical units."""

    def __init__(self, group: Any, rig: dict[str, Any]) -> None:
        self.rig = rig
        blocks, frames, tracks = (group[name][()] for name in ("blocks", "frames", "tracks"))
        self.start, self.drive, self.reference = (
            blocks[name] for name in ("start_s", "drive_v", "reference")
        )
        self.codes = group["codes"]
        # The three marks at the upper clamp have smaller rows than those at the lower one.
        y = np.where(tracks["valid"], tracks["y_px"], np.nan)
        order = np.argsort(np.nanmean(y, axis=0))
        length_px = y[:, order[3:]].mean(axis=1) - y[:, order[:3]].mean(axis=1)
        length = rig["scale_m_per_px"] * length_px
        seen = np.isfinite(length)
        self.time, self.length, self.mass = (
            values[seen] for values in (frames["time_s"], length, frames["mass_kg"])
        )


class Recorded:
    """A run's session.h5 by h5py alone, and the results to compare with."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = h5py.File(folder / "session.h5", "r")
        header = json.loads(self.file.attrs["header"])
        self.rig, self.study = header["rig"], header["study"]
        self.rows = {
            row["id"]: row["measured"]
            for row in json.loads((folder / "results.json").read_text())["quantities"]
        }

    def value(self, key: str) -> float:
        return float(self.rows[key]["value"])

    def agrees(self, key: str, own: float, *, rel: float = 0.0, within: float = 0.0) -> None:
        """A number that a test has computed is the one in results.json."""
        assert own == pytest.approx(self.value(key), rel=rel, abs=within), key

    def experiment(self, name: str) -> Experiment:
        return Experiment(self.file["experiments"][name], self.rig)

    def trials(self, group: str) -> list[Experiment]:
        names = sorted(n for n in self.file["experiments"] if n.startswith(f"{group}-"))
        return [self.experiment(name) for name in names]

    @property
    def block_s(self) -> float:
        return float(self.rig["block_samples"] / self.rig["rate_hz"])

    @property
    def late_s(self) -> float:
        """From a block's start to the new output."""
        return float(self.rig["switch_sample"] / self.rig["rate_hz"])


BUILTIN = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
ALONE = ("reproduce", "--no-physical-model")  # test_physical_model_rows.py has the model


def tell(*arguments: object) -> str:
    """One command in a process of its own; its standard output."""
    command = [sys.executable, "-W", "error", "-m", "haselab.cli", *map(str, arguments)]
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
    (root / "rig.toml").write_text(f'kind = "twin"\ntwin = "other.toml"\nseed = {SEED}\n')
    orders = {
        "hz": (*ALONE, "--reading", "hz", "--seed", SEED),
        "rad": (*ALONE, "--reading", "rad", "--seed", SEED),
        "other": ("run", BUILTIN, "--rig", root / "rig.toml"),  # without the microcontroller
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


@pytest.fixture(scope="module")
def recorded(played: Callable[[str], Played]) -> Iterator[Recorded]:
    """The quick study of reading Hz, for computations of the tests' own."""
    found = Recorded(played("hz").folder)
    yield found
    found.file.close()


@pytest.fixture(scope="session")
def command() -> Callable[..., str]:
    return tell
