"""What the page on recordings shows is run here as it stands."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.store.columns.table import read_table
from haselab.store.manifest import Manifest
from haselab.store.session.writer import ExperimentPlan, SessionWriter

PAGE = Path(__file__).resolve().parents[3] / "docs" / "study" / "session.md"
TEXT = PAGE.read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
ALL = re.findall(r"^    haselab ((?:.*\\\n)*.*)", TEXT, re.MULTILINE)
# tests/cli/data/test_session_command.py imports a record with a strain
FOREIGN = ("record.csv", "imported/session.h5", "--strain-file imported")
COMMANDS = [one for one in ALL if not any(part in one for part in FOREIGN)]
VOLT, CARRIER_HZ = 3.0517578125e-4, 2000.0
HEADER = {
    "rig": {"rate_hz": 200e3, "volt_per_code": VOLT, "v_monitor_v_per_v": 2e-4,
            "i_monitor_v_per_a": 500.0, "skew_s": 0.0, "switch_sample": 0, "block_samples": 2000,
            "scale_m_per_px": 2e-4},
    "study": {"sensing": {"carrier_hz": CARRIER_HZ}},
}  # fmt: skip


def monitors(blocks: int) -> np.ndarray:
    """Codes of a series R-C of 1.2 nF and 8 kOhm, shape `(blocks, 2000, 2)`."""
    turn = np.exp(2j * np.pi * CARRIER_HZ * np.arange(2000 * blocks) / 200e3)
    z_ohm = 8e3 + 1.0 / (2j * np.pi * CARRIER_HZ * 1.2e-9)
    volts = np.stack([0.05 * turn, 0.05 * 5000.0 / 2e-3 / z_ohm * turn], axis=1).real
    volts += 3e-4 * np.random.default_rng(7).standard_normal(volts.shape)
    return np.rint(volts / VOLT).astype(np.int16).reshape(blocks, 2000, 2)


@pytest.fixture(autouse=True)
def reference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run where the page has one; `DIR` is another name of it."""
    monkeypatch.chdir(tmp_path)
    folder = Path("out/reference")
    plans = [
        ExperimentPlan("triangle", "triangle", 1, {}), ExperimentPlan("pid-1", "steps", 6, {})
    ]  # fmt: skip
    with (
        Manifest(folder, {}),
        SessionWriter(folder / "session.h5", plans, 2000, HEADER) as session,
    ):
        for k, block in enumerate(monitors(30)):
            session.append_block("triangle", block, 125.0 + 0.01 * k, 1.0, float("nan"))
        tracks = np.zeros((5, 6), SessionWriter.track_dtype())
        tracks["y_px"][:, 3:], tracks["valid"] = 103.0, True
        session.append_block("pid-1", monitors(1)[0], 130.0, 1.0, 0.03)
        session.append_frames("pid-1", 130.0 + 0.01 * np.arange(5), tracks, 0.0)
    (folder / "actuator.toml").write_text("[actuator.geometry]\nzero_length_m = 0.02\n")
    Path("DIR").symlink_to(folder)


def test_the_page_has_what_is_run_here() -> None:
    assert (len(PYTHON), len(COMMANDS), len(ALL)) == (5, 5, 8)


@pytest.mark.parametrize("code", PYTHON, ids=["load", "plot", "frames", "follow", "xarray"])
def test_each_piece_of_python_runs(code: str) -> None:
    if "xarray" in code:
        pytest.importorskip("xarray")
        pytest.importorskip("h5netcdf")
    if "tables" in code:
        pytest.importorskip("pandas")
    names: dict[str, Any] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    if "axes" in names:
        strain, reference = (line.get_ydata() for line in names["axes"].lines)
        np.testing.assert_allclose(strain, 0.03)  # 103 px of 0.2 mm over 20 mm
        assert list(reference) == [0.03] and Path("loop.svg").stat().st_size > 0


def test_the_commands_run_in_their_order(capsys: pytest.CaptureFixture[str]) -> None:
    for command in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            main(shlex.split(command.replace("\\\n", " ")))
        assert not ended.value.code, capsys.readouterr().err
    assert Path("again/session.h5").is_file()
    assert Path("triangle/triangle-capacitance.csv").is_file()
    sensed = read_table(Path("capacitance.csv"), ["capacitance_f"])["capacitance_f"]
    assert np.median(sensed) == pytest.approx(1.2e-9, rel=1e-3)
