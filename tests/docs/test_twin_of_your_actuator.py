"""A twin with another shell and mass: the section of docs/study.md, its commands in order."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import equilibrium_m
from haselab.rig.twin.config import load_twin

PAGE = Path(__file__).resolve().parents[2] / "docs" / "study.md"
(SECTION,) = re.findall(
    r"### A twin of your actuator\n(.*?)\nA study that the bench", PAGE.read_text(), re.DOTALL
)
(BLOCK,) = re.findall(r"```\n(haselab twin new.*?)```", SECTION, re.DOTALL)
(STUDY,) = re.findall(r"```toml\n(.*?)```", SECTION, re.DOTALL)


@pytest.fixture(scope="module")
def shell(make_shell):
    made = make_shell("twin")
    (made.folder / "shell-study.toml").write_text(STUDY)
    made.run_all(BLOCK.strip().splitlines())
    return made


def test_the_file_describes_the_shell_and_the_mass_of_the_command(shell):
    twin = load_twin(shell.folder / "shell.toml")
    assert (twin.shell.length_m, twin.shell.width_m, twin.shell.thickness_m) == (
        0.058, 0.055, 1.1e-3
    )  # fmt: skip
    assert twin.load.mass_kg == 0.18
    assert twin.viscosity.share == (0.02, 0.02, 0.5)


def test_the_load_curve_is_that_of_the_shell(shell):
    """Branches of 1 and 3.2 s (times 1.5) creep on after 20 s: 0.5 e^(-20 / 4.8) of a step."""
    drawn = json.loads((shell.folder / "out/shell/analysis.json").read_text())["static"]
    law = load_twin(shell.folder / "shell.toml").law
    expected = [equilibrium_m(law, 0.0, load_n) / law.free_length_m for load_n in drawn["load_n"]]
    step = float(np.diff(expected).max())
    assert len(expected) == 10
    np.testing.assert_allclose(
        drawn["stretch"], expected, atol=0.5 * np.exp(-20 / 4.8) * step + 4e-4
    )
