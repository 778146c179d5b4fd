"""Every command and the Python of the page about hysteresis and creep run as they stand."""

import re
from pathlib import Path

import numpy as np
import pytest

from haselab.models import PrandtlIshlinskii, PronyCreep
from haselab.signals import triangle
from tests.docs.page import Page

PAGE = Page("identify/hysteresis-and-creep.md")


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of."""
    folder, rng = tmp_path_factory.mktemp("records"), np.random.default_rng(1)

    def write(name: str, u: np.ndarray, y: np.ndarray) -> None:
        table = np.column_stack([u, y + 2e-4 * rng.normal(size=u.size)])
        np.savetxt(folder / name, table, "%.9g", ",", header="voltage_v,strain", comments="")

    actuator = PrandtlIshlinskii(0.06, (0.1, 0.4), (0.02, 0.02), 0.0, 0.05, 0.1)
    for name, frequency_hz in (("slow", 0.1), ("loops", 0.25), ("fast", 1.0)):
        cycle = triangle(0.0, 2.0, frequency_hz, 1, 100.0)
        u = np.concatenate([cycle, cycle, 0.6 * cycle, 0.8 * cycle])
        write(f"{name}.csv", u, actuator.simulate(u, 100.0))
    u = np.r_[np.zeros(100), np.ones(2000)]
    creep = PronyCreep(0.1, (0.03,), (4.0,))
    write("held.csv", u, creep.simulate(u, 50.0))
    write("step.csv", np.ones(2000), creep.simulate(np.ones(2000), 50.0))
    return folder


def test_every_command_of_the_page_runs(
    records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(records)
    assert len(PAGE.commands) >= 7
    for line in PAGE.commands:
        PAGE.run(line)
        told = capsys.readouterr().out
        assert re.search(r"^status +ok$", told, flags=re.MULTILINE), line


@pytest.mark.parametrize("code", PAGE.python)
def test_the_python_of_the_page_runs(code: str) -> None:
    PAGE.execute(code)
