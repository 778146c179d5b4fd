"""The files around the code: citation, metadata, forms, contributing, README."""

from __future__ import annotations

import re
import tomllib
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


def bibtex(page: str) -> list[tuple[str, dict[str, str]]]:
    """The entries of a page, in their order: kind, fields."""
    text = (ROOT / page).read_text(encoding="utf-8")
    entries = re.findall(r"(?ms)^ *@(\w+)\{\w+,\n(.*?)^ *\}$", text)
    fields = [re.findall(r"(?ms)^ *(\w+) = \{(.*?)\},$", body) for _, body in entries]
    return [
        (kind, {name: " ".join(value.split()) for name, value in found})
        for (kind, _), found in zip(entries, fields, strict=True)
    ]


def cited_software() -> dict[str, str]:
    """The fields of the BibTeX entry that CITATION.cff gives; the reader writes the version."""
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    authors = " and ".join(f"{{{author['name']}}}" for author in found["authors"])
    fields = {"author": authors, "title": found["title"], "version": "VERSION"}
    optional = {"doi": found.get("doi"), "url": found.get("repository-code")}
    fields |= {name: value for name, value in optional.items() if value}
    return fields | {"license": found["license"]}


def test_the_readme_cites_the_software_and_then_the_paper_as_the_citation_file_does() -> None:
    (first, software), (second, paper) = bibtex("README.md")
    assert (first, second) == ("software", "inproceedings")
    assert software == cited_software()
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["references"][0]
    authors = (f"{one['family-names']}, {one['given-names']}" for one in found["authors"])
    assert paper["author"] == " and ".join(authors)
    assert paper["title"] == found["title"]


def test_the_front_page_of_the_documentation_cites_the_software_too() -> None:
    assert bibtex("docs/index.rst") == [("software", cited_software())]
    for page in ("docs/index.rst", "docs/faq.md"):
        assert re.search(r"(?m)^(## )?How to cite$", (ROOT / page).read_text(encoding="utf-8"))


def test_the_pages_say_that_there_is_no_doi_as_long_as_there_is_none() -> None:
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    for page in ("README.md", "docs/index.rst", "docs/faq.md"):
        text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert ("here is no DOI yet" in text) == ("doi" not in found), page


def test_the_package_has_the_authors_and_keywords_of_the_citation() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert project["authors"] == found["authors"]
    assert project["keywords"] == found["keywords"]
    # The licence is an SPDX expression, beside which a classifier of a licence is not permitted.
    assert not [each for each in project["classifiers"] if each.startswith("License")]


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


def test_the_readme_names_the_form_for_a_question() -> None:
    form = yaml.safe_load((ROOT / ".github/ISSUE_TEMPLATE/question.yml").read_text("utf-8"))
    help_text = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Get help")[2]
    assert f'"{form["name"]}"' in help_text
    assert {"task", "tried", "doctor"} <= {part.get("id") for part in form["body"]}


def test_a_report_on_an_instrument_says_which_one_and_when() -> None:
    path = ROOT / ".github/ISSUE_TEMPLATE/instrument.yml"
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"instrument", "date"} <= {part.get("id") for part in form["body"]}
    page = (ROOT / "docs/hardware.md").read_text(encoding="utf-8")
    assert f'"{form["name"]}"' in page and "instrument.yml" in page


def test_the_code_of_conduct_is_linked_and_leads_to_the_private_form() -> None:
    text = (ROOT / "CODE_OF_CONDUCT.md").read_text(encoding="utf-8")
    form = '"Report a vulnerability"'
    assert form in text and form in (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    assert "@" not in text
    assert "(CODE_OF_CONDUCT.md)" in (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


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
