"""`make bench`: each section names modules that can measure, and its summary lists every goal."""

import ast
import importlib

import pytest


@pytest.fixture
def rows(benchmarks):
    return importlib.import_module("benchmarks.rows")


def arguments_of(path, function):
    """Names of the arguments of a function, without importing what the benchmark needs."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name == function:
            return {one.arg for one in node.args.args}
    raise AssertionError(f"{path} has no function {function}")


def test_each_measurement_has_rows_that_take_its_sizes(benchmarks):
    sections = importlib.import_module("benchmarks.__main__").SECTIONS
    for measurement in (one for some in sections.values() for one in some):
        path = benchmarks / (measurement.module.replace(".", "/") + ".py")
        assert arguments_of(path, "rows") >= {*measurement.quick, *measurement.full}


def test_a_goal_is_reached_missed_or_not_measured(rows):
    assert rows.Row("speed", 2.0, "x", 1.0).outcome() == "reached"
    assert rows.Row("error", 2.0, "x", 1.0, more_is_better=False).outcome() == "missed"
    assert rows.Row("speed", float("nan"), "x", 1.0).outcome() == "not measured"
    assert rows.Row("speed", 2.0, "x").outcome() == ""


def test_the_summary_lists_every_goal_and_the_missed_ones_last(rows):
    table = [
        rows.Row("error", 2.0, "px", 1.0, more_is_better=False),
        rows.Row("speed", 3.0, "x", 1.0),
        rows.Row("  its memory", 10.0, "MB", 20.0, more_is_better=False),
        rows.Row("without a goal", 1.0, "s"),
    ]
    _, *lines, last = rows.summary([("tracking", table)]).splitlines()
    assert [line.split()[1] for line in lines] == ["speed", "speed:", "error"]
    assert lines[-1].endswith("missed") and "<= 1" in lines[-1]
    assert last == "3 goals: 2 reached, 0 not measured, 1 missed."


def test_a_measurement_that_fails_is_a_missed_goal(benchmarks):
    measurement = importlib.import_module("benchmarks.measurement")
    found, _ = measurement.Measurement("rows").run(full=False)  # has no function `rows`
    assert [row.outcome() for row in found] == ["missed"]
