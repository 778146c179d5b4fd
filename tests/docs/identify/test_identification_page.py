"""Every command on the page about identification runs as it stands, on files made for it."""

import re
from pathlib import Path

import numpy as np
import pytest

from haselab.models import ArrudaBoyce, Plant, SlowMode, VoltageMap
from tests.docs.page import Page

PAGE = Page("identify/identification.md")


def _csv(path: Path, **columns: np.ndarray) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of."""
    folder = tmp_path_factory.mktemp("records")
    rng = np.random.default_rng(1)
    plant = Plant(0.5, 5.11, 0.09, 0.012, (SlowMode(0.2, 4.7),))
    t = np.arange(4000) / 400.0
    sweep = np.sin(2 * np.pi * (0.1 * t + 0.495 * t**2))
    step_s = np.arange(12000) / 400.0
    step = np.where(step_s < 2.0, 0.0, 1.0)
    for name, u, time_s in (("chirp", sweep, t), ("step", step, step_s)):
        y = plant.simulate(u, 400.0, time_s) + 0.01 * rng.normal(size=u.size)
        _csv(folder / f"{name}.csv", u=u, y=y)
    tones_hz, turns = np.arange(1, 120) * 0.5, rng.uniform(0.0, 2 * np.pi, size=119)
    noise_s = np.arange(4096) / 610.35
    waves = np.cos(2 * np.pi * np.outer(noise_s, tones_hz) + turns) / 10.0
    response = Plant(1.0, 2 * np.pi * 20.0, 0.1).frequency_response(2 * np.pi * tones_hz)
    heard = np.real(np.exp(1j * (2 * np.pi * np.outer(noise_s, tones_hz) + turns)) @ response) / 10
    _csv(folder / "noise.csv", u=waves.sum(axis=1), y=heard + 0.002 * rng.normal(size=4096))
    levels = np.repeat(rng.uniform(0.0, 1.0, size=40), 200)
    bent = plant.simulate(levels**2, 400.0, np.arange(8000) / 400.0)
    _csv(folder / "steps.csv", u=levels, y=bent + 0.005 * rng.normal(size=8000))
    for k in (1, 2):
        x = 0.01 * np.exp(-4.0 * t) * np.cos(32.0 * t - 0.3 * k) + 1e-4 * rng.normal(size=t.size)
        _csv(folder / f"drop{k}.csv", x=x)
    stretch = np.linspace(1.0, 4.0, 80)
    stress_pa = ArrudaBoyce(15e3, 4.0).nominal_stress_pa(stretch) + 30.0 * rng.normal(size=80)
    _csv(folder / "tensile.csv", stretch=stretch, nominal_stress_pa=stress_pa)
    load_n = np.where(stretch < 2.0, 5.0 * stretch, 10.0 + 2.0 * (stretch - 2.0))
    _csv(folder / "load.csv", stretch=stretch, load_n=load_n + 0.01 * rng.normal(size=80))
    strain = 0.05 - 0.095 * np.cos(2 * np.pi * 0.25 * np.arange(1600) / 100.0)
    voltage_v = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain)
    capacitance = (strain + 0.276) / 4.923e6
    _csv(
        folder / "triangle.csv",
        strain=strain,
        voltage_v=voltage_v + 0.002 * rng.normal(size=1600),
        relative_capacitance=capacitance + 2e-10 * rng.normal(size=1600),
    )
    return folder


def test_every_command_of_the_page_has_a_result(
    records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(records)
    assert len(PAGE.commands) >= 10
    for line in PAGE.commands:
        PAGE.run(line)
        if " regions " not in line:  # it has no status
            told = capsys.readouterr().out
            assert re.search(r"^status +ok$", told, flags=re.MULTILINE), line
