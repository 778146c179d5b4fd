"""Verdicts, what was set in the twin, and the verdict on the reading."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import Estimate
from haselab.rig.twin.config import twin_of_reading
from haselab.study.definition import builtin_study
from haselab.study.results import Quantity, axis_interpretation, quantities, quantity_rows, verdict
from haselab.study.simulated.truth import follows_from_twin, is_simulated, set_in_twin

HZ = twin_of_reading("hz").model_dump(mode="json")
BENCH = {"kind": "bench", "daq": {}}


@given(
    st.floats(0.1, 10.0), st.floats(-20.0, 20.0), st.floats(0.0, 5.0),
    st.sampled_from([1.0, (0.5, 2.0)]),
)  # fmt: skip
def test_a_verdict_is_where_the_whole_interval_lies(
    scale: float, value: float, half: float, paper: float | tuple[float, float]
) -> None:
    printed = (scale * paper[0], scale * paper[1]) if isinstance(paper, tuple) else scale * paper
    low, high = printed if isinstance(printed, tuple) else (0.9 * printed, 1.1 * printed)
    estimate = Estimate(value, half, (value - half, value + half), "")
    points = [value - half + 2.0 * half * k / 200.0 for k in range(201)]
    inside = [low <= point <= high for point in points]
    found = verdict(Quantity("", "", printed), estimate)
    if all(inside) and found != "inconclusive":
        assert found == "agrees"
    if any(inside):
        assert found != "disagrees"
    if not all(inside):
        assert found != "agrees"
    if found == "inconclusive":
        assert (value - half < low <= value + half) or (value - half <= high < value + half)


def test_a_wide_interval_agrees_with_nothing() -> None:
    """Before, -0.63 +- 0.2 "agreed" with -0.28 because their intervals touched."""
    row = quantities()["S14.a2"]
    assert verdict(row, Estimate.normal(-0.63, 0.2, "V")) == "inconclusive"
    assert verdict(row, Estimate.normal(-0.63, 0.01, "V")) == "disagrees"


def test_a_result_without_a_number_decides_nothing() -> None:
    missing = Estimate(math.nan, math.nan, (math.nan, math.nan), "")
    assert verdict(quantities()["S20.zeta"], missing) == "inconclusive"
    assert verdict(quantities()["S16.mu"], missing) == "not in paper"


def test_a_distance_of_zero_is_judged_by_the_stated_width() -> None:
    row = quantities()["S18.centre_offset"]
    assert verdict(row, Estimate.normal(0.02, 0.01, "")) == "agrees"
    assert verdict(row, Estimate.normal(0.5, 0.01, "")) == "disagrees"


def rows_of(config: dict[str, object]) -> dict[str, dict[str, object]]:
    names = ("S16.mu", "S20.omega_n", "S24.error_open")
    found = {key: Estimate.normal(1.0, 0.1, "") for key in names}
    rows = quantity_rows(found, {}, config, {"S20.omega_n": 1.05})
    return {str(row["id"]): row for row in rows}


def test_rows_of_the_default_twin_say_what_was_set_in_it() -> None:
    rows = rows_of(HZ)
    assert rows["S20.omega_n"]["set_in_twin"] == "frequency of the interpretation"
    assert "set_in_twin" not in rows["S24.error_open"]
    assert rows["S20.omega_n"]["noise_free"] == 1.05
    assert rows["S16.mu"]["truth"] == 15.6e3
    assert "truth" not in rows["S20.omega_n"]


HEAVIER = twin_of_reading("hz").model_copy(
    update={"load": twin_of_reading("hz").load.model_copy(update={"mass_kg": 0.27})}
)


def test_a_twin_changed_a_little_still_determines_what_follows_from_its_parameters() -> None:
    """Before, 0.02 kg more turned results that were put in into findings."""
    assert is_simulated(HEAVIER.model_dump(mode="json"))
    assert set_in_twin(HEAVIER, "S20.omega_n") == ""
    rows = rows_of(HEAVIER.model_dump(mode="json"))
    assert rows["S20.omega_n"]["follows_from_twin"] == "mass, inertia and stiffness"
    assert rows["S24.error_open"]["follows_from_twin"] == "viscosity"


def test_every_printed_result_of_a_twin_is_marked() -> None:
    """What has a value in the paper was set in the study or follows from the twin."""
    found = {key: Estimate.normal(1.0, 0.1, "") for key in quantities()}
    for twin in (twin_of_reading("rad"), HEAVIER):
        for row in quantity_rows(found, {}, twin.model_dump(mode="json")):
            marks = {"set_in_twin", "set_in_study", "follows_from_twin"} & set(row)
            assert marks or row["verdict"] == "not in paper", row["id"]
            assert len(marks) <= 1, row["id"]


def test_what_a_study_fixes_is_marked_as_set_in_it() -> None:
    reference = builtin_study()
    study = reference.model_copy(
        update={
            "operating_point": reference.operating_point.model_copy(update={"baseline_v": 1.2}),
            "static_load": reference.static_load.model_copy(update={"segments": 2}),
        }
    )
    found = {key: Estimate.normal(1.0, 0.1, "") for key in ("S18.baseline", "S17.region_low")}
    for fixed, words in ((study, "set_in_study"), (None, "set_in_twin")):
        for row in quantity_rows(found, {}, HZ, study=fixed):
            assert {"set_in_study", "set_in_twin", "follows_from_twin"} & set(row) == {words}
    maps = {"S14.a1": Estimate.normal(1.0, 0.1, "")}  # at another operating point
    assert "follows_from_twin" in quantity_rows(maps, {}, HZ, study=study)[0]


def test_a_second_row_of_a_printed_quantity_names_the_first() -> None:
    """Eq. 8 alone and beside the slow branch have one printed gain."""
    same = {key: row.same_as for key, row in quantities().items() if row.same_as}
    assert same["S20.eq8_gain"] == "S20.gain"
    assert set(same.values()) <= set(quantities()) - set(same)
    for key in ("S10.rise_printed_chain", "S24.rise_delayed"):  # the paper has no such trial
        assert quantities()[key].paper is None


def test_no_mark_is_for_a_result_that_does_not_exist() -> None:
    assert {key for key in quantities() if follows_from_twin(key)} >= {"S15.slope", "S24.rise_open"}
    assert follows_from_twin("S20.delay") == follows_from_twin("S21.kp") == ""


def test_a_bench_is_neither_simulated_nor_set() -> None:
    assert not is_simulated(BENCH)
    row = rows_of(BENCH)["S16.mu"]
    assert not {"truth", "set_in_twin"} & set(row)


@pytest.mark.parametrize(("config", "word"), [(HZ, "No conclusion"), (BENCH, "The data support")])
def test_only_a_bench_decides_the_reading(config: dict[str, object], word: str) -> None:
    names = {"S20.omega_n": 32.1, "S19.omega_0": 32.0, "S19.decay_1": 3.6, "S19.decay_2": 4.2}
    found = axis_interpretation({k: Estimate.normal(v, 0.1, "") for k, v in names.items()}, config)
    assert found["verdict"].startswith(word)
    assert "he data support Hz" in found["verdict"]


def test_the_decay_under_each_reading_has_the_printed_damping() -> None:
    names = ("S20.omega_n", "S19.omega_0", "S19.decay_1", "S19.decay_2")
    found = axis_interpretation({key: Estimate.normal(4.0, 0.1, "") for key in names}, BENCH)
    row = found["evidence"][-1]
    assert row["rad"] == pytest.approx(0.09 * 5.11)
    assert row["hz"] / row["rad"] == pytest.approx(2.0 * math.pi)


def test_a_rise_time_without_value_has_its_reason_first() -> None:
    nothing = Estimate(math.nan, math.nan, (math.nan, math.nan), "s")
    found = {"S25.rise_pid": nothing, "S25.rise_observer": Estimate.normal(0.1, 0.01, "s")}
    notes = {row["id"]: row["note"] for row in quantity_rows(found, {"S25.rise_pid": "one"}, HZ)}
    assert notes["S25.rise_pid"].startswith("no value: averaging out the ringing also removed the")
    assert "; one; ringing averaged out" in notes["S25.rise_pid"]
    assert "no value" not in notes["S25.rise_observer"]
