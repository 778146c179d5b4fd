"""Files as other programs write them: LabVIEW, Excel, PicoScope, Tektronix, and people.

Each file of the board holds the same record, a series R-C at 2 kHz, in its own layout, units and
encoding. The oracle is the record itself: what is read is compared with it in SI units.
"""

from __future__ import annotations

import codecs
import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.cli.main import main
from haselab.models import Plant, VoltageMap
from haselab.signals import triangle
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import read_table

RATE_HZ, CARRIER_HZ = 50e3, 2000.0
CAPACITANCE_F, RESISTANCE_OHM = 1.2e-9, 8e3
ROWS = 5000
TIME_S = np.arange(ROWS) / RATE_HZ


def monitors() -> tuple[np.ndarray, np.ndarray]:
    """Both monitors in V, at 5000 V/V and 2 mA/V."""
    turn = np.exp(2j * np.pi * CARRIER_HZ * TIME_S)
    z_ohm = RESISTANCE_OHM + 1.0 / (2j * np.pi * CARRIER_HZ * CAPACITANCE_F)
    noise = 1e-4 * np.random.default_rng(3).standard_normal((2, ROWS))
    return (0.05 * turn).real + noise[0], (0.05 * 5000.0 / 2e-3 / z_ohm * turn).real + noise[1]


V, I = monitors()  # noqa: E741 -- the field's own letter


def rows(
    *columns: np.ndarray, sep: str = ",", comma: bool = False, form: str = "%.9g", tail: str = "",
    newline: str = "\n",
) -> str:  # fmt: skip
    lines = []
    for row in zip(*columns, strict=True):
        cells = [form % value for value in row]
        cells = [cell.replace(".", ",") for cell in cells] if comma else cells
        lines.append(sep.join(cells) + tail)
    return newline.join(lines) + newline


@dataclass(frozen=True)
class Foreign:
    """A file of the board: its bytes, and how a user names its columns."""

    name: str
    content: bytes
    v: str
    i: str
    options: ColumnOptions = field(default_factory=ColumnOptions)
    rate_hz: float | None = None

    def arguments(self) -> list[str]:
        """The options of the command line."""
        words = ["--v", self.v, "--i", self.i]
        words += ["--time", self.options.time] if self.options.time else []
        for column, unit in self.options.units.items():
            words += ["--unit", f"{column}={unit}"]
        return words + (["--rate-hz", repr(self.rate_hz)] if self.rate_hz else [])


def board() -> list[Foreign]:
    de = {"sep": ";", "comma": True}
    excel = "Zeit [ms];Spannung [V];Strom [V];Kapazität [pF];\r\n" + rows(
        1e3 * TIME_S, V, I, 0 * V + 5.0, tail=";", newline="\r\n", **de
    )
    preamble = "Messung: Aktor 7\nDatum;23.11.2026\nBediener;Jörg Müller\n\n"
    picoscope = "Time,Channel A,Channel B\n(ms),(mV),(mV)\n\n" + rows(
        1e3 * TIME_S, 1e3 * V, 1e3 * I
    )
    tektronix = (
        "Model,MSO54\nFirmware Version,1.28\n,\nWaveform Type,ANALOG,\nPoint Format,Y,\n"
        "Horizontal Units,s,\nSample Interval,2e-05,\nRecord Length,5000,\n,,\nTIME,CH1,CH2\n"
        + rows(TIME_S, V, I)
    )
    labview = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\n"
        "Decimal_Separator\t,\nMulti_Headings\tYes\nX_Columns\tOne\nDate\t2026/11/23\n"
        "***End_of_Header***\t\t\t\nChannels\t2\t\t\nSamples\t5000\t5000\t\n"
        "Y_Unit_Label\tVolts\tVolts\t\nX_Dimension\tTime\tTime\t\nDelta_X\t2E-5\t2E-5\t\n"
        "***End_of_Header***\t\t\t\nX_Value\tDev1_ai0\tDev1_ai1\tComment\n"
        + rows(TIME_S, V, I, sep="\t", comma=True)
    )
    stamps = "\n".join(
        f"23.11.2026 10:00:{t:09.6f};{v:.9f};{i:.9f}".replace(".", ",").replace("23,11,", "23.11.")
        for t, v, i in zip(TIME_S, V, I, strict=True)
    )
    quoted = '"Time (µs)","Monitor voltage, amplifier (mV)","Monitor ""I"" (mV)"\n' + rows(
        1e6 * TIME_S, 1e3 * V, 1e3 * I
    )
    quoted_cells = '"t","u","i"\n' + "".join(
        f'"{t:.9g}","{v:.9g}","{i:.9g}"\n'.replace(".", ",")
        for t, v, i in zip(TIME_S, V, I, strict=True)
    )
    units_row = "Zeit\tU\tI\nms\tmV\tmV\n" + rows(1e3 * TIME_S, 1e3 * V, 1e3 * I, sep="\t")
    spaces = "  Time(s)   Ch 1 (V)   Ch 2 (V)\n" + rows(TIME_S, V, I, sep="   ")
    wide = (
        ",".join(["t_s", "v", "i", *[""] * 3000])
        + "\n"
        + rows(TIME_S[:400], V[:400], I[:400], tail=",1" * 3000)
    )
    twice = "Zeit (s);U;U\n" + rows(TIME_S, V, I, **de)
    bare = rows(TIME_S, V, I, sep="\t")
    saved = "# time_s u i\n" + rows(TIME_S, V, I, sep=" ")
    stroke = "t / ms;U / mV;I / mV\n" + rows(1e3 * TIME_S, 1e3 * V, 1e3 * I, **de)
    actuator = "t in ms;U (kV);I (µA)\n" + rows(1e3 * TIME_S, 5.0 * V, 2e3 * I, **de)
    old_tek = "".join(
        f"{first},{t:.9g},{v:.9g},{i:.9g},\n" for first, t, v, i in zip(
            ["Record Length,5e3,", "Sample Interval,2e-5,", "Source,CH1,", *[",,"] * (ROWS - 3)],
            TIME_S, V, I, strict=True,
        )
    )  # fmt: skip
    mac = "Zeit [s]\tU [V]\tI [V]\r" + rows(TIME_S, V, I, sep="\t", newline="\r")
    hint = "sep=;\nZeit [s];U [V];I [V]\n" + rows(TIME_S, V, I, **de) + ";;\n;;\n\n\n"
    rigol = "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,0.000000,2e-05,\n"
    rigol += rows(np.arange(ROWS) * 1.0, V, I, tail=",,")
    suffix = "time_ms,u_mv,i_mv\n" + rows(1e3 * TIME_S, 1e3 * V, 1e3 * I)
    return [
        Foreign("excel-latin-1.csv", excel.encode("latin-1"), "Spannung [V]", "Strom"),
        Foreign("excel-utf-16.csv", codecs.BOM_UTF16_LE + excel.encode("utf-16-le"), "Spannung",
                "Strom [V]"),
        Foreign("excel-utf-8-bom.csv", codecs.BOM_UTF8 + excel.encode(), "2", "3"),
        Foreign("preamble.txt", (preamble + excel).encode("cp1252"), "Spannung", "Strom"),
        Foreign("picoscope.csv", picoscope.encode(), "Channel A", "Channel B"),
        Foreign("tektronix.csv", tektronix.encode(), "CH1", "CH2"),
        Foreign("tektronix-old.csv", old_tek.encode(), "5", "6", ColumnOptions("4")),
        Foreign("labview.lvm", labview.encode(), "Dev1_ai0", "Dev1_ai1"),
        Foreign("time-stamps.csv", f"Zeit;Monitor U;Monitor I\n{stamps}\n".encode(), "Monitor U",
                "Monitor I", rate_hz=RATE_HZ),
        Foreign("quoted-header.csv", quoted.encode(), "Monitor voltage, amplifier",
                'Monitor "I" (mV)'),
        Foreign("quoted-cells.csv", quoted_cells.encode(), "u", "i"),
        Foreign("units-row.tsv", units_row.encode(), "U", "I"),
        Foreign("spaces.dat", spaces.encode(), "Ch 1", "Ch 2 (V)"),
        Foreign("wide.csv", wide.encode(), "v", "i", ColumnOptions("t_s")),
        Foreign("twice.csv", twice.encode(), "2", "3"),
        Foreign("no-header.txt", bare.encode(), "2", "3", ColumnOptions("1")),
        Foreign("savetxt.txt", saved.encode(), "u", "i"),
        Foreign("stroke.csv", stroke.encode(), "U", "I"),
        Foreign("at-the-actuator.csv", actuator.encode("cp1252"), "U", "I"),
        Foreign("old-mac.txt", mac.encode(), "U", "I"),
        Foreign("separator-hint.csv", hint.encode(), "U", "I"),
        Foreign("endings.csv", suffix.encode(), "u_mv", "i"),
        Foreign("rigol.csv", rigol.encode(), "CH1", "CH2", rate_hz=RATE_HZ),
        Foreign("no-units.csv", ("dt;U;I\n" + rows(1e3 * TIME_S, 1e3 * V, 1e3 * I, **de)).encode(),
                "U", "I", ColumnOptions("dt", {"U": "mV", "I": "mV", "dt": "ms"})),
    ]  # fmt: skip


BOARD = board()
each_file = pytest.mark.parametrize("foreign", BOARD, ids=[each.name for each in BOARD])


def code_of(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def put(folder: Path, foreign: Foreign) -> Path:
    path = folder / foreign.name
    path.write_bytes(foreign.content)
    return path


@each_file
def test_the_columns_are_read_in_si_units(tmp_path, foreign):
    table = read_table(put(tmp_path, foreign), [foreign.v, foreign.i], foreign.options)
    v, i = table[foreign.v], table[foreign.i]
    scale = (5000.0, 2e-3) if foreign.name == "at-the-actuator.csv" else (1.0, 1.0)
    np.testing.assert_allclose(v, scale[0] * V[: v.size], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(i, scale[1] * I[: i.size], rtol=1e-8, atol=1e-9)
    if foreign.rate_hz is None:
        assert table.rate_hz == pytest.approx(RATE_HZ, rel=1e-6)


@each_file
def test_sense_finds_the_capacitance(tmp_path, capsys, foreign):
    out = tmp_path / "c.csv"
    assert code_of("sense", put(tmp_path, foreign), "--carrier-hz", CARRIER_HZ, "--block-s", 0.004,
                   *foreign.arguments(), "--out", out) == 0, capsys.readouterr().err  # fmt: skip
    sensed = read_table(out, ["capacitance_f", "resistance_ohm"])
    assert np.median(sensed["capacitance_f"]) == pytest.approx(CAPACITANCE_F, rel=2e-3)
    assert np.median(sensed["resistance_ohm"]) == pytest.approx(RESISTANCE_OHM, rel=0.05)


@each_file
def test_an_imported_session_is_sensed_and_exported_again(tmp_path, capsys, foreign):
    path, folder = put(tmp_path, foreign), tmp_path / "run"
    assert (
        code_of(
            "session",
            "import",
            path,
            *foreign.arguments(),
            "--block-samples",
            200,
            "--carrier-hz",
            CARRIER_HZ,
            "--out",
            folder,
        )
        == 0
    ), capsys.readouterr().err
    out = tmp_path / "c.csv"
    assert code_of("sense", folder / "session.h5", "--experiment", "imported", "--out", out) == 0
    sensed = read_table(out, ["capacitance_f"])
    assert np.median(sensed["capacitance_f"]) == pytest.approx(CAPACITANCE_F, rel=2e-3)
    tables = tmp_path / "tables"
    assert code_of("session", "export", folder, "--to", "csv", "--out", tables) == 0
    back = read_table(tables / "imported.csv", ["v_monitor_v", "i_monitor_v"])
    if foreign.name != "at-the-actuator.csv":
        atol = 0.6 * max(np.abs(V).max(), np.abs(I).max()) / 32767
        count = back["v_monitor_v"].size
        np.testing.assert_allclose(back["v_monitor_v"], V[:count], rtol=0.0, atol=atol)
        np.testing.assert_allclose(back["i_monitor_v"], I[:count], rtol=0.0, atol=atol)


# ---- the identify commands ----------------------------------------------------------------------

PLANT = Plant(0.5, 40.0, 0.09, 0.005)


def answer_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    code = code_of(*arguments, "--json")
    printed = capsys.readouterr()
    assert code == 0, printed.err
    return json.loads(printed.out)


def german(path: Path, header: str, *columns: np.ndarray) -> Path:
    text = "Prüfstand 3;;\n\n" + header + "\n" + rows(*columns, sep=";", comma=True, form="%.12g")
    path.write_bytes(text.encode("latin-1"))
    return path


def sweep(rate_hz: float = 400.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    time_s = np.arange(4000) / rate_hz
    u = np.sin(2 * np.pi * (0.5 * time_s + 0.8 * time_s**2))
    noise = 2e-3 * np.random.default_rng(1).normal(size=time_s.size)
    return time_s, u, PLANT.simulate(u, rate_hz, time_s) + noise


def close(estimate: object, truth: float) -> bool:
    assert isinstance(estimate, dict)
    return abs(estimate["value"] - truth) <= 4.0 * estimate["std"]


def test_transfer_of_foreign_units_has_its_gain_in_si(tmp_path, capsys):
    time_s, u, y = sweep()
    file = german(tmp_path / "a.csv", "Zeit [ms];Antrieb [kV];Weg [mm]", 1e3 * time_s, u, 1e3 * y)
    answer = answer_of(
        capsys, "identify", "transfer", file, "--input", "Antrieb", "--output", "Weg"
    )
    assert close(answer["natural_frequency_rad_s"], 40.0)
    assert close(answer["gain"], 0.5 / 1e3)  # m for each V


def play(u: np.ndarray, threshold: float) -> np.ndarray:
    """Output of a play operator: it follows the input once it has moved by the threshold."""
    found, last = np.empty_like(u), 0.0
    for k, value in enumerate(u):
        last = found[k] = min(max(last, value - threshold), value + threshold)
    return found


@pytest.mark.parametrize(
    "command", ["arx", "subspace --bootstrap 2", "frequency-response", "hysteresis", "creep"]
)
def test_commands_of_input_and_output_give_the_same_for_a_foreign_file(tmp_path, capsys, command):
    command = command.split()
    time_s, u, y = sweep()
    if command[0] == "hysteresis":
        # A loop of the model's own form, with noise: without, last digits decide on its structure.
        u = triangle(0.0, 1.0, 0.5, 5, 400.0)
        time_s, noise = np.arange(u.size) / 400.0, np.random.default_rng(3).normal(size=u.size)
        y = 0.5 * u + 0.2 * play(u, 0.1) + 0.3 * play(u, 0.3) + 1e-4 * noise
    if command[0] == "creep":
        u = np.ones(time_s.size)
        noise = 1e-4 * np.random.default_rng(2).normal(size=u.size)
        y = 1.0 + 0.2 * (1.0 - np.exp(-time_s / 2.0)) + noise
    plain = tmp_path / "plain.csv"
    plain.write_text("time_s,u,y\n" + rows(time_s, u, y, form="%.12g"))
    file = german(tmp_path / "a.csv", "Zeit [ms];U (mV);x [mm]", 1e3 * time_s, 1e3 * u, 1e3 * y)
    extra = ["--unit-step"] if command[0] == "creep" else []
    expected = answer_of(capsys, "identify", *command, plain, *extra)
    named = ["--output", "x"] if extra else ["--input", "U", "--output", "x"]
    found = answer_of(capsys, "identify", *command, file, *named, *extra)
    assert_same(expected, found)


# Deviations by draws from a covariance, whose roots the last digits may turn round, have draws of
# their own: of 100 draws, a deviation scatters by 7 %. The reduction is a ratio of deviations.
DRAWN = {"std": 0.3, "reduction": 0.3}


def assert_same(one: object, other: object, rel: float = 1e-2) -> None:
    """Equal answers, but for the last digits of numbers and the scatter of drawn deviations."""
    assert type(one) is type(other)
    if isinstance(one, dict) and isinstance(other, dict):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert_same(value, other[key], DRAWN.get(key, rel))
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b, rel)
    elif isinstance(one, float):
        assert other == pytest.approx(one, rel=rel, abs=1e-6)


def test_free_response_in_millimetres_and_milliseconds(tmp_path, capsys):
    time_s = np.arange(1500) / 500.0
    noise = 1e-6 * np.random.default_rng(2).normal(size=time_s.size)
    x_m = 2e-3 * np.exp(-1.5 * time_s) * np.cos(30.0 * time_s) + noise
    file = german(tmp_path / "a.csv", "Zeit [ms];Weg [mm]", 1e3 * time_s, 1e3 * x_m)
    answer = answer_of(capsys, "identify", "free-response", file, "--output", "Weg")
    assert close(answer["damped_frequency_rad_s"], 30.0)
    assert answer["amplitude"]["value"] == pytest.approx(2e-3, rel=0.01)


def test_static_laws_in_the_units_of_a_test_machine(tmp_path, capsys):
    stretch = np.linspace(1.05, 2.5, 120)
    noise = 1.0 + 1e-3 * np.random.default_rng(4).normal(size=stretch.size)
    stress_pa = 20e3 * (stretch - stretch**-2) * noise
    file = german(tmp_path / "a.csv", "Dehnung;Spannung [kPa];Kraft [mN]", stretch,
                  1e-3 * stress_pa, 1e3 * (0.5 * stretch - 0.4))  # fmt: skip
    columns = ("--stretch", "Dehnung")
    answer = answer_of(capsys, "identify", "hyperelastic", file, *columns, "--stress", "Spannung",
                       "--model", "neo-hooke")  # fmt: skip
    plain = tmp_path / "plain.csv"
    plain.write_text("stretch,nominal_stress_pa\n" + rows(stretch, stress_pa, form="%.15g"))
    expected = answer_of(capsys, "identify", "hyperelastic", plain, "--model", "neo-hooke")
    assert_same(expected, answer)
    regions = answer_of(capsys, "identify", "regions", file, *columns, "--load", "Kraft")
    assert regions["regions"][0]["slope_n"]["value"] == pytest.approx(0.5, rel=1e-6)


def test_maps_from_picofarads_per_cent_and_kilovolts(tmp_path, capsys):
    strain = 0.05 - 0.05 * np.cos(2 * np.pi * 0.25 * np.arange(1600) / 100.0)
    noise = np.random.default_rng(5).normal(size=(2, strain.size))
    capacitance_f = (strain + 0.2) / 1e9 + 1e-13 * noise[0]
    voltage_v = 1e3 * VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain) + noise[1]
    file = german(tmp_path / "a.csv", "Dehnung [%];C (pF);U / kV", 100.0 * strain,
                  1e12 * capacitance_f, 1e-3 * voltage_v)  # fmt: skip
    named = ("--strain", "Dehnung")
    answer = answer_of(capsys, "identify", "capacitance-map", file, *named, "--capacitance", "C")
    assert close(answer["slope"], 1e9)
    answer = answer_of(capsys, "identify", "voltage-map", file, *named, "--voltage", "U")
    assert answer["r_squared"] > 0.999
    assert answer["a1_v"]["value"] > 500.0  # volts, not kilovolts
    answer = answer_of(capsys, "identify", "map", file, "--x", "Dehnung", "--y", "C")
    assert answer["status"] == "ok"


def test_a_conversion_is_reported(tmp_path, capsys):
    time_s, u, y = sweep()
    file = german(tmp_path / "a.csv", "Zeit [ms];U;x [mm]", 1e3 * time_s, u, 1e3 * y)
    assert code_of("identify", "arx", file, "--input", "U", "--output", "x") == 0
    assert "column x was converted from mm to m" in capsys.readouterr().err


# ---- what cannot be decided ---------------------------------------------------------------------

REFUSED: dict[str, tuple[str, Sequence[str], str]] = {
    "comma twice": ("u,y\n1,5,2,5\n1,6,2,6\n1,7,2,7\n", (), "commas separate the columns and the"),
    "name twice": ("u;y;y\n1;2;3\n1;2;4\n", (), "The file has 2 columns y: columns 2, 3"),
    "unknown unit": ("u [lbf];y\n1;2\n2;3\n", (), "Column 'u [lbf]' states the unit 'lbf'"),
    "case decides": (
        "u (mpa);y\n1;2\n2;3\n",
        (),
        "states the unit 'mpa', which is unknown",
    ),
    "two marks": ("u;y\n0,5;1.234\n0,6;1.235\n", (), "Column y has points, but other col"),
    "thousands": ("u;y\n0,5;1.234,5\n0,6;0,1\n", (), "Column y has '1.234,5' in line 2"),
    "empty cell": ("u;y\n0,5;1,5\n0,6;\n0,7;1,7\n", (), "Column y has no value in line 3"),
    "no header": (
        "0,5;1,5\n0,6;1,6\n",
        (),
        "no header row with u, y. Add one, or name",
    ),
    "no such column": ("a;b\n0,5;1,5\n0,6;1,6\n", (), "Name the columns with --input and --output"),
    "no unit": ("u;y\n1;2\n2;3\n", ("--unit", "u"), "--unit u is not COLUMN=UNIT"),
    "bad unit": (
        "u;y\n1;2\n2;3\n",
        ("--unit", "u=parsec"),
        "--unit u=parsec states the unit",
    ),
    "no time": ("u;y\n1;2\n2;3\n", (), "The file states no sampling rate. Add --rate-hz"),
    "time in V": (
        "t [V];u;y\n1;2;3\n2;3;4\n",
        ("--time", "t"),
        "a column in V, which is",
    ),
    "times of a word": ("z;u;y\na;2;3\nb;3;4\n", ("--time", "z"), "Column z has no times"),
    "a word among clock times": (
        "z;u;y\n10:00:01;2;3\n10:00:02;3;4\n" + 200000 * "10:00:03;3;4\n" + "lost;3;4\n",
        (),
        "no sampling rate. Column z has 'lost' in line 200004, which is no clock time",
    ),
    "times that fall": (
        "t [s];u;y\n3;1;2\n2;3;1\n1;2;2\n",
        (),
        "Column t [s] does not increase after row 1 (step of -1 s). Sort the rows",
    ),
    "times that occur twice": (
        "time_s;u;y\n1;1;2\n2;3;1\n2;2;2\n3;1;1\n",
        (),
        "Column time_s does not increase after row 2 (step of 0 s). Sort the rows",
    ),
    "times in V": (
        "time [V];u;y\n1;2;3\n2;3;4\n",
        (),
        "no sampling rate. Column time [V] states a unit that is not a time. Add --rate-hz",
    ),
    "perhaps times": (
        "t;u;y\n1;1;2\n2;3;1\n2;2;2\n",
        (),
        "no sampling rate. Column t does not rise everywhere. Add --rate-hz",
    ),
    "two columns of one name": ("t;u;y;y\n1;1;2;3\n", (), "2 columns y: columns 3, 4. Use the num"),
    "one name in two units": (
        "t;u [mV];u [V];y\n1;1;2;3\n",
        (),
        "2 columns u (u [mV], u [V]). Use the full name",
    ),
    "units in cells": ("u;y\n1 V;2 mm\n2 V;3 mm\n3 V;4 mm\n", (), "Column u has '1 V' in line 2"),
    "workbook": ("PK", (), "Export the data as CSV"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_decided_is_refused_in_one_line(tmp_path, capsys, name):
    text, options, words = REFUSED[name]
    path = tmp_path / ("a.xlsx" if name == "workbook" else "a.csv")
    path.write_text(text)
    assert code_of("identify", "arx", path, *options) == 2
    printed = capsys.readouterr().err
    assert words in printed
    assert printed.count("\n") == 1


def test_a_quantity_refuses_the_unit_of_another_one(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("strain,U [mA]\n" + rows(np.linspace(0, 0.1, 50), np.linspace(0, 5, 50)))
    assert code_of("identify", "voltage-map", path, "--voltage", "U") == 2
    assert "Column U is in mA, but --voltage needs the voltage in V" in capsys.readouterr().err
    path.write_text("v_monitor_v [s],i_monitor_v\n" + rows(V, I))
    assert code_of("sense", path, "--carrier-hz", 2000, "--rate-hz", 5e4, "--v", "1") == 2
    assert "The column of --v is in s, but must be in V" in capsys.readouterr().err


def test_a_column_t_that_does_not_rise_is_no_time(tmp_path, capsys):
    """A temperature, for example: with --rate-hz the file is read, without it is refused."""
    time_s, u, y = sweep()
    warm = 23.0 + np.round(np.sin(time_s), 1)
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n" + rows(warm, u, y))
    assert code_of("identify", "arx", path, "--na", 2, "--nb", 1, "--nk", 1) == 2
    assert "states no sampling rate" in capsys.readouterr().err
    for command in ("arx", "transfer"):
        assert code_of("identify", command, path, "--rate-hz", 400) == 0, capsys.readouterr().err


@pytest.mark.parametrize("times", [TIME_S[::-1], np.repeat(TIME_S[::2], 2)])
def test_sense_refuses_times_that_do_not_rise(tmp_path, capsys, times):
    path = tmp_path / "a.csv"
    path.write_text("time_s,v_monitor_v,i_monitor_v\n" + rows(times, V, I))
    assert code_of("sense", path, "--carrier-hz", 2000, "--out", tmp_path / "o.csv") == 2
    error = capsys.readouterr().err
    assert "Column time_s does not increase after row 1. Sort the rows, or remove" in error
    assert error.count("\n") == 1


def test_a_rate_that_contradicts_a_foreign_time_column_is_refused(tmp_path, capsys):
    foreign = BOARD[0]
    path = put(tmp_path, foreign)
    for words in (("sense", path, "--carrier-hz", 2000), ("identify", "arx", path)):
        named = foreign.arguments() if words[0] == "sense" else ("--input", "2", "--output", "3")
        assert code_of(*words, *named, "--rate-hz", 49e3) == 2
        assert "but column Zeit [ms] has 50000 rows" in capsys.readouterr().err


def test_units_need_no_header_of_their_own_kind(tmp_path):
    np.savez(tmp_path / "a.npz", **{"U [mV]": 1e3 * V, "t (ms)": 1e3 * TIME_S})
    table = read_table(tmp_path / "a.npz", ["U"])
    np.testing.assert_allclose(table["U"], V, rtol=1e-12)
    assert table.rate_hz == pytest.approx(RATE_HZ)
    with pytest.raises(InputError, match="states the unit 'lbf'"):
        read_table(tmp_path / "a.npz", ["U"], ColumnOptions(units={"U": "lbf"}))


def test_sense_says_which_columns_it_converted(tmp_path, capsys):
    path = tmp_path / "mv.csv"
    path.write_text("U (mV),I (V)\n" + rows(1e3 * V, I))
    asked = ("--v", "U", "--i", "I", "--carrier-hz", 2000, "--rate-hz", RATE_HZ)
    assert code_of("sense", path, *asked) == 0
    error = capsys.readouterr().err
    assert f"haselab: column U was converted from mV to V. File: {path}\n" in error
    assert "column I" not in error


def test_a_small_drive_with_a_unit_in_the_header_has_no_note_on_kilovolts(tmp_path, capsys):
    strain = 0.05 * (1.0 - np.cos(2.0 * np.pi * np.arange(400) / 200.0))
    volt = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain)
    path = tmp_path / "map.csv"
    path.write_text("strain,U (mV)\n" + rows(strain, 1e3 * volt))
    answer = answer_of(capsys, "identify", "voltage-map", path, "--voltage", "U")
    assert not any("kV" in note for note in answer["notes"])
    path.write_text("strain,U\n" + rows(strain, volt))
    (note,) = answer_of(capsys, "identify", "voltage-map", path, "--voltage", "U")["notes"]
    assert note.endswith("If it is in kV, add --unit 'U=kV'.")


def test_a_capacitance_map_shows_one_slope(tmp_path, capsys):
    strain = 0.05 * (1.0 - np.cos(2.0 * np.pi * np.arange(800) / 200.0))
    noise = 2e-13 * np.random.default_rng(2).normal(size=800)
    path, actuator = tmp_path / "map.csv", tmp_path / "a.toml"
    path.write_text("strain,capacitance_f\n" + rows(strain, 5e-10 * (1.0 + 2.0 * strain) + noise))
    assert code_of("init", "leg", "--out", actuator) == 0
    capsys.readouterr()
    asked = ("identify", "capacitance-map", path, "--actuator", actuator)
    assert code_of(*asked) == 0
    shown = capsys.readouterr().out
    assert shown.count("slope") == 1
    low, high = (written := answer_of(capsys, *asked)["strain_map"])["band"]
    # Noise of 2e-13 F over 1e-9 F per unit of strain: 2e-4, of which 1.96 are the band.
    assert -low == pytest.approx(3.9e-4, rel=0.25) and high == pytest.approx(3.9e-4, rel=0.25)
    assert f"95 % of strains within {low:+.2g} to {high:+.2g} of it" in shown
    assert shown.index("[sensing.strain_map], written") < shown.index("line, not written")
    # The coefficients on the screen are those of the file, also for a curved map.
    for curve in (0.0, 3.0):
        farad = 5e-10 * (1.0 + 2.0 * strain + curve * strain**2) + noise
        path.write_text("strain,capacitance_f\n" + rows(strain, farad))
        assert code_of(*asked) == 0
        shown = capsys.readouterr().out
        written = tomllib.loads(actuator.read_text())["sensing"]["strain_map"]
        for name in ("slope_per_f", "offset", "curvature_per_f2", "cubic_per_f3"):
            found = [line.split()[1] for line in shown.splitlines() if line.split()[:1] == [name]]
            assert found == ([f"{written[name]:.6g}"] if name in written else [])
