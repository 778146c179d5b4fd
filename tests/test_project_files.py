"""The files around the code: citation, forms, contributing, README."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from haselab.study.paper.row_table import CITATION
from tests.docs.page import Page

ROOT = Path(__file__).resolve().parents[1]
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def test_the_citation_is_complete_and_names_the_authors_of_the_paper() -> None:
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= found.keys()
    (paper,) = found["references"]
    authors = ", ".join(f"{a['given-names']} {a['family-names']}" for a in paper["authors"])
    assert CITATION.startswith(f"{authors}: {paper['title']}. ")
    assert str(paper["year"]) in CITATION and paper["collection-title"] in CITATION


@pytest.mark.parametrize("form", FORMS, ids=lambda path: path.name)
def test_each_form_can_be_filled_in(form: Path) -> None:
    found = yaml.safe_load(form.read_text(encoding="utf-8"))
    if form.name == "config.yml":
        return
    assert {"name", "description", "body"} <= found.keys()
    ids = [part["id"] for part in found["body"] if part["type"] != "markdown"]
    assert ids and len(ids) == len(set(ids))
    for part in found["body"]:
        assert part["type"] in {"markdown", "textarea", "input", "dropdown", "checkboxes"}
        assert "value" in part["attributes"] or "label" in part["attributes"]
    fields = [part for part in found["body"] if part.get("validations", {}).get("required")]
    assert fields, "a form without a required field says nothing"


def test_every_stop_of_the_tour_exists() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    tour = text.partition("## A tour of the code")[2].partition("\n## ")[0]
    named = re.findall(r"`((?:src|native|core)/[^`]+)`", tour)
    assert len(named) > 10
    assert not [path for path in named if not (ROOT / path).exists()]


@pytest.mark.long
def test_the_python_of_the_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = Page("../README.md").python
    Page("../README.md").execute(code)
    assert "natural_frequency_rad_s" in capsys.readouterr().out
    assert (tmp_path / "chirp.svg").stat().st_size > 0
