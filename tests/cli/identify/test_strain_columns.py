"""Strains in another file than the capacitances: units, displacements and lengths."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import Plant

ZERO_M, SLOPE_PER_F = 0.06, 8e8
RNG = np.random.default_rng(1)
TIME_S = 0.002 * np.arange(4000)
STRAIN = 0.1 - 0.1 * np.cos(2.0 * np.pi * 0.25 * TIME_S)
ACTUATOR = f'[actuator]\nkind = "planar-hasel"\n[actuator.geometry]\nzero_length_m = {ZERO_M}\n'


@pytest.fixture
def capacitance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("A.toml").write_text(ACTUATOR)
    Path("B.toml").write_text(ACTUATOR + "sensor_zero_m = 0.11\n")
    farad = 5e-10 + STRAIN / SLOPE_PER_F + 1e-14 * RNG.standard_normal(STRAIN.size)
    rows = np.column_stack([TIME_S[::5], farad[::5]])
    np.savetxt("C.csv", rows, "%.9g", ",", header="time_s,capacitance_f", comments="")
    return Path("C.csv")


def strain_file(header: str, time_scale: float, values: np.ndarray) -> Path:
    rows = np.column_stack([time_scale * TIME_S, values])
    np.savetxt("S.csv", rows, "%.9g", ";", header=header, comments="")
    return Path("S.csv")


def fitted(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, str, str]:
    words = ["identify", "capacitance-map", "C.csv", "--strain-file", "S.csv", *options]
    with pytest.raises(SystemExit) as stop:
        main(words)
    printed = capsys.readouterr()
    return int(str(stop.value.code)), printed.out, printed.err


def slope(printed: str) -> float:
    """Slope of the line; with --actuator, that of the comparison below the map."""
    found = re.search(r"^(?:slope|line, not written) +(\S+)", printed, flags=re.MULTILINE)
    assert found is not None
    return float(found[1])


@pytest.mark.parametrize(
    ("header", "time_scale", "scale", "offset", "options", "said"),
    [
        ("t;x", 1.0, 1.0, 0.0, ("--strain", "x"), ""),
        ("Zeit [ms];x", 1e3, 100.0, 0.0, ("--strain", "x", "--unit", "x=%"), "from % to"),
        ("Zeit;x", 1e3, 1.0, 0.0, ("--strain", "x", "--unit", "Zeit=ms"), ""),
        ("clock;x", 1e3, 1.0, 0.0,
         ("--strain", "x", "--time", "clock", "--unit", "clock=ms"), ""),
        ("t;Laser [mm]", 1.0, 1e3 * ZERO_M, 0.0,
         ("--strain", "Laser", "--actuator", "A.toml"), "strain = displacement / zero_length_m"),
        ("t;Laser [mm]", 1.0, 1e3 * ZERO_M, 1e3 * ZERO_M,
         ("--strain", "Laser", "--actuator", "A.toml"), "strain = length / zero_length_m - 1"),
        ("t;x", 1.0, -1.0, 0.0, ("--strain", "-x"), ""),
        ("t;Laser [mm]", 1.0, -1e3 * ZERO_M, 0.0,
         ("--strain", "-Laser", "--actuator", "A.toml"), "strain = displacement / zero_length_m"),
        ("t;Laser [mm]", 1.0, -1e3 * ZERO_M, 50.0,  # the distance to a laser 110 mm below the top
         ("--strain", "-Laser", "--actuator", "B.toml"), "strain = (displacement + 0.11 m) /"),
    ],
)  # fmt: skip
def test_the_slope_is_that_of_the_strain(
    capacitance: Path, capsys: pytest.CaptureFixture[str], header: str, time_scale: float,
    scale: float, offset: float, options: tuple[str, ...], said: str,
) -> None:  # fmt: skip
    """Within 1 %: the noise of the capacitance is 4e-5 of its span."""
    strain_file(header, time_scale, offset + scale * STRAIN)
    code, out, err = fitted(capsys, *options)
    assert code == 0 and said in err
    assert slope(out) == pytest.approx(SLOPE_PER_F, rel=0.01)


@pytest.mark.parametrize(
    ("header", "time_scale", "values", "options", "said"),
    [
        ("Zeit;x", 1e3, STRAIN, ("--strain", "x"), "in milliseconds 500. State which"),
        ("t;x", 1.0, STRAIN, ("--strain", "x", "--unit", "y=%"),
         "y=% names no column of the files: C.csv has time_s, capacitance_f; S.csv has t, x"),
        ("t;x", 1.0, STRAIN, ("--strain", "x", "--time", "u"), "--time u names no column of the"),
        ("t;x [mm]", 1.0, 60.0 * STRAIN, ("--strain", "x"), "State this length as zero_length_m"),
        ("t;x [mm]", 1.0, 60.0 * STRAIN + 25.0, ("--strain", "x", "--actuator", "A.toml"),
         "its values are neither displacements nor lengths"),
        ("t;x", 1.0, 60.0 * STRAIN, ("--strain", "x"), "'x=mm' if it is a displacement"),
        ("t;x [V]", 1.0, STRAIN, ("--strain", "x"), "is in V, but --strain needs the strain"),
        ("t;x [mm]", 1.0, 50.0 - 60.0 * STRAIN, ("--strain", "-x", "--actuator", "A.toml"),
         "state the length at which it reads 0 as sensor_zero_m in [actuator.geometry]"),
    ],
)  # fmt: skip
def test_a_column_that_is_not_a_strain_is_refused_in_one_line(
    capacitance: Path, capsys: pytest.CaptureFixture[str], header: str, time_scale: float,
    values: np.ndarray, options: tuple[str, ...], said: str,
) -> None:  # fmt: skip
    strain_file(header, time_scale, values)
    before = Path("A.toml").read_text()
    code, out, err = fitted(capsys, *options)
    assert code == 2 and out == "" and said in err.splitlines()[-1]
    assert "S.csv" in err.splitlines()[-1] and "{" not in err
    assert Path("A.toml").read_text() == before


def test_a_capacitance_with_the_other_sign_is_refused(
    capacitance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strain_file("t;x", 1.0, STRAIN)
    code, out, err = fitted(capsys, "--strain", "x", "--capacitance", "-capacitance_f")
    assert (code, out) == (2, "") and "its values cannot be negative" in err.splitlines()[-1]


def test_a_voltage_map_takes_displacements_too(
    capacitance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volt = np.sqrt(STRAIN / 0.06)
    for name, values in (("D.csv", 1e3 * ZERO_M * STRAIN), ("E.csv", STRAIN)):
        unit = " [mm]" if name == "D.csv" else ""
        np.savetxt(name, np.column_stack([volt, values]), "%.9g", ",", header=f"U,x{unit}",
                   comments="")  # fmt: skip
    found = []
    for name in ("D.csv", "E.csv"):
        with pytest.raises(SystemExit) as stop:
            main(["identify", "voltage-map", name, "--voltage", "U", "--strain", "x", "--actuator",
                  "A.toml"])  # fmt: skip
        assert stop.value.code == 0
        lines = capsys.readouterr().out.splitlines()
        # The accuracy of the map comes first, then the coefficients.
        assert [line.split()[0] for line in lines[:2]] == ["residual_std_v", "hysteresis_width"]
        assert lines[1].endswith(" V")
        found.append([line.split()[1] for line in lines if line[:2] in ("a1", "b1", "a2", "b2")])
    assert found[0] == found[1] and found[0]


def test_through_the_voltage_map_a_displacement_has_the_model_of_its_strain(
    capacitance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The static law of the map, then a resonance at 20 rad/s; noise of 1e-4 of the strain."""
    volt = np.sqrt(STRAIN / 0.06)
    np.savetxt("U.csv", np.column_stack([volt, STRAIN]), "%.9g", ",", header="U,x", comments="")
    main_ok("identify", "voltage-map", "U.csv", "--voltage", "U", "--strain", "x", "--actuator",
            "A.toml")  # fmt: skip
    capsys.readouterr()
    u = 1.2 + 0.3 * np.repeat(RNG.choice([-1.0, 1.0], 100), 20)
    time_s = 0.01 * np.arange(u.size)
    strain = 0.06 * Plant(1.0, 20.0, 0.1, 0.0).simulate(u**2 - u[0] ** 2, 100.0, time_s)
    strain += 1e-4 * RNG.standard_normal(u.size)
    gains = []
    for unit, scale in (("1", 1.0), ("mm", 1e3 * ZERO_M)):
        np.savetxt("R.csv", np.column_stack([time_s, u, scale * strain]), "%.9g", ",",
                   header=f"time_s,U,x [{unit}]", comments="")  # fmt: skip
        main_ok("identify", "transfer", "R.csv", "--input", "U", "--output", "x",
                "--through-voltage-map", "--actuator", "A.toml", "--json", "--force")  # fmt: skip
        answer = json.loads(capsys.readouterr().out)
        assert (answer["input"], answer["output"]) == ("strain", "strain")
        gains.append(answer["gain"]["value"])
    assert gains[0] == pytest.approx(gains[1], rel=1e-6)
    # Without a unit: refused if it cannot be a strain, and a warning if the gain is far from 1.
    for scale, code, said in (
        (1e3 * ZERO_M, 2, "Column x reaches"),
        (ZERO_M, 0, "the static gain is 0.05"),
        (1.0, 0, ""),
    ):
        np.savetxt("R.csv", np.column_stack([time_s, u, scale * strain]), "%.9g", ",",
                   header="time_s,U,x", comments="")  # fmt: skip
        with pytest.raises(SystemExit) as stop:
            main(["identify", "transfer", "R.csv", "--input", "U", "--output", "x",
                  "--through-voltage-map", "--actuator", "A.toml", "--force"])  # fmt: skip
        printed = capsys.readouterr()
        assert stop.value.code == code and said in printed.err
        assert said or "static gain" not in printed.err


def main_ok(*words: str) -> None:
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    assert stop.value.code == 0


def test_a_sensor_may_read_zero_at_another_length_than_strain_0(
    capacitance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A laser that was set to zero at 0 V, where the length is 0.058 m."""
    Path("A.toml").write_text(ACTUATOR + "sensor_zero_m = 0.058\n")
    strain_file("t;Laser [mm]", 1.0, 1e3 * (ZERO_M * (1.0 + STRAIN) - 0.058))
    code, out, err = fitted(capsys, "--strain", "Laser", "--actuator", "A.toml", "--json")
    assert code == 0 and "strain = (displacement + 0.058 m) / zero_length_m - 1" in err
    found = json.loads(out)
    assert found["slope"]["value"] == pytest.approx(SLOPE_PER_F, rel=0.01)
    assert found["offset"]["value"] == pytest.approx(-5e-10 * SLOPE_PER_F, rel=0.01)


@pytest.mark.parametrize(
    ("kind", "sign", "noted"),
    [("planar-hasel", -1.0, True), ("planar-hasel", 1.0, False), ("peano-hasel", -1.0, False)],
)
def test_a_planar_hasel_that_seems_to_become_shorter_is_noted(
    capacitance: Path, capsys: pytest.CaptureFixture[str], kind: str, sign: float, noted: bool
) -> None:
    Path("A.toml").write_text(ACTUATOR.replace("planar-hasel", kind))
    strain_file("t;x", 1.0, sign * STRAIN)
    code, out, _ = fitted(capsys, "--strain", "x", "--actuator", "A.toml")
    assert code == 0 and slope(out) == pytest.approx(sign * SLOPE_PER_F, rel=0.01)
    assert ("The strain falls as the capacitance rises" in out) == noted


def test_noise_of_the_capacitance_is_no_part_that_the_map_does_not_follow(
    capacitance: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strain_file("t;x", 1.0, STRAIN)
    noise = np.random.default_rng(7).standard_normal(STRAIN.size)
    farad = 5e-10 + STRAIN / SLOPE_PER_F + 8e-12 * noise
    rows = np.column_stack([TIME_S[::5], farad[::5]])
    np.savetxt(capacitance, rows, "%.9g", ",", header="time_s,capacitance_f", comments="")
    code, _, err = fitted(capsys, "--strain", "x", "--actuator", "A.toml")
    assert code == 0
    assert "the strain hardly changes: noise of the capacitance" in err
    assert "hardly changes with the capacitance" not in err
