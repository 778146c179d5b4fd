"""A study file that names a controller of any registered kind."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from haselab.base import Estimate, InputError
from haselab.cli.main import main
from haselab.control import DesignSpec, LoopSetting, PidGains
from haselab.controllers import chosen_controller
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import describe
from haselab.store.actuator_file import ACTUATOR, read_actuator
from haselab.store.toml import validated
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study, builtin_study, load_study
from haselab.study.fits.loops import Loops, pid_demands
from haselab.study.fits.maps import Maps
from haselab.study.folder import write_design
from haselab.study.own_controller import (
    own_controller,
    own_names,
    own_note,
    own_quantities,
)
from haselab.study.paper.quantity_table import quantities
from haselab.study.tables import Control

ROOT = Path(__file__).parents[2]
BUILTIN = ROOT / "src/haselab/study/studies/hasel-iros2018.toml"


def study_with(folder: Path, control: str, trials: int = 2) -> Study:
    text = BUILTIN.read_text()
    start, end = text.index("[control]"), text.index("[quick.triangle]")
    text = f"{text[:start]}[control]\n{control}\n{text[end:]}"
    path = folder / "study.toml"
    path.write_text(text.replace("[control]", f"custom_trials = {trials}\n[control]", 1))
    return load_study(path)


def test_the_other_keys_of_the_table_are_the_kind_s_parameters(tmp_path):
    study = study_with(tmp_path, 'kind = "pid"\nkp = 0.2\nki = 0.7\nsaturation_high = 0.08')
    assert study.control.parameters == {"kp": 0.2, "ki": 0.7, "kd": 0.0, "derivative_filter_s": 0.0}
    assert (study.control.kp, study.control.ki) == (0.85, 1.5)  # the paper's, beside it
    assert study.control.saturation_high == 0.08
    assert own_controller(study) == chosen_controller({"kind": "pid", **study.control.parameters})


def test_the_trials_are_planned_and_counted(tmp_path):
    study = study_with(tmp_path, 'kind = "open-loop"', trials=3)
    (step_test,) = (one for one in experiments_of(study) if one.table == "steps")
    played = step_test.recordings().items()
    planned = [(name, kind) for name, kind in played if name.startswith("own")]
    assert planned == [(f"own-{k}", "step with open-loop") for k in (1, 2, 3)]
    steps = study.steps
    (without,) = (one for one in experiments_of(builtin_study()) if one.table == "steps")
    bench = describe(twin_of_reading("hz"))
    more_s = step_test.seconds(bench) - without.seconds(bench)
    assert more_s == pytest.approx(3 * (steps.rest_s + steps.zero_s + steps.step_s))


def test_a_study_without_a_kind_plays_none():
    study = builtin_study()
    assert own_names(study) == []
    assert own_controller(study) is None


@pytest.mark.parametrize(
    ("control", "said"),
    [
        ('kind = "mine"', r"No controller 'mine' is registered"),
        ('kind = "pi"\nkp = 1.0\nki = 1.0\nkd = 2.0', r"kd is not a parameter.*study\.toml"),
        ('kind = "pi"\nkp = 1.0', r"ki \(1/s\) is missing"),
        ('kind = "pi"\nkp = "a"\nki = 1.0', r"parameters\.kp"),
    ],
)
def test_a_controller_that_cannot_be_is_refused_with_the_file(tmp_path, control, said):
    with pytest.raises(InputError, match=said):
        study_with(tmp_path, control)


def test_a_recording_is_read_without_the_package_that_played_it():
    control = Control.model_validate({"kind": "not-installed", "gain": 2.0})
    study = builtin_study().model_copy(update={"control": control})
    again = Study.model_validate(study.model_dump(mode="json"))
    assert again == study
    assert own_names(again) == ["own-1", "own-2"]
    assert tomllib.loads(f"x = {again.control.parameters['gain']}") == {"x": 2.0}


def test_each_result_has_its_row_and_the_note_says_where_margins_come_from():
    value = Estimate.normal(1.0, 0.1, "")
    assert set(own_quantities(value, value, value)) <= set(quantities())
    note = own_note(Control(kind="mine", parameters={"gain": 2.0}))
    assert note == (
        "controller 'mine' (gain = 2); its margins, if its feedback is linear, come from haselab "
        "margins with --controller"
    )


def test_an_own_pid_is_an_alternative_and_never_replaces_the_designed_one(tmp_path):
    """The designed one has margins; firmware is built from it unless the own one is named."""
    study = study_with(tmp_path, 'kind = "pid"\nkp = 0.2\nki = 0.7')
    margin = Estimate.normal(50.0, 1.0, "deg")
    names = ("S21.phase_margin", "S21.gain_margin", "S25.phase_margin", "S25.gain_margin")
    loops = Loops(
        PidGains(0.5, 1.0), PidGains(0.0, 3.0), LoopSetting(), PidGains(0.4, 1.0),
        dict.fromkeys(names, margin), {}, {},
    )  # fmt: skip
    write_design(tmp_path, None, None, loops, study)
    path = tmp_path / ACTUATOR
    tables = validated(ActuatorTables, read_actuator(path), path)
    assert tables.designed().parameters["ki"] == tables.designed("pid").parameters["ki"] == 3.0
    assert tables.designed("own").parameters == {
        "kp": 0.2, "ki": 0.7, "kd": 0.0, "derivative_filter_s": 0.0
    }  # fmt: skip
    assert set(tables.controller.all_kinds) == {"pid", "pi", "own"}
    demands = DesignSpec.from_mapping(tables.controller.demands)
    assert demands == pid_demands(study), "what the PID was designed for"


def test_an_own_controller_alone_is_in_the_actuator_file_with_its_limits(tmp_path):
    """No design is made then; the limits are those of the drive, 0 to 1.6 V."""
    study = study_with(tmp_path, 'kind = "pi"\nkp = 0.3\nki = 1.0')
    eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
    maps = Maps(0.05, eq4, StrainMap(4.9e8, -0.27), {}, {}, {})
    write_design(tmp_path, maps, None, None, study, (0.0, 1.6))
    path = tmp_path / ACTUATOR
    tables = validated(ActuatorTables, read_actuator(path), path)
    own = tables.designed("pi")
    assert own.parameters == {"kp": 0.3, "ki": 1.0} and own.limits is not None
    assert (own.limits.low, own.limits.high) == (-0.05, pytest.approx(0.0692, abs=1e-4))


@pytest.mark.long
def test_a_study_without_pi_and_pid_trials_has_all_the_rest(tmp_path, capsys):
    """With a design, whose further trials have no PI trials to take their scatter from."""
    text = (ROOT / "examples/plugins/haselab-mycontroller/study.toml").read_text()
    for old, new in (
        ('"mycontroller"\ngain_per_s = 1.0\nsmoothing_s = 0.1', '"pi"\nkp = 0.3\nki = 1.0'),
        ("pi_trials = 1\npid_trials = 1", "pi_trials = 0\npid_trials = 0\nsaturating_trials = 1\n"
         "extra_delay_trials = 1\npaper_chain_trials = 1"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "study.toml").write_text(text)
    (tmp_path / "twin.toml").write_text('kind = "twin"\n')
    out, again = tmp_path / "out", tmp_path / "again"
    run = ["run", tmp_path / "study.toml", "--rig", tmp_path / "twin.toml", "--keep-video", "none"]
    for command in ([*run, "--out", out], ["analyse", out / "session.h5", "--out", again]):
        with pytest.raises(SystemExit) as stop:
            main([str(word) for word in command])
        assert stop.value.code == 0, capsys.readouterr().err
    found, repeated = (json.loads((each / "results.json").read_text()) for each in (out, again))
    rows = {row["id"]: row["measured"] for row in found["quantities"]}
    assert rows == {row["id"]: row["measured"] for row in repeated["quantities"]}
    assert {
        "S21.kp",
        "S25.kd",
        "S25.rise_own",
        "S24.rise_delayed",
        "S10.rise_printed_chain",
    } <= set(rows)
    reasons = {item["reason"]: item["ids"] for item in found["not_played"]}
    assert reasons["steps.pi_trials is 0 in this study."][0] == "S24.rise_closed"
    assert not any("no result" in reason for reason in reasons)
