"""Slow modes of a model that is written to an actuator file."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import Plant, SlowMode

RATE_HZ = 100.0
GAIN, TAU_S = 0.10, 4.0  # creep: 10 % of the fast motion
# The exact law of the actuator is a square, which two exponentials follow to within 10 % of slope.
SQUARE = 0.025
MAP = "a1_v = 1.0747, b1 = 6.1557, a2_v = -1.0417, b2 = -52.06"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("A.toml").write_text(
        f"[drive]\nlow_v = 0.0\nhigh_v = 2.0\nvoltage_map = {{{MAP}, strain_low = -0.03, "
        "strain_high = 0.13}\n"
    )
    rest, step = np.full(500, 0.7), np.full(1500, 1.0)
    time_s = np.arange(2000) / RATE_HZ
    sweep = np.log(100.0)
    chirp = 1.0 + 0.5 * np.sin(
        2.0 * np.pi * 0.1 * 20.0 / sweep * (np.exp(sweep * time_s / 20.0) - 1)
    )
    write("recipe.csv", np.concatenate([rest, step, chirp]))
    write("fast.csv", 1.0 + 0.02 * np.sin(0.3 * np.arange(200)) * np.sin(0.02 * np.arange(200)))


def write(name: str, drive_v: np.ndarray) -> None:
    """Drive and strain of an actuator that rested under its first drive."""
    plant = Plant(1.0, 25.0, 0.2, 0.0, (SlowMode(GAIN, TAU_S),))
    rest = SQUARE * drive_v[0] ** 2
    time_s = np.arange(drive_v.size) / RATE_HZ
    strain = plant.simulate(SQUARE * drive_v**2 - rest, RATE_HZ, time_s) + rest * (1.0 + GAIN)
    strain += 1e-5 * np.random.default_rng(2).standard_normal(strain.size)
    rows = np.column_stack([time_s, drive_v, SQUARE * drive_v**2, strain])
    np.savetxt(name, rows, "%.9g", ",", header="t,U [V],exact_strain,strain", comments="")


def transfer(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        main(["identify", "transfer", *words, "--output", "strain", "--slow-modes", "1"])
    return int(str(stop.value.code))


def test_the_recorded_step_determines_the_slow_mode(capsys: pytest.CaptureFixture[str]) -> None:
    """The recipe of docs/your-actuator.md: rest, step, 15 s, chirp; here through the exact law."""
    assert transfer("recipe.csv", "--input", "exact_strain", "--actuator", "A.toml") == 0
    mode = tomllib.loads(Path("A.toml").read_text())["model"]["slow_modes"][0]
    assert mode["gain"] == pytest.approx(GAIN, rel=0.01)
    assert mode["time_constant_s"] == pytest.approx(TAU_S, rel=0.01)
    assert "voltage map is not exact" not in capsys.readouterr().out


def test_a_voltage_map_with_another_slope_is_noted_and_the_advice_works(
    capsys: pytest.CaptureFixture[str],
) -> None:
    code = transfer("recipe.csv", "--input", "U", "--through-voltage-map", "--actuator", "A.toml")
    said = capsys.readouterr()
    assert "the voltage map is not exact" in " ".join(said.out.split())
    assert ("status                           ok" in said.out) == (code == 0)
    assert transfer("recipe.csv", "--input", "U", "--nonlinear", "hammerstein-2", "--out",
                    "h.json") == 0  # fmt: skip
    fit = json.loads(Path("h.json").read_text())
    slow = fit["slow_modes"][0]
    ratio = slow["gain"]["value"] / fit["gain"]["value"]
    assert ratio == pytest.approx(GAIN, rel=0.01)
    assert slow["time_constant_s"]["value"] == pytest.approx(TAU_S, rel=0.01)


def test_without_a_slow_mode_status_code_and_message_agree(
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = Path("A.toml").read_text()
    words = ("fast.csv", "--input", "exact_strain", "--actuator", "A.toml")
    assert transfer(*words) == 3
    said = capsys.readouterr()
    line = said.err.splitlines()[-1]
    assert "[model] was not written: slow" in line and "a step that is held" in line
    assert "fast.csv" in line and "Plant" not in line
    status = next(row for row in said.out.splitlines() if row.startswith("status"))
    assert "[model] was not written" in status
    assert Path("A.toml").read_text() == before
