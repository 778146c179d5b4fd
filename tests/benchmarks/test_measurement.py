"""`make bench`: each section names modules that can measure, and its summary lists every goal."""

import ast
import importlib
import multiprocessing
import re
import sys

import pytest


@pytest.fixture
def rows(benchmarks):
    return importlib.import_module("benchmarks.rows")


def arguments_of(path, function):
    """Names of the arguments of a function, without importing what the benchmark needs."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name == function:
            names = {one.arg for one in node.args.args}
            return names | (counts_of(path) if node.args.kwarg else set())
    raise AssertionError(f"{path} has no function {function}")


def counts_of(path):
    """Keys of the table COUNTS, which `**counts` takes."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "COUNTS":
            return {*ast.literal_eval(node.value)}
    return set()


def test_each_measurement_has_rows_that_take_its_sizes(benchmarks):
    sections = importlib.import_module("benchmarks.__main__").SECTIONS
    for measurement in (one for some in sections.values() for one in some):
        path = benchmarks / (measurement.module.replace(".", "/") + ".py")
        assert arguments_of(path, "rows") >= {*(measurement.quick or {}), *measurement.full}


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
    found = importlib.import_module("benchmarks.measurement").Measurement("rows").run(full=False)
    assert [row.outcome() for row in found.rows] == ["missed"]  # it has no function `rows`
    assert found.failed


def test_a_measurement_that_takes_too_long_is_ended_and_counts_as_not_measured(benchmarks):
    measurement = importlib.import_module("benchmarks.measurement").Measurement("rig.twin")
    for most_s in (0.01, 0.0):  # it starts, and it does not
        found = measurement.run(full=False, most_s=most_s)
        assert [row.outcome() for row in found.rows] == ["not measured"]
        assert (found.failed, found.cpu_s) == (False, 0.0)
        assert multiprocessing.active_children() == []


def test_the_summary_is_printed_and_the_exit_code_tells_that_a_benchmark_failed(
    benchmarks, monkeypatch, capsys
):
    main = importlib.import_module("benchmarks.__main__")
    fails = importlib.import_module("benchmarks.measurement").Measurement("rows")
    monkeypatch.setattr(main, "SECTIONS", {"planted": (fails,)})
    monkeypatch.setattr(sys, "argv", ["benchmarks"])
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 1
    assert "1 goals: 0 reached, 0 not measured, 1 missed." in capsys.readouterr().out


def test_the_readme_names_the_section_of_each_module(benchmarks):
    text = (benchmarks / "README.md").read_text()
    sections = importlib.import_module("benchmarks.__main__").SECTIONS
    rows = {}
    for part in re.split(r"^## ", text, flags=re.MULTILINE):
        folder = part.partition("/")[0]
        for names, section in re.findall(r"^\| (`.*?) \|.*\| ?([\w-]*) ?\|$", part, re.MULTILINE):
            rows |= {f"{folder}.{name}": section for name in re.findall(r"`(\w+)`", names)}
    for section, measurements in sections.items():
        for one in measurements:
            assert rows.pop(one.module, "command") == section
    assert set(rows.values()) == {""}  # the others have none
    for name in rows:
        assert (benchmarks / (name.replace(".", "/") + ".py")).is_file()
