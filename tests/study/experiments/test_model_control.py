"""Rows S25 (observer), S27 and S30: played with a known actuator, and computed from a recording."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, equilibrium_m
from haselab.base import Estimate, InputError, SilentProgress
from haselab.controllers import known_actuator
from haselab.controllers.adaptive.hybrid import HybridController
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.models.actuator import ActuatorTables
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.store.toml import validated
from haselab.study.definition import Study, builtin_study, builtin_table
from haselab.study.experiments.model_control import ModelControlTest
from haselab.study.fits.maps import Maps
from haselab.study.fits.model_control import outer_results, set_points
from haselab.study.fits.observe import Observation
from haselab.study.fits.static import Static
from haselab.study.physical.session import FOLDER, NOT_HERE, analysed, model_study, with_model_rows
from haselab.study.pipeline import Findings
from haselab.study.run import RunOptions, run_study
from haselab.study.tables import ModelControl

# A twin that does not soften, so its law is the same in all of the test.
CONFIG = validated(TwinConfig, {"reading": "hz", "mullins": {"share": 0.0}}, "the test")
LAW, MASS_KG, OTHER_KG, GAIN, CARRIER_V = CONFIG.law, 0.25, 0.2, 5000.0, 100.0
ZERO_M = equilibrium_m(LAW, 5200.0, GRAVITY_M_S2 * MASS_KG)
BUILTIN = builtin_table("model-control", ModelControl)
OUTER = {"linear_high": 0.18, "outer_mass_kg": 0.48}


def tables() -> ActuatorTables:
    """What a perfect identification of the twin would write to its actuator file."""
    strain = np.linspace(-0.06, 0.22, 200)
    farad = LAW.capacitance_f(ZERO_M * (1.0 + strain))
    cubic, curvature, slope, offset = np.polyfit(1e9 * farad, strain, 3).tolist()
    values = {**fitted_parameters(LAW), "load.added_inertia_kg": CONFIG.load.added_inertia_kg}
    return validated(ActuatorTables, {
        "actuator": {"geometry": {"zero_length_m": ZERO_M}},
        "sensing": {"strain_map": {
            "slope_per_f": 1e9 * slope, "offset": offset, "curvature_per_f2": 1e18 * curvature,
            "cubic_per_f3": 1e27 * cubic, "range_f": [float(farad.min()), float(farad.max())],
        }},
        "drive": {"low_v": 0.0, "high_v": 2.0,
                  "voltage_map": {"a1_v": 1.8, "b1": 0.78, "a2_v": -0.76, "b2": -18.7}},
        "model": {"physical": {
            "kind": "planar-hasel", "mass_kg": MASS_KG, "parameters": values,
            "residuals": {"capacitance_noise_f": 2e-13},
            "records": {"gain_v_per_v": GAIN, "carrier_v": CARRIER_V, "highest_drive_v": 2.0},
        }},
    }, "the test")  # fmt: skip


def study(**changes: object) -> Study:
    table = {
        **BUILTIN.model_dump(), **OUTER, "trials": 1,
        "parameters": {"bandwidth_rad_s": 38.5, "load_n": 0.21}, **changes,
    }  # fmt: skip
    return Study.model_validate({"name": "model control", "model_control": table})


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Findings, list[float]]:
    """The folder of a run, its findings, and the masses that the hybrid estimated on the way."""
    folder, estimates = tmp_path_factory.mktemp("model") / FOLDER, []
    step = HybridController.step

    def noted(self: HybridController, *arguments: object) -> float:
        found = step(self, *arguments)  # type: ignore[arg-type]
        estimates.append(self.estimated_load_kg)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(HybridController, "step", noted)
        options = RunOptions(folder, 5, "none", CONFIG.model_dump(mode="json"), tables())
        rig = make_twin(CONFIG, 5)
        rig.source.write(1.5)  # as after another experiment: at first it still falls
        rig.stand.wait(1.0)
        rig.source.zero()
        found = run_study(study(), rig, options, SilentProgress())
    return folder, found, estimates


def test_the_observer_steps_as_on_the_scoreboard(played):
    """36 ms there, see docs/control/scoreboard.md; a frame takes 10 ms."""
    _, found, _ = played
    assert found.quantities["S25.rise_observer"].value == pytest.approx(0.036, abs=0.010)
    assert found.quantities["S25.overshoot_observer"].value < 0.05
    assert abs(found.quantities["S25.error_observer"].value) < 0.01


@pytest.mark.parametrize("which", ["own", "other"])
def test_the_hybrid_weighs_what_hangs_and_holds_the_strain_with_it(played, which):
    """With the true law: 1 g is the goal for a change of weight after 1 s."""
    _, found, _ = played
    assert abs(found.quantities[f"S27.mass_error_{which}"].value) < 1e-3
    assert found.quantities[f"S27.rise_{which}"].value < 1.3 * 0.036 + 0.010
    assert abs(found.quantities[f"S27.error_{which}"].value) < 0.01
    hung_kg = {"own": MASS_KG, "other": OTHER_KG}[which]
    assert f"{hung_kg:g} kg hung" in found.notes[f"S27.mass_error_{which}"]


def test_beyond_the_linear_region_it_steps_without_an_error(played):
    _, found, _ = played
    rows = {key: value.value for key, value in found.quantities.items()}
    assert OUTER["linear_high"] < rows["S30.lowest"] < rows["S30.highest"] - 0.01
    assert abs(rows["S30.error"]) < 5e-4 and rows["S30.overshoot"] < 0.1
    assert "0.48 kg hung" in found.notes["S30.error"]


def test_the_masses_of_the_recording_are_those_that_the_controller_had(played):
    """Two loops of 4 s were played, then that of S30; the result computes the first two again.

    Where the drive jumps, at the start and at the step, the lock-in of a whole record uses other
    samples than that of a single block.
    """
    _, found, estimates = played
    then, again = estimates[400:800], estimates[-400:]
    assert again == pytest.approx(then, abs=1e-3)
    assert again[250:] == pytest.approx(then[250:], abs=1e-5)
    mean_kg = float(np.mean(then[200:]))
    expected_kg = pytest.approx(mean_kg - OTHER_KG, abs=1e-5)
    assert found.quantities["S27.mass_error_other"].value == expected_kg


def test_an_analysis_of_the_recording_gives_the_same_results(played):
    folder, found, _ = played
    again = analysed(folder.parent)
    assert isinstance(again, Findings)
    assert {key: value.value for key, value in again.quantities.items()} == {
        key: value.value for key, value in found.quantities.items()
    }
    joined = with_model_rows(Findings({}, {}, {}), again)
    assert joined.quantities == again.quantities and len(joined.charts) == 2


def test_without_a_physical_model_it_says_so(tmp_path):
    options = RunOptions(tmp_path / "out", 5, "none", CONFIG.model_dump(mode="json"))
    found = run_study(study(), make_twin(CONFIG, 5), options, SilentProgress())
    assert set(found.missing) == set(ModelControlTest.all_rows())
    assert "needs an actuator file with [model.physical]" in found.missing["S30.lowest"]


def test_strains_within_the_linear_region_are_not_those_of_row_s30():
    assert set_points(BUILTIN, (0.2, 0.3)) == pytest.approx((0.23, 0.26, 0.23))
    assert set_points(BUILTIN, (0.1, 0.3)) == ()


def test_errors_at_rest_and_overshoot_are_those_of_the_camera():
    """Strains 0.2, 0.3 with 10 % beyond it, 0.2: at the end of each a known error."""
    strain = np.repeat([0.2005, 0.31, 0.2998, 0.2], [200, 100, 100, 200])
    time_s = 0.01 * np.arange(strain.size)
    none = np.empty(0)
    seen = Observation(
        "steps", {}, np.zeros(1), none, none, none, none, none, time_s, 0.05 * (1.0 + strain),
        none, none, float("nan"), none,
    )  # fmt: skip
    found, chart = outer_results(seen, (0.2, 0.3, 0.2), 0.05, BUILTIN, 5e-5)
    assert found["S30.highest"].value == 0.3 and found["S30.lowest"].value == 0.2
    assert found["S30.error"].value == pytest.approx(-0.0005)
    assert found["S30.overshoot"].value == pytest.approx(0.1)
    # The camera's bias, and the zero strain of another session.
    assert found["S30.error"].std == pytest.approx(math.hypot(0.01, 0.02) * 5e-5 / 0.05)
    assert [curve.name for curve in chart.curves][:2] == ["desired", "hybrid"]


def test_the_study_of_the_model_follows_from_the_findings():
    """The outer mass by the law alone: at 0 V it hangs 2 % strain beyond the linear region."""
    known = known_actuator(tables())
    static = Static(0.5 * ZERO_M, None, 3, {"S17.region_high": Estimate.normal(2.36, 0.01, "")},
                    {}, {})  # type: ignore[arg-type]  # fmt: skip
    maps = Maps(ZERO_M, None, None, {}, {}, {})  # type: ignore[arg-type]
    found = Findings({}, {}, {}, values={Static: static, Maps: maps})
    table = model_study(builtin_study(), found, known).table("model_control", ModelControl)
    assert table.linear_high == pytest.approx(0.18)
    assert table.other_mass_kg == pytest.approx(0.2) and table.step == 0.04
    length_m = equilibrium_m(LAW, 0.0, GRAVITY_M_S2 * table.outer_mass_kg)
    assert length_m / ZERO_M - 1.0 == pytest.approx(0.20, abs=1e-3)


def test_a_run_without_the_session_says_why_the_rows_are_missing(tmp_path):
    found = with_model_rows(Findings({}, {}, {}), analysed(tmp_path))
    assert set(found.missing.values()) == {NOT_HERE}
    assert set(found.missing) == set(ModelControlTest.all_rows())


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"step": 0.0}, "step must not be 0"),
    ],
)
def test_settings_without_a_result_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        study(**changes)


def test_parameters_that_the_controllers_do_not_have_are_refused(tmp_path):
    options = RunOptions(tmp_path / "out", 5, "none", CONFIG.model_dump(mode="json"), tables())
    wrong = study(parameters={"kp": 1.0})
    with pytest.raises(InputError, match="kp is not a parameter"):
        run_study(wrong, make_twin(CONFIG, 5), options, SilentProgress())
