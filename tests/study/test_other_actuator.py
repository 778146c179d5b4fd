"""What a study knows of a twin of another kind than the planar HASEL."""

import math

import pytest

from haselab.base import InputError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import describe
from haselab.study.definition import Study
from haselab.study.feasibility import check_study, rating_of_twin
from haselab.study.simulated.truth import parameters, set_in_twin, twin_of

TRIANGLE = {
    "low_v": 0.0, "high_v": 2.0, "frequency_hz": 0.25, "cycles": 2, "skipped_cycles": 1,
    "frame_rate_hz": 100.0,
}  # fmt: skip


def stack(**values: float) -> TwinConfig:
    data = {"kind": "dea-stack", "actuator": values, "load": {"mass_kg": 0.1}}
    return TwinConfig.model_validate(data)


@pytest.fixture
def study() -> Study:
    return Study.model_validate({"name": "a triangle", "triangle": TRIANGLE})


def test_a_stack_that_withstands_the_study_is_rated_by_its_law(study):
    twin = stack()
    rating = rating_of_twin(twin, study)
    assert check_study(study, describe(twin), rating).ok
    # It contracts: capacitance and field are largest at 10 kV, where the layers are thin.
    law = twin.law
    shortest_m = rating.thickness_m * 50.0
    assert 0.7 < shortest_m / law.free_length_m < 1.0
    assert rating.capacitance_f == pytest.approx(float(law.capacitance_f(shortest_m)), rel=1e-3)
    assert rating.breakdown_v_per_m == 60e6


def test_a_stack_that_collapses_is_refused_before_it_is_energised(study):
    twin = stack(shear_modulus_pa=4e3)
    rating = rating_of_twin(twin, study)
    assert math.isinf(rating.stretch)
    with pytest.raises(InputError, match=r"stretch is infinite in triangle.* Lower the voltage"):
        check_study(study, describe(twin), rating).require()


def test_no_result_was_set_in_a_twin_of_another_kind():
    twin = twin_of(stack().model_dump(mode="json"))
    assert twin is not None and twin.kind == "dea-stack"
    assert parameters(twin) == {}
    assert set_in_twin(twin, "S15.slope") == ""
    assert set_in_twin(TwinConfig(), "S15.slope") != ""
