"""Every command and the Python of the page about static laws run as they stand."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.models import Deformation, LinearMap, OgdenTwoTerms, VoltageMap
from tests.docs.page import Page

PAGE = Page("identify/static-laws.md")


def _csv(path: Path, **columns: np.ndarray) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="")


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the page speaks of."""
    folder = tmp_path_factory.mktemp("records")
    rng, law = np.random.default_rng(1), OgdenTwoTerms(4e3, -1.5, 12e3, 2.4)
    tests = {
        "uniaxial": (Deformation(), 3.5), "shear": (Deformation("pure_shear"), 3.0),
        "biaxial": (Deformation("equibiaxial"), 2.5),
        "sheet": (Deformation("prestretched", prestretch=2.0), 1.8),
    }  # fmt: skip
    for name, (kind, top) in tests.items():
        stretch = np.linspace(1.0, top, 60)
        stress_pa = law.nominal_stress_pa(*kind.stretches(stretch)) + 30.0 * rng.normal(size=60)
        _csv(folder / f"{name}.csv", stretch=stretch, nominal_stress_pa=stress_pa)
    stretch = np.linspace(1.0, 3.0, 60)
    load_n = np.interp(stretch, [1.0, 1.6, 2.2, 3.0], [0.0, 3.0, 4.0, 8.0])
    _csv(folder / "load.csv", stretch=stretch, load_n=load_n + 0.02 * rng.normal(size=60))
    strain = 0.05 - 0.095 * np.cos(2 * np.pi * 0.25 * np.arange(800) / 50.0)
    volts = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain)
    capacitance = LinearMap(4.923e6, -0.276).relative_capacitance(strain)
    _csv(
        folder / "triangle.csv",
        strain=strain,
        voltage_v=volts + 0.005 * rng.normal(size=800),
        relative_capacitance=capacitance + 2e-10 * rng.normal(size=800),
    )
    u = 5.0 + 1.5 * np.sign(rng.normal(size=400))
    y = lfilter([0.0, 0.0, 0.0, 0.067, 0.044], [1.0, -1.274, 0.394], u - 5.0)
    _csv(folder / "dryer.csv", u=u, y=4.8 + y + 0.02 * rng.normal(size=400))
    return folder


def test_every_command_of_the_page_runs(
    records: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(records)
    assert len(PAGE.commands) >= 10
    for line in PAGE.commands:
        PAGE.run(line)
        told = capsys.readouterr().out
        assert re.search(r"^status +ok$", told, flags=re.MULTILINE), line


@pytest.mark.parametrize("code", PAGE.python)
def test_the_python_of_the_page_runs(code: str) -> None:
    PAGE.execute(code)
