"""The page about Python and its notebook run as they are written."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.docs.page import Page

PAGE = Page("python.md")
NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "notebooks" / "close-a-loop.ipynb"
CLOSES_LOOP = "runner.close_loop("


def cells() -> list[str]:
    """Code cells of the notebook, in order."""
    parsed = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in parsed["cells"] if cell["cell_type"] == "code"]


@pytest.mark.long
def test_the_examples_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for code in PAGE.python:
        if CLOSES_LOOP not in code:  # the notebook's cell, which the next test runs
            PAGE.execute(code, names)
    printed = capsys.readouterr().out
    assert "TransferFit: ok" in printed and "natural_frequency_rad_s" in printed
    assert "\nSubspaceFit: ok" in printed
    assert (tmp_path / "fit.svg").stat().st_size > 0
    unit, capacitance_f = printed.splitlines()[-1].split()
    assert unit == "F" and 1e-10 < float(capacitance_f) < 1e-8


def test_the_page_shows_the_cell_of_the_notebook_in_at_most_12_lines() -> None:
    (shown,) = [code for code in PAGE.python if CLOSES_LOOP in code]
    assert shown.strip() == cells()[0].strip()
    assert len(shown.strip().splitlines()) <= 12


@pytest.mark.long
def test_the_notebook_closes_a_loop_on_the_twin() -> None:
    names: dict[str, object] = {}
    for number, code in enumerate(cells(), start=1):
        exec(compile(code, f"cell {number}", "exec"), names)
    loop, design = names["loop"], names["design"]
    assert design.shortfalls == ()
    late = np.asarray(loop["strain"])[-100:]
    # The demands of the design: at most 2 % of the step are left. The map of the capacitance adds
    # its hysteresis, the largest distance of its branches.
    allowed = 0.02 * 0.03 + names["to_strain"].hysteresis_strain
    assert abs(late.mean() - 0.03) < allowed
    assert abs(names["error"] - (0.03 - late.mean())) < 1e-12
    assert design.summary().splitlines()[0].startswith("kp ")
