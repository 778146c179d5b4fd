"""docs/identify/general-transfer-function.md: its code, what it prints, and its table."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, PlanarHasel, linearise
from tests.docs.page import Page

PAGE = Page("identify/general-transfer-function.md")
ACTUATOR = """\
[actuator]
kind = "planar-hasel"
[model.physical]
kind = "planar-hasel"
[model.physical.parameters]
shell.shear_modulus_pa = 15e3
load.added_inertia_kg = 0.01
"""


def test_the_code_prints_what_the_page_shows(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, own = PAGE.python
    names = PAGE.execute(first)
    (shown,) = re.findall(r"```text\n(.*?)```", PAGE.text, re.DOTALL)
    assert capsys.readouterr().out == shown
    (tmp_path / "actuator.toml").write_text(ACTUATOR)
    monkeypatch.chdir(tmp_path)
    softer = PAGE.execute(own, names)["point"]
    assert softer.length_m > linearise(PlanarHasel(), 5e3, 2.45, 0.25, longest_m=0.1).length_m


def test_the_table_has_the_numbers_of_the_default_twin() -> None:
    law = PlanarHasel()
    masses = [float(text) for text in re.findall(r"\| ([\d.]+) kg", PAGE.text)]
    rows = re.findall(r"^\| ([\d.]+) ((?:\| [\d.]+, [\d.]+, [\d.]+ )+)\|$", PAGE.text, re.MULTILINE)
    assert len(masses) == 3 and len(rows) == 6
    for kilovolt, cells in rows:
        for mass_kg, cell in zip(masses, cells.split("|")[1:], strict=True):
            point = linearise(
                law, 1e3 * float(kilovolt), mass_kg * GRAVITY_M_S2, mass_kg, longest_m=0.1
            )
            pole = point.poles[np.argmax(point.poles.imag)]
            own = f"{1e6 * point.gain_m_per_v:.3g}, {abs(pole):.1f}, {-pole.real / abs(pole):.3f}"
            assert cell.strip() == own
