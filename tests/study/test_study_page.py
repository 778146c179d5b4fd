"""The Python of docs/study/study.md runs as it stands and gives the product's own strain."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "study" / "study.md"


@pytest.fixture
def text() -> str:
    if not PAGE.is_file():
        pytest.skip("an installed package has no docs")
    return PAGE.read_text(encoding="utf-8")


def test_the_strain_of_the_page_is_that_of_the_results(
    text: str, played: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = played("hz")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "reference").symlink_to(run.folder)
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    found: dict[str, Any] = {}
    exec(compile(code, str(PAGE), "exec"), found)
    # The first cycle is left out of the results: 0.2 s of rest and 4 s of the triangle.
    kept = found["time_s"] - found["time_s"][0] > 4.2
    strain = found["strain"][kept]
    assert np.isfinite(strain).all()
    for key, value in (("S18.strain_min", strain.min()), ("S18.strain_max", strain.max())):
        assert value == pytest.approx(run.rows[key]["measured"]["value"], abs=2e-4)
    assert found["monitors_v"].shape == (2000, 2)
    point = json.loads((run.folder / "analysis.json").read_text())["static"]["operating_point"]
    assert found["stretch"].min() < point["stretch"] < found["stretch"].max()


def test_the_page_names_every_figure_and_every_key_of_the_results(
    text: str, played: Callable[[str], Any]
) -> None:
    run = played("hz")
    for file in (run.folder / "figures").iterdir():
        assert file.name in text or re.fullmatch(r"fig[2-7]\.svg", file.name), file.name
    keys = set(run.results) | {key for row in run.results["quantities"] for key in row}
    assert {key for key in keys if f"`{key}" not in text and f".{key}" not in text} <= {"id"}


def test_a_quick_run_says_what_it_changed_and_what_it_lacks(played: Callable[[str], Any]) -> None:
    run = played("other")
    page = (run.folder / "report.html").read_text(encoding="utf-8")
    assert "This run used the quick form of the study" in page
    assert "load.mass_kg 0.2 instead of 0.25" in page
    for row in run.rows.values():
        assert row["verdict"] == "not in paper" or {
            "set_in_twin", "set_in_study", "follows_from_twin",
        } & set(row), row["id"]  # fmt: skip
    missing = {key for item in run.results["not_played"] for key in item["ids"]}
    assert not missing & set(run.rows)
