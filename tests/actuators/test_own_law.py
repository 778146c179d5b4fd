"""Faults of a law of another package are named, not reported as faults of haselab."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.actuators import registry
from haselab.actuators.registry import ACTUATORS, actuator_law
from haselab.base import InputError
from haselab.cli.main import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "plugins" / "haselab-myactuator"
SOURCE = (EXAMPLE / "src" / "haselab_myactuator.py").read_text()
RISE = '        """Thickness at constant volume."""\n'


@pytest.fixture
def law(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], Any]]:
    """Install the example with a change, and return its class."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def install(old: str, new: str) -> Any:
        assert SOURCE.count(old) == 1
        (tmp_path / "haselab_myactuator.py").write_text(SOURCE.replace(old, new))
        metadata = tmp_path / "haselab_myactuator-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: a\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(
            f"[{ACTUATORS.group}]\ndea-strip = haselab_myactuator:DeaStrip\n"
        )
        ACTUATORS.others.cache_clear()
        return ACTUATORS.find("dea-strip")

    yield install
    sys.modules.pop("haselab_myactuator", None)
    ACTUATORS.others.cache_clear()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (RISE, RISE + "        raise ValueError('no gap')\n",
         r"^gap_m of the actuator kind 'dea-strip' \(DeaStrip\) failed: ValueError: no gap"),
        (RISE, RISE + "        raise SystemExit(1)\n", r"failed: RuntimeError: it called sys"),
        (RISE, RISE + "        return None\n",
         r"^gap_m of .* returns None for an array of 3 lengths\. Return an array with a number"),
        (RISE, RISE + "        return np.ones(2)\n", r"^gap_m of .* returns .* for an array of 3"),
        ("return self.across_m\n", "return float('nan')\n",
         r"^width_m of .* is nan\. Return a finite number there\."),
        ("return Losses(", "return str(", r"^losses of .* failed: TypeError: "),
        ("return self.free_m\n", "return None\n", r"^free_length_m of .* is None\. Return a"),
    ],
)  # fmt: skip
def test_a_law_that_fails_or_returns_something_else_is_refused(
    law: Callable[[str, str], Any], old: str, new: str, said: str
) -> None:
    law(old, new)
    with pytest.raises(InputError, match=said):
        actuator_law("dea-strip", {})


def test_a_failure_in_the_middle_of_a_command_names_class_and_method(
    law: Callable[[str, str], Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    beyond = "        if np.size(length_m) > 3:\n            raise KeyError('nothing')\n"
    law(RISE, RISE + beyond)
    with pytest.raises(SystemExit) as stop:
        main(["run", str(EXAMPLE / "study.toml"), "--rig", str(EXAMPLE / "rig.toml"),
              "--out", str(tmp_path / "out")])  # fmt: skip
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error == (
        "haselab: DeaStrip.gap_m of the package 'haselab_myactuator' failed: KeyError: 'nothing'. "
        "Repair it; run again with --debug for the traceback.\n"
    )


def test_the_laws_of_haselab_are_not_called_before_they_are_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "_check_returned", lambda law: pytest.fail("was called"))
    found = actuator_law("planar-hasel", {})
    assert dataclasses.is_dataclass(found) and np.isfinite(found.free_length_m)
