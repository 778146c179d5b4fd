"""Every command and every piece of Python on the pages about self-sensing runs as it stands."""

import re
import shlex
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import cli
from haselab.rig.twin.bench import make_twin
from haselab.rig.twin.config import TwinConfig
from haselab.store.session.writer import ExperimentPlan, SessionWriter

DOCS = Path(__file__).resolve().parents[2] / "docs"
NAMES = ("sensing.md", "how-self-sensing-works.md")
HOW_TO = (DOCS / NAMES[0]).read_text(encoding="utf-8")


def _blocks(page: str, language: str) -> list[str]:
    """Fenced blocks of a language; none for commands."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    return [code for name, code in found if name == language]


COMMANDS = [line for block in _blocks(NAMES[0], "") for line in block.splitlines()]
SNIPPETS = [(name, code) for name in NAMES for code in _blocks(name, "python")]


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
    assert len(COMMANDS) >= 8
    for line in COMMANDS:
        program, *arguments = shlex.split(line)
        assert program == "haselab", line
        if "--out" in arguments:  # both pages name the same file
            (records / arguments[arguments.index("--out") + 1]).unlink(missing_ok=True)
        cli.main(arguments, standalone_mode=False)
        if "--out" in arguments:
            assert (records / arguments[arguments.index("--out") + 1]).stat().st_size > 0, line


def test_the_table_of_columns_is_that_of_the_file(
    records: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(records)
    cli.main([*shlex.split(COMMANDS[0])[1:], "--force"], standalone_mode=False)
    header = (records / "capacitance.csv").read_text(encoding="utf-8").splitlines()[0]
    table = HOW_TO.partition("| column | what |")[2].partition("\n\n")[0]
    assert sorted(_first_cells(table)) == sorted(header.split(","))


def _first_cells(table: str) -> list[str]:
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    return [name for cell in rows for name in re.findall(r"`(\w+)`", cell)]


@pytest.mark.parametrize(("page", "code"), SNIPPETS, ids=[name for name, _ in SNIPPETS])
def test_the_python_of_a_page_runs(page: str, code: str) -> None:
    exec(compile(code, page, "exec"), {})
