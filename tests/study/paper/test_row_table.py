"""The study row by row: complete, the same in docs and package, and every result has its row."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import describe
from haselab.runtime.lockin import counted_s, lockin_of
from haselab.study.paper.paper_check import recompute_paper
from haselab.study.paper.row_table import markdown_table, study_rows
from haselab.study.results import quantities

DOCS = Path(__file__).parents[3] / "docs" / "study" / "study.md"
OPEN = {"S29"}  # of later issues


def test_every_row_of_the_study_and_every_contradiction_is_there() -> None:
    wanted = [f"S{k}" for k in range(1, 31)]
    wanted += [row.id for row in recompute_paper() if row.id.startswith("D")]
    assert {row.id for row in study_rows()} == set(wanted)
    assert {row.id for row in study_rows() if row.here == "open"} == OPEN


def test_every_result_has_its_row() -> None:
    ids = {row.id for row in study_rows()}
    assert {key.partition(".")[0] for key in quantities()} <= ids - OPEN


def test_results_that_a_row_names_exist() -> None:
    known = set(quantities())
    for row in study_rows():
        for name in re.findall(r"S\d+\.[a-z0-9_]+\*?", f"{row.where} {row.here}"):
            stem = name.removesuffix("*")
            found = name in known or (stem != name and any(key.startswith(stem) for key in known))
            assert found, (row.id, name)


def test_the_docs_hold_the_same_table() -> None:
    if not DOCS.exists():
        pytest.skip("an installed package has no docs")
    assert markdown_table(study_rows()) in DOCS.read_text(encoding="utf-8")


def test_the_periods_of_row_s7_are_those_that_the_lock_in_fits() -> None:
    rig = describe(twin_of_reading("hz"))
    middle = lockin_of(rig, 2000.0).middle_s * rig.rate_hz  # of the readings that count
    first = 2.0 * middle - (rig.block_samples - 1)
    assert first == pytest.approx(560.0)
    assert counted_s(rig, 2000.0) * 2000.0 == pytest.approx((2000 - first) / 100.0)
    (row,) = (row for row in study_rows() if row.id == "S7")
    assert f"to {counted_s(rig, 2000.0) * 2000.0:.3g} of them" in row.here
