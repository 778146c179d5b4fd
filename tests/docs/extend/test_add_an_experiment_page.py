"""The page on experiments: its package in a fresh environment, its commands in order."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

pytest.importorskip("setuptools", reason="builds the package of the page")
pytest.importorskip("pip", reason="installs the package of the page")

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "examples" / "plugins" / "haselab-myexperiment"
TEXT = (ROOT / "docs" / "extend" / "add-an-experiment.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:cp|pip|haselab) .*)", TEXT, re.MULTILINE)
STUDY = re.search(r"```toml\n(name = .*?)```", TEXT, re.DOTALL)


@pytest.fixture(scope="module")
def lab(make_shell):
    made = make_shell("experiment", PACKAGE)
    before = made.run("haselab plan feasibility examples/plugins/haselab-myexperiment/creep.toml "
                      "--rig rig.toml")  # fmt: skip
    assert before.returncode == 2 and "[creep]" in before.stderr, before.stderr
    for command in COMMANDS:
        done = made.run(command)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
    return made


def test_the_page_has_what_is_run_here() -> None:
    assert len(COMMANDS) == 8
    assert STUDY is not None and STUDY[1] == (PACKAGE / "creep.toml").read_text()


def test_the_example_has_at_most_100_lines() -> None:
    (module,) = PACKAGE.glob("src/*/__init__.py")
    lines = len(module.read_text().splitlines())
    assert lines <= 100
    assert f"in {lines} lines" in TEXT


def test_its_results_are_those_of_its_own_fit(lab) -> None:
    rows = {row["id"]: row for row in lab.json("out/creep/results.json")["quantities"]}
    assert list(rows) == ["creep.time_constant", "creep.amplitude", "creep.end"]
    for row in rows.values():
        assert row["measured"]["unit"] == row["unit"]
        assert row["paper"] is None and row["verdict"] == "not in paper"
        # The fit leaves more than white noise, so its own interval is no bound: 1 % is.
        assert math.isclose(row["measured"]["value"], row["noise_free"], rel_tol=1e-2)


def test_the_analysis_of_the_recording_gives_the_same_numbers(lab) -> None:
    played, again = (lab.json(f"out/{name}/results.json") for name in ("creep", "creep-again"))
    assert [row["measured"] for row in again["quantities"]] == [
        row["measured"] for row in played["quantities"]
    ]


def test_the_report_has_its_row_and_figure_and_no_columns_about_a_paper(lab) -> None:
    page = (lab.folder / "out/creep/report.html").read_text(encoding="utf-8")
    assert "<title>SIMULATED: creep at 1.5 V</title>" in page
    assert "creep, time constant" in page and "Creep at 1.5 V" in page
    assert (lab.folder / "out/creep/figures/creep.svg").is_file()
    assert not re.search("<th>(Paper|Recomputed|Agreement)</th>", page)
    assert "left out" not in page


def test_the_recording_can_be_sensed_and_exported(lab) -> None:
    lines = (lab.folder / "creep-capacitance.csv").read_text().splitlines()
    assert len(lines) == 1 + 2200  # 22 s, one block each 10 ms
    assert any("creep" in path.name for path in (lab.folder / "out/creep-csv").rglob("*.csv"))


def test_a_drive_that_was_not_declared_stops_the_run(lab) -> None:
    (module,) = lab.folder.glob("environment/lib/python*/site-packages/haselab_myexperiment")
    source = (module / "__init__.py").read_text()
    changed = source.replace(
        'player.play("creep", drive.values_v', 'player.play("creep", 1.2 * drive.values_v'
    )
    assert changed != source
    (module / "__init__.py").write_text(changed)
    done = lab.run("haselab run haselab-myexperiment/creep.toml --rig rig.toml --out out/more")
    (module / "__init__.py").write_text(source)
    assert done.returncode == 2
    assert "declares drives of 0 to 1.5 V, but plays 1.8 V" in done.stderr
