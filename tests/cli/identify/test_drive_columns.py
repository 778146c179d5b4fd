"""Columns of voltages that are not the drive: monitors, voltages at the actuator, other units."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import Plant

GAIN, ZERO_M, MASS_KG = 4000.0, 0.06, 0.25
RNG = np.random.default_rng(3)
ACTUATOR = (
    f'[actuator]\nkind = "planar-hasel"\n[actuator.geometry]\nzero_length_m = {ZERO_M}\n'
    "[drive]\nlow_v = 0.0\nhigh_v = 2.0\n"
)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow triangle and a random drive between two levels, with the law of a square."""
    monkeypatch.chdir(tmp_path)
    Path("A.toml").write_text(f"{ACTUATOR}gain_v_per_v = {GAIN:g}\n")
    Path("B.toml").write_text(ACTUATOR)
    triangle = 1.0 - np.abs(1.0 - 0.01 * (np.arange(800) % 200))
    write("triangle.csv", 2.0 * triangle, 0.025 * (2.0 * triangle) ** 2)
    u = 1.2 + 0.3 * np.repeat(RNG.choice([-1.0, 1.0], 60), 20)
    time_s = 0.01 * np.arange(u.size)
    motion = Plant(1.0, 20.0, 0.1, 0.0).simulate(u**2 - u[0] ** 2, 100.0, time_s)
    write("random.csv", u, 0.025 * (motion + u[0] ** 2))


def write(name: str, drive_v: np.ndarray, strain: np.ndarray) -> None:
    """Drive U, its monitor M of 1 V/kV, the voltage H at the actuator in kV, and the strain x."""
    noise = 1e-3 * RNG.standard_normal((2, drive_v.size))
    high_kv = 1e-3 * GAIN * drive_v
    rows = np.column_stack(
        [0.01 * np.arange(drive_v.size), drive_v, high_kv + 4e-3 + noise[0], high_kv,
         strain + 0.01 * noise[1]]
    )  # fmt: skip
    header = "t,U [V],M [V],H [kV],x"
    np.savetxt(name, rows, "%.9g", ",", header=header, comments="")


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as stop:
        main(["identify", *words])
    return int(str(stop.value.code))


def voltage_map(column: str, *options: str, file: str = "A.toml") -> int:
    return run("voltage-map", "triangle.csv", "--strain", "x", "--voltage", column, "--actuator",
               file, *options)  # fmt: skip


def transfer(column: str, *options: str) -> int:
    return run("transfer", "random.csv", "--input", column, "--output", "x", "--actuator",
               "A.toml", *options)  # fmt: skip


def section(name: str) -> dict[str, object]:
    found: dict[str, object] = tomllib.loads(Path("A.toml").read_text())
    for part in name.split("."):
        found = found[part]  # type: ignore[assignment]
    return found


@pytest.mark.parametrize("column", ["M", "H"])
@pytest.mark.parametrize("command", [voltage_map, transfer])
def test_a_voltage_beyond_the_limits_of_the_drive_is_refused(
    capsys: pytest.CaptureFixture[str], column: str, command: object
) -> None:
    before = Path("A.toml").read_text()
    assert command(column) == 2  # type: ignore[operator]
    said = capsys.readouterr()
    line = said.err.splitlines()[-1]
    assert said.out == "" and f"Column {column} is from" in line and "permit 0 to 2 V" in line
    assert "--volt-per-monitor-volt" in line and ".csv" in line
    assert Path("A.toml").read_text() == before


@pytest.mark.parametrize(("column", "scale"), [("M", "1000"), ("H", "1")])
def test_the_scale_of_a_monitor_gives_the_map_and_the_model_of_the_drive(
    capsys: pytest.CaptureFixture[str], column: str, scale: str
) -> None:
    """The noise of the monitor is 1 mV of 8 V."""
    found = {}
    for name, options in (("U", ()), (column, ("--volt-per-monitor-volt", scale))):
        assert voltage_map(name, *options) == 0
        assert transfer(name, "--through-voltage-map", *options) == 0
        found[name] = (*section("drive.voltage_map").values(), section("model")["gain"])
    assert found[column] == pytest.approx(found["U"], rel=0.01, abs=1e-3)
    assert f"drive = {column} * {scale} / 4000" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main(["compare", "A.toml", "random.csv", "--input", column, "--output", "x",
              "--through-voltage-map"])  # fmt: skip
    assert stop.value.code == 2
    with pytest.raises(SystemExit) as stop:
        main(["compare", "A.toml", "random.csv", "--input", column, "--output", "x",
              "--through-voltage-map", "--volt-per-monitor-volt", scale])  # fmt: skip
    # It recognises the record of the fit, so the units are those of the model.
    assert stop.value.code == 3 and "used for the fit" in capsys.readouterr().err


def test_noise_an_offset_and_spikes_are_no_other_unit(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table = np.loadtxt("triangle.csv", delimiter=",", skiprows=1)
    table[:, 1] += 0.03 + 0.02 * RNG.standard_normal(len(table))
    table[[100, 500], 1] = 9.0
    np.savetxt("triangle.csv", table, "%.9g", ",", header="t,U,M,H,x", comments="")
    assert voltage_map("U") == 0
    table[:, 1] = np.linspace(0.0, 2.4, len(table))
    np.savetxt("triangle.csv", table, "%.9g", ",", header="t,U,M,H,x", comments="")
    assert voltage_map("U") == 2
    assert "is from 0 to 2.4 V" in capsys.readouterr().err


def test_an_input_that_is_no_voltage_is_not_compared(capsys: pytest.CaptureFixture[str]) -> None:
    table = np.loadtxt("random.csv", delimiter=",", skiprows=1)
    table[:, 1] *= 100.0
    np.savetxt("random.csv", table, "%.9g", ",", header="t,U [%],M,H,x", comments="")
    assert transfer("U") == 0
    assert transfer("U", "--volt-per-monitor-volt", "1000") == 2
    assert "--volt-per-monitor-volt is for a monitor in V, but column U" in capsys.readouterr().err


def test_a_scale_needs_the_gain_of_the_amplifier(capsys: pytest.CaptureFixture[str]) -> None:
    scale = ("--volt-per-monitor-volt", "1000")
    assert voltage_map("M", *scale, file="B.toml") == 2
    assert "State gain_v_per_v in [drive]" in capsys.readouterr().err
    assert run("transfer", "random.csv", "--input", "M", "--output", "x", *scale) == 2
    assert "Name the file with --actuator" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        main(["compare", "A.toml", "random.csv", "--input", "M", "--output", "x", *scale])
    assert stop.value.code == 2 and "needs --through-voltage-map" in capsys.readouterr().err


def test_the_physical_model_states_the_scale_as_its_gain(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("actuator", "random.csv", "--output", "x", "--mass-kg", f"{MASS_KG}", "--actuator",
             "A.toml", "--input", "M")  # fmt: skip
    assert run(*words) == 2
    assert "state --gain-v-per-v S" in capsys.readouterr().err
