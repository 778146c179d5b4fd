"""A twin with another shell and mass: the section of docs/study/study.md, its commands in order."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import equilibrium_m
from haselab.rig.twin.twin_file import load_twin

PAGE = Path(__file__).resolve().parents[3] / "docs" / "study" / "study.md"
(SECTION,) = re.findall(
    r"## A twin of your actuator\n(.*?)\nA study that the bench", PAGE.read_text(), re.DOTALL
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


def test_the_load_curve_lies_between_those_of_a_new_and_a_softened_shell(shell):
    """Hanging a weight overshoots, which softens the shell more than its length at rest would.

    The branch of 3.2 s (times 1.5) takes a third of a step and has e^(-20 / 4.8) of it left after
    20 s. So has the free length, which is measured after the weight of the bench has hung, and by
    which all lengths are divided. A frame resolves 1e-4 of stretch.
    """
    drawn = json.loads((shell.folder / "out/shell/analysis.json").read_text())["static"]
    law = load_twin(shell.folder / "shell.toml").law
    longest_m = law.length_limits_m.high
    new, softened = (
        np.array([equilibrium_m(law, 0.0, load_n, longest_m=m) for load_n in drawn["load_n"]])
        / law.free_length_m
        for m in (None, longest_m)
    )
    hung = equilibrium_m(law, 0.0, 0.18 * 9.81) / law.free_length_m - 1.0
    crept = 0.5 / 1.5 * np.exp(-20 / 4.8)
    left = crept * (float(np.diff(new).max()) + new * hung) + 4e-4
    measured = np.array(drawn["stretch"])
    assert measured.size == 10 and measured[-1] > 2.0
    assert (measured > new - left).all()
    assert (measured < softened + left).all()
    assert (softened - new).max() < 0.05  # so that the bounds say something
