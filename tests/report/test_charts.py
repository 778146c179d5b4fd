"""Figures that an experiment describes as data."""

from __future__ import annotations

from typing import Any

from haselab.report import compose_page, read_folder

CHART = {
    "name": "creep",
    "title": "Creep",
    "caption": "Length in time.",
    "x_label": "Time (s)",
    "y_label": "Length (mm)",
    "curves": [
        {"name": "camera", "x": [0.0, 1.0, 2.0], "y": [1.0, None, 1.2], "points": True},
        {"name": "fit", "x": [0.0, 2.0], "y": [1.0, 1.2], "points": False},
    ],
}


def drawn(make_run: Any, documents: Any, charts: Any) -> dict[str, Any]:
    results, _ = documents
    folder = make_run(results, {"only": [], "charts": charts})
    return {drawing.plan.name: drawing for drawing in compose_page(read_folder(folder)).drawings}


def test_a_chart_becomes_a_figure_with_its_words(make_run: Any, documents: Any) -> None:
    (figure,) = drawn(make_run, documents, [CHART]).values()
    assert figure.plan.caption == "Length in time."
    for word in ("Creep", "Time (s)", "Length (mm)", "camera", "fit"):
        assert word in figure.document, word


def test_a_name_that_is_taken_or_no_file_name_is_numbered(make_run: Any, documents: Any) -> None:
    charts = [{**CHART, "name": name} for name in ("fig3", "../report", "own", "own")]
    assert list(drawn(make_run, documents, charts)) == ["chart-1", "chart-2", "own", "chart-4"]


def test_a_chart_with_a_fault_is_left_out_with_the_reason(make_run: Any, documents: Any) -> None:
    short = {**CHART, "curves": [{"name": "fit", "x": [0.0, 2.0], "y": [1.0]}]}
    empty = {**CHART, "name": "empty", "curves": []}
    found = drawn(make_run, documents, [short, empty, "no chart"])
    assert "has 1 values for 2" in found["creep"].notes[0]
    assert "is empty" in found["empty"].notes[0]


def test_charts_that_are_no_list_are_not_drawn(make_run: Any, documents: Any) -> None:
    assert drawn(make_run, documents, {"no": "list"}) == {}
