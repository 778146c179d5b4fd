"""Every command and every piece of Python on the page about frequency responses runs."""

from pathlib import Path

import numpy as np
import pytest

from haselab.models import Plant
from tests.docs.page import Page

PAGE = Page("identify/frequency-response.md")


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of."""
    folder = tmp_path_factory.mktemp("records")
    rng = np.random.default_rng(1)
    plant = Plant(0.5, 5.11, 0.09)
    time_s = np.arange(4000) / 400.0
    sweep = np.sin(2 * np.pi * (0.1 * time_s + 0.495 * time_s**2))
    turns = 2 * np.pi * np.outer(np.arange(1, 101), np.arange(4000)) / 4000
    drives = {
        "chirp": sweep,
        "again": sweep[:3200],
        "noise": np.repeat(rng.normal(size=3000), 8),
    }
    for k in (1, 2):
        phase_rad = rng.uniform(0.0, 2 * np.pi, 100)
        drives[f"multisine{k}"] = np.tile(np.cos(turns + phase_rad[:, None]).sum(axis=0), 2)
    for name, u in drives.items():
        y = plant.simulate(u, 400.0, np.arange(u.size) / 400.0)
        y = y + 0.01 * y.std() * rng.normal(size=u.size)
        np.savetxt(folder / f"{name}.csv", np.column_stack([u, y]), "%.9g", ",", header="u,y",
                   comments="")  # fmt: skip
    return folder


def test_every_command_of_the_page_runs_in_its_order(
    records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(records)
    assert len(PAGE.commands) >= 8
    for line in PAGE.commands:
        PAGE.run(line)
    assert (records / "plant.json").exists()


@pytest.mark.parametrize("code", PAGE.python, ids=lambda code: code.split("\n")[0])
def test_every_piece_of_python_runs(
    code: str, records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(records)
    PAGE.execute(code)
