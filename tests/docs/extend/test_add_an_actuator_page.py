"""The page on actuators: its package in a fresh environment, its commands in order, its Python."""

from __future__ import annotations

import doctest
import importlib
import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import ActuatorLaw, equilibrium_m

pytest.importorskip("setuptools", reason="builds the package of the page")
pytest.importorskip("pip", reason="installs the package of the page")

ROOT = Path(__file__).resolve().parents[3]
PACKAGE = ROOT / "examples" / "plugins" / "haselab-myactuator"
MODULE = PACKAGE / "src" / "haselab_myactuator.py"
PAGE = ROOT / "docs" / "extend" / "add-an-actuator.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    ((?:cp|pip|haselab) .*)", TEXT, re.MULTILINE)


@pytest.fixture(scope="module")
def shell(make_shell):
    made = make_shell("actuator")
    ignore = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(PACKAGE, made.folder / PACKAGE.relative_to(ROOT), ignore=ignore)
    before = made.run("haselab twin new --kind dea-strip")
    assert before.returncode == 2
    assert "No actuator 'dea-strip' is registered" in before.stderr
    made.run_all(COMMANDS)
    return made


@pytest.fixture
def law(monkeypatch: pytest.MonkeyPatch) -> ActuatorLaw:
    monkeypatch.syspath_prepend(str(MODULE.parent))
    made: ActuatorLaw = importlib.import_module(MODULE.stem).DeaStrip()
    return made


def test_the_page_has_what_is_run_here():
    assert len(COMMANDS) == 5
    assert f"in {len(MODULE.read_text().splitlines())} lines" in TEXT
    assert len(MODULE.read_text().splitlines()) <= 120
    (tables,) = re.findall(r"```toml\n(name = .*?)```", TEXT, re.DOTALL)
    assert tomllib.loads(tables) == tomllib.loads((PACKAGE / "strip.toml").read_text())
    (entry,) = re.findall(r"```toml\n(\[project.*?)```", TEXT, re.DOTALL)
    assert entry in (PACKAGE / "pyproject.toml").read_text()


def test_the_python_of_the_page_runs():
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    example = doctest.DocTestParser().get_doctest(block, {}, PAGE.name, str(PAGE), 0)
    assert doctest.DocTestRunner().run(example) == (0, 6)


def test_the_written_twin_has_the_parameters_of_the_law(shell, law):
    twin = tomllib.loads((shell.folder / "strip.toml").read_text())
    assert twin["kind"] == law.kind
    assert twin["actuator"] == {about.name: getattr(law, about.name) for about in law.described()}
    assert twin["load"]["mass_kg"] == 0.15


def test_the_measured_load_curve_is_that_of_the_law(shell, law):
    """A camera frame resolves 1e-4 of stretch; 0.2 e^(-15 / 2.4) of a step of 0.06 is left."""
    drawn = json.loads((shell.folder / "out/strip/analysis.json").read_text())["static"]
    expected = [equilibrium_m(law, 0.0, load_n) / law.free_length_m for load_n in drawn["load_n"]]
    assert len(expected) == 8 and expected[-1] > 1.4
    np.testing.assert_allclose(drawn["stretch"], expected, atol=2e-4)


def test_the_results_are_those_of_a_simulation_and_claim_nothing_of_the_planar_hasel(shell):
    found = json.loads((shell.folder / "out/strip/results.json").read_text())
    rows = {row["id"]: row for row in found["quantities"]}
    assert found["simulated"] is True
    assert {"S13.peak_drift", "S14.zero", "S17.region_low"} <= set(rows)
    assert not any(key.startswith("S15.") for key in rows)  # of the paper's sensing chain
    for row in rows.values():
        assert not {"truth", "set_in_twin"} & set(row)
        low, high = row["measured"]["ci95"]
        # Twice the interval: the noise-free run of 21 rows may leave one of them.
        assert abs(row["noise_free"] - row["measured"]["value"]) <= high - low


def test_a_table_of_another_kind_of_actuator_is_refused(shell):
    (shell.folder / "wrong.toml").write_text('kind = "dea-strip"\n[shell]\nlength_m = 0.05\n')
    (shell.folder / "wrong-rig.toml").write_text('kind = "twin"\ntwin = "wrong.toml"\n')
    done = shell.run("haselab plan feasibility haselab-myactuator/study.toml --rig wrong-rig.toml")
    assert done.returncode == 2
    assert "the table shell describes a planar-hasel" in done.stderr
