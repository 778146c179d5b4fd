"""Every command and every piece of Python on the pages about self-sensing runs as it stands."""

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.store.session.writer import ExperimentPlan, SessionWriter
from tests.docs.page import Page

HOW_TO, EXPLAINED = Page("measure/sensing.md"), Page("measure/how-self-sensing-works.md")
SNIPPETS = [(page, code) for page in (HOW_TO, EXPLAINED) for code in page.python]


def _drive() -> np.ndarray:
    """1 nF under a triangle of 0.5 Hz without a carrier, 8 s at 1 kHz."""
    turn = (np.arange(8000) + 0.5) / 2000.0 % 1.0
    v = 2.0 - 2.0 * np.abs(2.0 * turn - 1.0)
    readings = np.stack([v, 2.5e6 * 1e-9 * np.where(turn < 0.5, 2.0, -2.0)], axis=1)
    return readings + np.random.default_rng(1).normal(0.0, 1e-3, readings.shape)


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of, recorded on the twin."""
    folder = tmp_path_factory.mktemp("records")
    rig = make_twin(TwinConfig(), seed=1)
    rig.generator.sine(2000.0, 0.02)
    rig.source.write(1.0)
    blocks = [rig.acquisition.read() for _ in range(12)]
    rig.safe()
    volts = np.concatenate(blocks) * rig.description.volt_per_code
    np.save(folder / "monitors.npy", volts)
    head = "v_monitor_v,i_monitor_v"
    np.savetxt(folder / "monitors.csv", volts, "%.6f", ",", header=head, comments="")
    np.savetxt(folder / "drive.csv", _drive(), "%.6f", ",", header=head, comments="")
    header = {"rig": asdict(rig.description), "study": {"sensing": {"carrier_hz": 2000.0}}}
    plans = [ExperimentPlan("triangle", "play", 1, {})]
    size = rig.description.block_samples
    with SessionWriter(folder / "session.h5", plans, size, header) as writer:
        for k, block in enumerate(blocks):
            writer.append_block("triangle", block, k * 0.01, 1.0, np.nan)
    return folder


def test_every_command_of_the_page_runs_in_its_order(
    records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(records)
    assert len(HOW_TO.commands) >= 8
    for line in HOW_TO.commands:
        HOW_TO.run(f"{line} --force" if "--out" in line else line)  # some name the same file


def test_the_table_of_columns_is_that_of_the_file(
    records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(records)
    HOW_TO.run(f"{HOW_TO.commands[0]} --force")
    header = (records / "capacitance.csv").read_text(encoding="utf-8").splitlines()[0]
    table = HOW_TO.text.partition("| column | what |")[2].partition("\n\n")[0]
    assert sorted(_first_cells(table)) == sorted(header.split(","))


def _first_cells(table: str) -> list[str]:
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    return [name for cell in rows for name in re.findall(r"`(\w+)`", cell)]


@pytest.mark.parametrize(("page", "code"), SNIPPETS, ids=[page.name for page, _ in SNIPPETS])
def test_the_python_of_a_page_runs(page: Page, code: str) -> None:
    page.execute(code)
