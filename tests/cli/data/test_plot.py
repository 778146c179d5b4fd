"""`--plot`: one figure of each command that computes, as SVG, PNG or HTML."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import click
import numpy as np
import pytest
from PIL import Image

from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.main import cli, main
from haselab.cli.readable import readable
from haselab.models import Plant, VoltagePlant
from haselab.report.chart_file import draw_chart
from haselab.signals import square, triangle

PLANT = Plant(0.5, 5.11, 0.09, 0.02)
# Every command that computes something which a figure can show.
PLOTTED = {
    "sense", "track", "calibrate", "design", "margins", "plan carrier", "plan-experiment",
    "identify transfer", "identify arx", "identify subspace", "identify frequency-response",
    "identify free-response", "identify hyperelastic", "identify regions", "identify voltage-map",
    "identify capacitance-map", "identify map", "identify hysteresis", "identify creep",
    "identify model-comparison",
}  # fmt: skip


def code_of(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def write(path: Path, **columns: np.ndarray) -> Path:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")
    return path


def texts_of(path: Path) -> str:
    """The text of a figure, which also has to be well-formed."""
    root = ET.parse(path).getroot()
    return " ".join(part.strip() for part in root.itertext())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tables")
    rng = np.random.default_rng(1)
    time_s = np.arange(2000) / 100.0
    u = np.sin(2 * np.pi * (0.1 * time_s + 0.1 * time_s**2))
    y = PLANT.simulate(u, 100.0, time_s) + 0.005 * rng.normal(size=time_s.size)
    write(folder / "sweep.csv", time_s=time_s, u=u, y=y)
    x = 0.02 * np.exp(-0.5 * time_s) * np.cos(5.0 * time_s) + 1e-5 * rng.normal(size=time_s.size)
    write(folder / "free.csv", time_s=time_s, x=x)
    stretch = np.linspace(1.05, 2.5, 120)
    stress = 20e3 * (stretch - stretch**-2) * (1.0 + 1e-3 * rng.normal(size=120))
    write(folder / "pull.csv", stretch=stretch, nominal_stress_pa=stress, load_n=stress / 1e4)
    strain = 0.05 - 0.05 * np.cos(2 * np.pi * 0.25 * np.arange(1600) / 100.0)
    noise = rng.normal(size=(2, 1600))
    write(
        folder / "maps.csv",
        strain=strain,
        capacitance_f=(strain + 0.2) / 1e9 + 1e-13 * noise[0],
        voltage_v=1324.0 * np.exp(3.124 * strain) - 280.5 * np.exp(-26.92 * strain) + noise[1],
    )
    drive = triangle(0.0, 1.0, 0.5, 5, 100.0)
    loop = 0.5 * drive + 0.05 * np.sign(np.gradient(drive)) * drive * (1.0 - drive)
    write(folder / "loops.csv", u=drive, y=loop + 1e-3 * rng.normal(size=drive.size))
    creep = 1.0 + 0.2 * (1.0 - np.exp(-time_s / 2.0)) + 1e-4 * rng.normal(size=time_s.size)
    write(folder / "creep.csv", time_s=time_s, y=creep)
    turn = np.exp(2j * np.pi * 2000.0 * np.arange(10_000) / 50e3)
    monitors = np.stack([0.05 * turn, 0.03 * np.exp(1.5j) * turn]).real
    monitors += 1e-4 * rng.normal(size=(2, 10_000))
    write(folder / "monitors.csv", v_monitor_v=monitors[0], i_monitor_v=monitors[1])
    return folder


COMMANDS = {
    "identify transfer": ("sweep.csv", "Transfer function Time (s) measured model Residual u y"),
    "identify arx": ("sweep.csv", "ARX model Residual"),
    "identify subspace": ("sweep.csv --bootstrap 2", "Subspace model"),
    "identify frequency-response": ("sweep.csv", "Magnitude Phase Coherence Frequency (Hz)"),
    "identify free-response": ("free.csv", "Free response fit"),
    "identify hyperelastic": ("pull.csv --model neo-hooke", "Hyperelastic law, neo-hooke"),
    "identify regions": ("pull.csv", "linear regions Force (N)"),
    "identify voltage-map": ("maps.csv", "Voltage map Strain"),
    "identify capacitance-map": ("maps.csv", "Capacitance map"),
    "identify map": ("maps.csv --x capacitance_f --y strain", "capacitance_f strain"),
    "identify hysteresis": ("loops.csv --rate-hz 100", "Hysteresis"),
    "identify creep": ("creep.csv --unit-step", "Creep"),
    "sense": ("monitors.csv --carrier-hz 2000 --rate-hz 50000", "Capacitance (pF)"),
    "plan carrier": ("", "Sensing frequency Carrier (Hz)"),
}


@pytest.mark.parametrize("words", COMMANDS)
def test_a_command_writes_its_figure(folder, tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(folder)
    line, said = COMMANDS[words]
    figure = tmp_path / "figure.svg"
    assert code_of(*words.split(), *line.split(), "--plot", figure) == 0, capsys.readouterr().err
    found = texts_of(figure)
    for word in said.split():
        assert word in found, word
    printed = capsys.readouterr().out.splitlines()
    assert max(map(len, printed)) <= 250


def test_the_model_of_a_fit_is_designed_and_its_margins_drawn(folder, tmp_path, capsys):
    model = tmp_path / "model.json"
    assert code_of("identify", "transfer", folder / "sweep.csv", "--out", model) == 0
    for words, said in (
        (("design", model, "--accept-shortfalls", "--draws", 50), "Predicted step reference"),
        (("margins", model, "--kp", 0.1, "--ki", 1.0), "Open loop with its delay"),
    ):
        figure = tmp_path / f"{words[0]}.svg"
        assert code_of(*words, "--rate-hz", 100, "--delay-s", 0.005, "--plot", figure) == 0, (
            capsys.readouterr().err
        )
        assert all(word in texts_of(figure) for word in said.split())


def test_each_form_is_written(folder, tmp_path):
    for ending, start in ((".png", b"\x89PNG"), (".html", b"<!doctype html>"), (".svg", b"<svg")):
        figure = tmp_path / f"a{ending}"
        assert code_of("identify", "regions", folder / "pull.csv", "--plot", figure) == 0
        assert figure.read_bytes().startswith(start)
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<svg" in page and "http-equiv" not in page and "src=" not in page


def test_another_ending_is_refused_before_anything_is_computed(tmp_path, capsys):
    assert code_of("identify", "arx", "none.csv", "--plot", tmp_path / "a.pdf") == 2
    assert "--plot cannot write '.pdf'. Use a name that ends with .svg" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_figure_that_is_there_is_not_overwritten(folder, tmp_path, capsys):
    figure = tmp_path / "a.svg"
    figure.write_text("mine")
    line = ("identify", "regions", folder / "pull.csv", "--plot", figure)
    assert code_of(*line) == 2
    assert "--plot names an existing result" in capsys.readouterr().err
    assert figure.read_text() == "mine"
    assert code_of(*line, "--force") == 0
    assert "<svg" in figure.read_text()


def test_a_failed_command_leaves_no_figure(folder, tmp_path):
    assert code_of("identify", "arx", folder / "maps.csv", "--plot", tmp_path / "a.svg") == 2
    assert list(tmp_path.iterdir()) == []


def test_all_commands_that_compute_have_the_option() -> None:
    found = set()

    def walk(group: click.Command, words: tuple[str, ...]) -> None:
        if isinstance(group, click.Group):
            for name in group.list_commands(click.Context(group)):
                command = group.get_command(click.Context(group), name)
                assert command is not None
                walk(command, (*words, name))
        elif any("--plot" in parameter.opts for parameter in group.params):
            found.add(" ".join(words))

    walk(cli, ())
    assert found >= PLOTTED


def test_a_long_record_is_thinned_and_a_label_is_never_mathematics() -> None:
    x = np.arange(100_000.0)
    figure = draw_chart(Chart("a $b$ c", (Panel("x", "y", (Curve(x, x, "_hidden"),)),)))
    line = figure.axes[0].get_lines()[0]
    assert line.get_xdata().size <= 5000
    assert line.get_label() == " _hidden"


def test_readable_lines_are_short_and_complete() -> None:
    answer = {
        "matrix": np.zeros((4, 4)), "one": [1.0, 2.5], "table": [{"a": 1, "b": True}],
        "nothing": None, "text": "word " * 40, "complex": [complex(-1.0, -2.0)],
        "many": list(range(100)),
    }  # fmt: skip
    lines = readable(answer)
    assert "matrix                           array of 16 values (use --json or --out)" in lines
    assert "one                              1, 2.5" in lines
    assert "    b                            yes" in lines
    assert "nothing                          none" in lines
    assert "complex                          -1 - 2i" in lines
    assert "many                             100 values (use --json or --out)" in lines


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    (tmp_path / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    (tmp_path / "twin.toml").write_text('reading = "rad"\n[acquisition]\ndrive_low_v = -2.0\n')
    return tmp_path / "rig.toml"


def test_a_calibration_is_drawn(rig, tmp_path, capsys):
    figure = tmp_path / "a.svg"
    assert code_of("calibrate", "--rig", rig, "--capacitor", "0.47e-9", "--capacitor", "2.2e-9",
                   "--plot", figure) == 0, capsys.readouterr().err  # fmt: skip
    assert "Residual (%)" in texts_of(figure)


def test_a_verdict_and_the_next_drive_are_drawn(rig, tmp_path, capsys):
    plant = VoltagePlant("mechanical", (0.05, 0.004), 5.11, 0.1, 0.01, 0.35, 3.0)
    turns, rest = 1.5 * square(0.5, 5.0, 100.0), np.ones(500)
    drive_v = np.concatenate([rest[:100], np.full(500, 1.5), turns, rest, turns])
    time_s = np.arange(drive_v.size) / 100.0
    y = plant.simulate(drive_v, 100.0, time_s)
    y += 1e-3 * np.random.default_rng(2).normal(size=y.size)
    table = write(tmp_path / "a.csv", time_s=time_s, drive_v=drive_v, y=y)
    model, odds, drive = tmp_path / "m.json", tmp_path / "v.svg", tmp_path / "d.svg"
    assert code_of("identify", "model-comparison", table, "--question", "reading", "--out", model,
                   "--plot", odds) == 0, capsys.readouterr().err  # fmt: skip
    assert "Probability" in texts_of(odds)
    assert code_of("plan-experiment", model, "--rig", rig, "--goal", "reading", "--duration-s", 10,
                   "--plot", drive) == 0, capsys.readouterr().err  # fmt: skip
    assert "Drive (V)" in texts_of(drive)


def test_tracks_are_drawn_by_point(tmp_path, capsys):
    rows, columns = np.mgrid[0:120, 0:160]
    places = [(40, 30), (80, 30), (120, 30), (40, 80), (80, 80), (120, 80)]
    folder = tmp_path / "frames"
    folder.mkdir()
    for frame in range(6):
        image = np.full((120, 160), 200.0)
        for x, y in places:
            low = y + (0.7 * frame if y > 50 else 0.0)
            image -= 150.0 * np.exp(-((columns - x) ** 2 + (rows - low) ** 2) / 18.0)
        Image.fromarray(image.clip(0, 255).astype(np.uint8)).save(folder / f"{frame:03d}.png")
    names = ("upper1", "upper2", "upper3", "lower1", "lower2", "lower3")
    lines = [f"{name},{x},{y}" for name, (x, y) in zip(names, places, strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["point,x_px,y_px", *lines]) + "\n")
    figure = tmp_path / "t.svg"
    assert (
        code_of(
            "track",
            folder,
            "--points",
            tmp_path / "p.csv",
            "--rate-hz",
            100,
            "--out",
            tmp_path / "t.csv",
            "--plot",
            figure,
        )
        == 0
    ), capsys.readouterr().err
    assert all(name in texts_of(figure) for name in names)
