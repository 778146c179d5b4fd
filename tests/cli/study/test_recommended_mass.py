"""A mass that the operating point recommends comes with what would keep it from being hung."""

from __future__ import annotations

from typing import Any

import pytest

from haselab.cli.study import recommended_mass
from haselab.cli.study.recommended_mass import with_mass_limit
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import describe
from haselab.study.definition import builtin_study
from haselab.study.feasibility import check_study, rating_of_twin
from haselab.study.pipeline import Findings

STUDY = builtin_study()
HZ = twin_of_reading("hz")


def findings(mass_kg: float | None) -> Findings:
    point: dict[str, Any] = {"stretch": 1.4}
    if mass_kg is not None:
        point["recommended_mass_kg"] = mass_kg
    figures = {"static": {"operating_point": point}}
    return Findings({}, {"S18.baseline": "hang it"}, figures)


def note(mass_kg: float | None, rig_config: dict[str, Any]) -> str:
    return with_mass_limit(findings(mass_kg), STUDY, rig_config).notes["S18.baseline"]


def accepted(mass_kg: float) -> bool:
    config = TwinConfig.model_validate(
        {**HZ.model_dump(), "load": {**HZ.load.model_dump(), "mass_kg": mass_kg}}
    )
    return check_study(STUDY, describe(config), rating_of_twin(config, STUDY)).ok


@pytest.mark.long
def test_a_mass_that_would_be_refused_is_said_with_the_largest_one_that_is_not() -> None:
    """Before, "hang about 0.35 kg" led to a refusal."""
    printed = note(0.35, HZ.model_dump(mode="json"))
    assert "with that mass the study would be refused (field is " in printed
    best_kg = float(printed.rpartition("accepted is ")[2].removesuffix(" kg"))
    assert accepted(best_kg) and not accepted(best_kg + 0.01)


def test_a_mass_that_is_accepted_is_said_to_be() -> None:
    assert note(0.2, HZ.model_dump(mode="json")) == (
        "hang it; the study can be played with that mass"
    )


def test_on_a_bench_the_note_says_to_check_first() -> None:
    assert "plan feasibility" in note(0.35, {"kind": "bench"})


def test_without_a_recommendation_nothing_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recommended_mass, "rating_of_twin", None)
    assert note(None, HZ.model_dump(mode="json")) == "hang it"
