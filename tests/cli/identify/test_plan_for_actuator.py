"""`haselab identify plan-experiment A.toml` on an actuator file."""

import json
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.actuators import PlanarHasel
from haselab.base import InputError, ResultError
from haselab.cli.identify.actuator import each_once
from haselab.cli.identify.group import command as identify
from haselab.cli.readable import readable
from haselab.identify.physical.unknowns import Unknowns
from haselab.pipelines.planning.catalogue import Candidate
from haselab.pipelines.planning.proposal import Proposal
from haselab.store.toml import toml_text
from haselab.study.definition import checked_study

LAW = PlanarHasel()
UNKNOWNS = Unknowns.of(LAW, added_inertia_kg=0.01, mass_kg=0.25)
GOAL = "viscosity.damping_n_s_per_m"


def file_of(tmp_path, *, weak=GOAL, **changes):
    """An actuator file whose model knows all parameters to 1 % but one."""
    share = np.where(np.array(UNKNOWNS.names) == weak, 4.0, 0.01)
    std = share * UNKNOWNS.widths / 0.4 * np.abs(UNKNOWNS.slopes)
    physical = {
        "kind": "planar-hasel", "status": "ok", "mass_kg": 0.25,
        "parameters": dict(zip(UNKNOWNS.names, UNKNOWNS.values.tolist(), strict=True)),
        "not_identifiable": [weak],
        "covariance": {"names": list(UNKNOWNS.names), "matrix": np.diag(std**2).tolist()},
        "records": {"experiments": ["static"], "gain_v_per_v": 5000.0, "highest_drive_v": 1.0,
                    "heaviest_kg": 0.3, "carrier_v": 100.0, "length_std_m": 4e-6,
                    "capacitance_std_f": 3e-13},
        **changes,
    }  # fmt: skip
    physical = {key: value for key, value in physical.items() if value is not None}
    quoted = {key: value for key, value in physical.items() if not isinstance(value, dict)}
    lines = [toml_text({"actuator": {"kind": "planar-hasel"}, "model": {"physical": quoted}})]
    for name, table in physical.items():
        if isinstance(table, dict):
            lines += [f"[model.physical.{name}]"]
            lines += [f"{json.dumps(key)} = {json.dumps(value)}" for key, value in table.items()]
    path = tmp_path / "A.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def run(*arguments):
    words = ["plan-experiment", *map(str, arguments)]
    return CliRunner().invoke(identify, words, catch_exceptions=False)


@pytest.mark.long
def test_the_shortest_study_is_written_and_can_be_read(tmp_path):
    out = tmp_path / "study.toml"
    result = run(file_of(tmp_path), "--goal", GOAL, "--json", "--out", out)
    answer = json.loads(result.stdout)
    assert answer["status"] == "ok" and answer["goal"] == GOAL
    assert answer["relative_std_before"] == pytest.approx(4.0, rel=1e-6)
    assert answer["relative_std_after"] < 0.1
    study = checked_study(tomllib.loads(out.read_text()), out)
    assert study.name == f"experiment for {GOAL}"
    tables = answer["study"]
    assert set(tables) <= {"operating_point", "triangle", "chirp", "free_response", "static_load"}
    highest_v = max(t.get("high_v", t.get("baseline_v", 0.0)) for t in tables.values())
    assert highest_v <= 1.0  # without [drive], the highest drive of the records
    page = run(file_of(tmp_path), "--goal", GOAL, "--std", "0.5").stdout
    assert page.startswith(f"{GOAL}: ") and "relative standard deviation 4 to " in page


@pytest.mark.long
@pytest.mark.parametrize(("seen_mm", "further"), [((66.0, 66.5), True), ((20.0, 200.0), False)])
def test_a_study_that_moves_the_actuator_further_than_the_records_says_so(
    tmp_path, seen_mm, further
):
    lengths = [1e-3 * length for length in seen_mm]
    path = file_of(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("[model.physical.records]\n",
                                 f"[model.physical.records]\nlengths_m = {lengths}\n"))  # fmt: skip
    notes = json.loads(run(path, "--goal", GOAL, "--json").stdout)["notes"]
    found = [note for note in notes if "further than the records" in note]
    assert len(found) == further
    if further:
        assert "(66 to 66.5 mm)" in found[0]


def test_a_covariance_of_zeros_is_refused_like_by_compare(tmp_path):
    zeros = np.zeros((len(UNKNOWNS.names), len(UNKNOWNS.names))).tolist()
    path = file_of(tmp_path, covariance={"names": list(UNKNOWNS.names), "matrix": zeros})
    with pytest.raises(InputError, match=r"the matrix has a variance of 0, so it is not a"):
        run(path, "--goal", GOAL)


def test_an_unknown_parameter_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"--goal is shell.length, but must be a parameter"):
        run(file_of(tmp_path), "--goal", "shell.length")


def test_a_parameter_that_is_known_already_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"is known already, .* of 0\.01; --std is 0\.1"):
        run(file_of(tmp_path), "--goal", "shell.shear_modulus_pa")


def test_a_file_without_a_model_is_refused(tmp_path):
    path = tmp_path / "A.toml"
    path.write_text('[actuator]\nkind = "planar-hasel"\n')
    with pytest.raises(InputError, match=r"has no \[model\.physical\]\. Add it with"):
        run(path, "--goal", GOAL)


def test_a_model_without_records_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"does not say what it was identified from"):
        run(file_of(tmp_path, records=None), "--goal", GOAL)


def test_a_covariance_of_other_parameters_is_refused(tmp_path):
    other = {"names": ["shell.length_m"], "matrix": [[1e-6]]}
    with pytest.raises(InputError, match=r"covariance of \[model\.physical\] are not those"):
        run(file_of(tmp_path, covariance=other), "--goal", GOAL)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--duration-s", "10"], r"--duration-s describes a drive signal, which needs --rig"),
        (["--rig", "rig.toml", "--std", "0.1"], r"--std has no effect with --rig"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        run(file_of(tmp_path), "--goal", GOAL, *arguments)


def test_a_json_model_needs_a_rig(tmp_path):
    with pytest.raises(InputError, match=r"is not an actuator file \(\.toml\).* Add --rig"):
        run(tmp_path / "model.json", "--goal", GOAL)


def test_a_standard_deviation_of_0_is_refused(tmp_path):
    result = run(file_of(tmp_path), "--goal", GOAL, "--std", "0")
    assert result.exit_code == 2 and "--std" in result.stderr


@pytest.mark.long
def test_a_goal_that_no_experiment_reaches_ends_with_what_the_best_one_reaches(tmp_path):
    out = tmp_path / "study.toml"
    result = CliRunner().invoke(
        identify, ["plan-experiment", str(file_of(tmp_path)), "--goal", GOAL, "--std", "1e-9",
                   "--json", "--out", str(out)],
    )  # fmt: skip
    assert isinstance(result.exception, ResultError)  # exit code 3
    answer = json.loads(result.stdout)
    best = answer["relative_std_after"]
    assert f"of 1e-09 for {GOAL}; the best one reaches {best:.2g}" in answer["status"]
    assert str(result.exception).startswith(answer["status"])
    reachable = float(
        str(result.exception).partition("raise --std to at least ")[2].split()[0][:-1]
    )
    assert best <= reachable < 1.2 * best
    assert checked_study(tomllib.loads(out.read_text()), out).name == f"experiment for {GOAL}"


def test_where_nothing_is_measured_no_experiment_helps(tmp_path):
    records = {"gain_v_per_v": 5000.0, "highest_drive_v": 1.0}
    with pytest.raises(ResultError, match=r"No experiment of the catalogue reduces"):
        run(file_of(tmp_path, records=records), "--goal", GOAL)


def test_a_study_for_several_parameters_is_printed_once():
    drop = Candidate("drop", {"free_response": {"baseline_v": 1.0}})
    load = Candidate("static load", {"static_load": {"masses_kg": [0.1]}})
    proposals = [
        Proposal("a", drop, 6.0, 4.0, 0.05, 0.1, ("Mind the mass.",)),
        Proposal("b", load, 35.0, 2.0, 0.08, 0.1),
        Proposal("c", drop, 6.0, 3.0, 0.5, 0.1, ("Mind the mass.", "Mind c.")),
    ]
    lines = readable({"experiments": each_once(proposals)})
    assert sum("free_response" in line for line in lines) == 1
    assert [" ".join(line.split()) for line in lines[:7]] == [
        "experiments", "1", "experiment drop", "duration_s 6", "relative_std", "a 4 to 0.05",
        "c 3 to 0.5 (not enough)",
    ]  # fmt: skip
    assert sum("Mind the mass." in line for line in lines) == 1
