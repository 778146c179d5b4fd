"""What a run lacks of the reference study, and where it differs from it, in words."""

from __future__ import annotations

from typing import Any

import pytest

from haselab.rig.twin.config import Origin, twin_of_reading
from haselab.study.definition import builtin_study
from haselab.study.paper.quantity_table import quantities
from haselab.study.paper.scope import changes_text, not_played
from haselab.study.results import rows_of

REFERENCE = builtin_study()
STUDY = REFERENCE.model_dump(mode="json")
ON_CHIP = {key for key in quantities() if key.startswith(("S26.", "S28."))}


def header(study: Any = None, twin: Any = None) -> dict[str, Any]:
    twin = twin or twin_of_reading("hz")
    return {"study": study or STUDY, "rig_config": twin.model_dump(mode="json")}


def test_a_whole_run_lacks_nothing() -> None:
    assert not_played(set(quantities()), {}, REFERENCE) == []


def test_results_of_an_own_controller_are_missing_only_where_the_study_names_one() -> None:
    own = {"S25.rise_own", "S25.overshoot_own", "S25.error_own"}
    assert not_played(set(quantities()) - own, {}, REFERENCE) == []
    control = REFERENCE.control.model_copy(update={"kind": "open-loop"})
    with_own = REFERENCE.model_copy(update={"control": control})
    (found,) = not_played(set(quantities()) - own, {}, with_own)
    assert set(found["ids"]) == own


def test_an_experiment_of_the_chip_that_is_missing_is_named_with_its_reason() -> None:
    figures = {"chip": {"left_out": "no compiler."}, "miniature": {"left_out": "no compiler."}}
    (found,) = not_played(set(quantities()) - ON_CHIP, figures, REFERENCE)
    assert set(found["ids"]) == ON_CHIP
    assert found["reason"] == "no compiler."


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("paper_chain_trials", "S10.rise_printed_chain"),
        ("extra_delay_trials", "S24.rise_delayed"),
        ("saturating_trials", "S22.recovery_time"),
        ("pi_trials", "S24.rise_closed"),
        ("pid_trials", "S25.rise_pid"),
    ],
)
def test_trials_that_a_study_leaves_out_are_named_with_their_setting(
    setting: str, key: str
) -> None:
    steps = REFERENCE.steps.model_copy(update={setting: 0})
    study = REFERENCE.model_copy(update={"steps": steps})
    (found,) = not_played(set(quantities()) - {key}, {}, study)
    assert found == {"ids": [key], "reason": f"steps.{setting} is 0 in this study."}


def test_trials_of_number_0_are_not_missing_for_the_reason_that_the_fit_states() -> None:
    """A study without a plant has no design, but its PI trials were left out before that."""
    steps = REFERENCE.steps.model_copy(update={"pi_trials": 0})
    study = REFERENCE.model_copy(update={"steps": steps})
    keys = {"S24.error_closed", "S25.error_pid"}
    why = dict.fromkeys(keys, "needs [chirp], which is not in this study")
    found = not_played(set(quantities()) - keys, {}, study, why)
    assert found == [
        {"ids": ["S24.error_closed"], "reason": "steps.pi_trials is 0 in this study."},
        {"ids": ["S25.error_pid"], "reason": "needs [chirp], which is not in this study"},
    ]


def test_the_reference_study_on_a_default_twin_has_no_changes() -> None:
    for reading in ("hz", "rad"):
        assert changes_text(header(twin=twin_of_reading(reading))) == ""


def test_a_quick_run_says_so_and_which_rows_it_changes() -> None:
    printed = changes_text(header(builtin_study(quick=True).model_dump(mode="json")))
    assert printed.startswith("This run used the quick form of the study, which changes rows ")
    assert "S19, S20, S10, S21 to S25: " in printed
    assert "free_response.record_s 6 instead of 8" in printed


def test_changed_counts_a_fixed_baseline_and_another_twin_are_named() -> None:
    study = {
        **STUDY,
        "operating_point": {"baseline_v": 1.2},
        "steps": {**STUDY["steps"], "open_trials": 1},
    }
    load = twin_of_reading("hz").load.model_copy(update={"mass_kg": 0.27})
    printed = changes_text(header(study, twin_of_reading("hz").model_copy(update={"load": load})))
    assert "another study, which changes rows S18, S10, S21 to S25" in printed
    assert "operating_point.baseline_v 1.2 instead of found" in printed
    assert "steps.open_trials 1 instead of 6" in printed
    assert "load.mass_kg 0.27 instead of 0.25" in printed


def test_the_identified_actuator_of_a_twin_is_named() -> None:
    origin = Origin(actuator="leg", file="A.toml", draw=3)
    load = twin_of_reading("hz").load.model_copy(update={"mass_kg": 0.27})
    twin = twin_of_reading("hz").model_copy(update={"load": load, "origin": origin})
    assert changes_text(header(twin=twin)) == (
        "This run used the twin of the identified actuator 'leg' (A.toml, drawn with seed 3) "
        "instead of the default twin of row S1: load.mass_kg 0.27 instead of 0.25."
    )


def test_another_rig_than_the_twin_is_said() -> None:
    printed = changes_text({"study": STUDY, "rig_config": {"kind": "bench"}})
    assert printed == "This run used another rig than the twin, which rows S1 and S4 describe."


def test_another_study_does_not_list_additional_trials_that_it_does_not_request() -> None:
    """They are the paper's, or tests of one loop: nobody misses them."""
    study = REFERENCE.model_copy(update={"name": "mine"})
    off = {"paper_chain_trials": 0, "extra_delay_trials": 0, "saturating_trials": 0, "pi_trials": 0}
    steps = REFERENCE.steps.model_copy(update=off)
    mine = study.model_copy(update={"steps": steps})
    found = {key: part["reason"] for part in not_played((), {}, mine) for key in part["ids"]}
    assert not [key for key in found if key.startswith("S10.")]
    assert not {"S24.rise_delayed", "S22.recovery_time"} & set(found)
    assert found["S24.rise_closed"] == "steps.pi_trials is 0 in this study."
    asked = {key for part in not_played((), {}, study) for key in part["ids"]}
    assert {"S10.rise_printed_chain", "S24.rise_delayed", "S22.recovery_time"} <= asked


def test_results_in_the_papers_unit_are_those_of_a_planar_hasel() -> None:
    study = REFERENCE.model_copy(update={"name": "mine"})
    planar, peano = rows_of(study), rows_of(study, "peano-hasel")
    assert set(planar) - set(peano) == {key for key in planar if key.startswith("S15.")}
    assert rows_of(REFERENCE) == rows_of(REFERENCE, "peano-hasel")  # its table is the paper's
