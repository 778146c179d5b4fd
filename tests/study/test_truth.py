"""Analysis never sees the twin's truth: it imports nothing of it, and follows another bench."""

from __future__ import annotations

import ast
import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import haselab
from haselab.rig.twin.config import PLANAR_SECTIONS, TwinConfig
from haselab.study.simulated.truth import twin_of, used_configuration

SOURCE = Path(haselab.__file__).parent
ROOMS = ("signals", "models", "sensing", "identify", "control", "tracking", "runtime", "report")
SIMULATED = "study/simulated/"  # knows the twin: true parameters, runs without noise
# These play on the bench, or judge it before a run; they fit nothing.
PLAYERS = {"study/feasibility.py", "study/run.py", "study/chip/loops.py"}


def analysing() -> list[str]:
    files = [path for room in (*ROOMS, "study") for path in (SOURCE / room).rglob("*.py")]
    names = {path.relative_to(SOURCE).as_posix() for path in files} - PLAYERS
    return sorted(name for name in names if not name.startswith(SIMULATED))


def imported(source: str) -> set[str]:
    """Full names of all modules and members that a file imports, wherever in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@pytest.mark.parametrize("path", analysing())
def test_a_module_that_analyses_does_not_know_the_twin(path: str) -> None:
    names = imported((SOURCE / path).read_text())
    assert not {n for n in names if "rig.twin" in n or n.endswith(("._twin", "._camera"))}
    assert not {n for n in names if n.startswith("importlib.import_module")}


def test_the_walk_sees_imports_inside_functions() -> None:
    hidden = "def f():\n    from haselab.rig.twin.config import TwinConfig\n"
    assert imported(hidden) == {"haselab.rig.twin.config.TwinConfig"}


def inside(rows: dict[str, dict[str, Any]]) -> list[bool]:
    return [low <= row["noise_free"] <= high for row, low, high in intervals(rows)]


def intervals(rows: dict[str, dict[str, Any]]) -> list[tuple[dict[str, Any], float, float]]:
    """Rows with a value without noise and an interval; the chip's are not played without noise."""
    found = [(row, *row["measured"]["ci95"]) for row in rows.values() if row.get("noise_free")]
    return [(row, low, high) for row, low, high in found if low is not None and high is not None]


def test_another_bench_is_found_within_its_own_intervals(played: Callable[[str], Any]) -> None:
    """Some 70 intervals of 95 %: 9 or more outside have a probability of 1 %."""
    rows = played("other").rows
    assert len(intervals(rows)) > 60
    assert inside(rows).count(False) <= 8
    for row, *_ in intervals(rows):
        off, std = abs(row["measured"]["value"] - row["noise_free"]), row["measured"]["std"]
        assert off <= 4.0 * std, row["id"]


# The mass is 0.8, the damper 1.5, the electrodes 1.2 times the usual ones. The stiffness is between
# 1 and 1.2 times; large swings and the branches' part of the damping are good for a tenth.
LIGHTER = math.sqrt(1.0 / 0.8)
STIFFER = math.sqrt(1.2)
RATIOS = {
    "S19.omega_0": (LIGHTER / 1.1, 1.1 * LIGHTER * STIFFER),
    "S20.omega_n": (LIGHTER / 1.1, 1.1 * LIGHTER * STIFFER),
    "S19.decay_1": (1.5 / 0.8 / 1.1, 1.1 * 1.5 / 0.8),
    "S20.zeta": (1.5 / 0.8 / LIGHTER / STIFFER / 1.1, 1.1 * 1.5 / 0.8 / LIGHTER),
}


@pytest.mark.parametrize("key", RATIOS)
def test_another_bench_gives_other_answers(played: Callable[[str], Any], key: str) -> None:
    other, usual = (played(name).rows[key]["measured"]["value"] for name in ("other", "hz"))
    assert RATIOS[key][0] < other / usual < RATIOS[key][1]


def test_stiffer_electrodes_stretch_less_under_the_same_load(played: Callable[[str], Any]) -> None:
    """The heaviest load stretches by 1/1.2 of the usual if electrodes were all, else by more."""

    def longest(name: str) -> float:
        drawn = json.loads((played(name).folder / "analysis.json").read_text())
        return float(max(drawn["static"]["stretch"]))

    assert 1.0 / 1.2 < (longest("other") - 1.0) / (longest("hz") - 1.0) < 1.0


def test_the_shell_is_the_same_on_both_benches(played: Callable[[str], Any]) -> None:
    """Only the electrodes were made stiffer: the fit must not put that on the shell."""
    other, usual = (played(name).rows["S16.mu"]["measured"] for name in ("other", "hz"))
    spread = (other["std"] ** 2 + usual["std"] ** 2) ** 0.5
    assert abs(other["value"] - usual["value"]) <= 4.0 * spread


def test_a_dielectric_of_higher_permittivity_is_seen_as_more_capacitance(
    played: Callable[[str], Any],
) -> None:
    """C = permittivity * length^p with p = 3.33 on both; eq. 5 is a line over the triangle's span.

    Its slope is near that of the secant between the ends of the span, which lie elsewhere about
    each baseline; how the samples lie between them is good for some per cent on both alike.
    """

    def secant(name: str) -> float:
        low, high = (
            played(name).rows[f"S18.strain_{end}"]["measured"]["value"] for end in ("min", "max")
        )
        return float((high - low) / ((1.0 + high) ** 3.33 - (1.0 + low) ** 3.33))

    def length_m(name: str) -> float:
        known = tomllib.loads((played(name).folder / "actuator.toml").read_text())
        return float(known["actuator"]["geometry"]["zero_length_m"])

    other, usual = (played(name).rows["S15.slope"]["measured"]["value"] for name in ("other", "hz"))
    expected = 3.0 / 3.5 * (length_m("hz") / length_m("other")) ** 3.33
    expected *= secant("other") / secant("hz")
    assert other / usual == pytest.approx(expected, rel=0.03)


def test_the_provenance_of_another_kind_has_no_parts_of_the_planar_twin() -> None:
    peano = TwinConfig(kind="peano-hasel").model_dump(mode="json")
    used = used_configuration(peano)
    assert set(peano) - set(used) == {*PLANAR_SECTIONS, "reading"}
    assert {"actuator", "load", "amplifier", "acquisition", "camera"} <= set(used)
    again = twin_of(used)  # 'firmware simulate' finds the twin of a run there
    assert again is not None and again.model_dump(mode="json") == peano
    planar = TwinConfig().model_dump(mode="json")
    assert used_configuration(planar) == planar
    for other in ({}, {"kind": "bench", "daq": {}}):
        assert twin_of(other) is None and used_configuration(other) == other
