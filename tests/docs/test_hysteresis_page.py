"""Every command and the Python of the page about hysteresis and creep run as they stand."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import cli
from haselab.models import PrandtlIshlinskii, PronyCreep
from haselab.signals import triangle

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hysteresis-and-creep.md"
BLOCKS = re.findall(
    r"^```(\w*)\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE
)
COMMANDS = [line for name, block in BLOCKS if name == "" for line in block.splitlines()]


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
    assert len(COMMANDS) >= 7
    for line in COMMANDS:
        program, *arguments = shlex.split(line)
        assert program == "haselab"
        cli.main(arguments, standalone_mode=False)
        told = capsys.readouterr().out
        assert re.search(r"^status +ok$", told, flags=re.MULTILINE), line
        if "--out" in arguments:
            assert (records / arguments[arguments.index("--out") + 1]).stat().st_size > 0


@pytest.mark.parametrize("code", [block for name, block in BLOCKS if name == "python"])
def test_the_python_of_the_page_runs(code: str) -> None:
    exec(compile(code, PAGE.name, "exec"), {})
