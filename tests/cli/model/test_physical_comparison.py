"""`haselab compare` by the physical model of an actuator file, as a user runs it."""

import hashlib
import json
from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import PlanarHasel
from haselab.base import InputError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.identify.recorded_motion import TableOptions, motion_of_file
from haselab.cli.main import main
from haselab.identify.physical import ActuatorFit
from haselab.pipelines.motion import motion_of_session, motions_of_session
from haselab.rig.twin.twin_file import load_twin
from haselab.runtime.lockin import lockin_of
from haselab.store.columns.selection import ColumnOptions
from haselab.store.session.reader import SessionReader
from haselab.study.run import described
from tests.cli.model.physical_files import (
    CAPACITANCE_STD_F,
    GAIN,
    LENGTH_STD_M,
    MASS_KG,
    played,
    table,
    written,
)


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


@pytest.fixture
def actuator(tmp_path):
    return written(tmp_path / "A.toml")


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return played(tmp_path_factory.mktemp("predicted") / "run")


def share(part, samples):
    """Four standard deviations of the share of so many independent values."""
    return pytest.approx(part, abs=4.0 * np.sqrt(part * (1.0 - part) / samples))


@pytest.mark.long
def test_a_session_that_was_not_fitted_is_inside_the_band(actuator, session, tmp_path, capsys):
    figure = tmp_path / "prediction.svg"
    code, text, error = run(capsys, "compare", actuator, session, "--json", "--plot", figure)
    answer = json.loads(text)
    assert (code, error, answer["status"], answer["model"]) == (0, "", "ok", "physical")
    assert [(one["experiment"], one["signal"]) for one in answer["experiments"]] == [
        (name, signal) for signal in ("length", "capacitance") for name in ("held", "step")
    ]
    assert answer["length"]["rms_error_percent_of_span"] < 0.3
    assert answer["rms_error"] == answer["length"]["rms_error_m"] == pytest.approx(4e-6, rel=0.3)
    assert answer["capacitance"]["inside_band"] == share(0.95, answer["capacitance"]["samples"])
    assert answer["inside_band"] > 0.93 and answer["fit_percent"] > 99.0
    assert answer["experiments"][0]["samples"] < answer["samples"] == answer["length"]["samples"]
    assert b"Prediction of run by the physical model" in figure.read_bytes()
    code, text, _ = run(capsys, "compare", actuator, session, "--experiment", "held", "--json")
    assert code == 0
    assert {one["experiment"] for one in json.loads(text)["experiments"]} == {"held"}


@pytest.mark.long
def test_a_session_that_begins_under_voltage_was_at_rest_at_0_v(session):
    with SessionReader(session) as reader:
        first_s = reader.conditions()["time_s"][0]
        record = motion_of_session(reader, session)
    assert record.drive.edge_s[0] < first_s and record.drive.voltage_v[0] == 0.0
    begins = np.searchsorted(record.drive.edge_s, first_s)
    assert record.drive.voltage_v[begins] == pytest.approx(1.2 * GAIN)


@pytest.mark.long
def test_the_voltage_monitor_shows_a_wrong_gain_of_the_amplifier(session):
    with SessionReader(session) as reader:
        right = motion_of_session(reader, session)
        reader.header["rig"]["amplifier_gain"] *= 1.1
        wrong = motion_of_session(reader, session)
    # a level is known to a code, 1.5 V, of steps of 1.5 kV and more
    assert right.voltage_ratio == pytest.approx(1.0, abs=1e-3)
    assert wrong.voltage_ratio == pytest.approx(right.voltage_ratio / 1.1)


@pytest.mark.long
def test_what_a_lockin_has_sensed_before_is_not_sensed_again(session):
    """Sensed capacitances of twice the size show that they are used; all else is the same."""
    with SessionReader(session) as reader:
        rig = described(reader.header["rig"])
        lockin = lockin_of(rig, 2000.0)
        sensed = {name: lockin.sense(reader.experiment(name).codes) for name in reader.names}
        twice = {
            name: replace(one, capacitance_f=2.0 * one.capacitance_f)
            for name, one in sensed.items()
        }
        lockins = [(lockin, known) for known in ({}, sensed, twice)]
        anew, same, other = motions_of_session(reader, session, lockins)
    np.testing.assert_array_equal(same.capacitance_f, anew.capacitance_f)
    np.testing.assert_array_equal(same.drive.edge_s, anew.drive.edge_s)
    np.testing.assert_array_equal(other.capacitance_f, 2.0 * anew.capacitance_f)


@pytest.mark.long
@pytest.mark.parametrize(
    ("right", "wrong", "named"),
    [
        (
            f"mass_kg = {MASS_KG}",
            "mass_kg = 0.3",
            "[actuator] is 0.3 kg, but the sessions state 0.2",
        ),
        (
            "gain_v_per_v = 5000.0",
            "gain_v_per_v = 1e3",
            "[drive] is 1000 V/V, but the sessions sta",
        ),
    ],
)
def test_a_file_that_contradicts_the_session_is_named(
    actuator, session, capsys, monkeypatch, right, wrong, named
):
    def stopped(*_, **__):
        return ActuatorFit(status="not fitted here")

    monkeypatch.setattr("haselab.cli.identify.actuator.fit_actuator", stopped)
    text = actuator.read_text()
    code, _, error = run(capsys, "identify", "actuator", session, "--actuator", actuator)
    assert code == 3 and "warning" not in error
    actuator.write_text(text.replace(right, wrong))
    code, _, error = run(capsys, "identify", "actuator", session, "--actuator", actuator)
    assert code == 3 and named in error


@pytest.mark.long
def test_a_model_error_outside_the_band_ends_with_code_3_and_its_place(session, tmp_path, capsys):
    wrong = written(tmp_path / "B.toml", viscosity__damping_n_s_per_m=2.2)
    code, text, error = run(capsys, "compare", wrong, session, "--json")
    assert code == 3 and "model error: only " in error and error.count("\n") == 1
    answer = json.loads(text)
    assert answer["status"].startswith("model error: only ")
    inside = {one["experiment"]: one["inside_band"] for one in answer["experiments"]
              if one["signal"] == "length"}  # fmt: skip
    assert inside["step"] < 0.8


@pytest.mark.long
def test_the_session_of_the_fit_is_no_validation(actuator, session, capsys):
    found = hashlib.sha256((session / "session.h5").read_bytes()).hexdigest()
    actuator.write_text(
        actuator.read_text() + f'\n[provenance.model.physical]\nsha256 = ["{found}"]\n'
    )
    code, _, error = run(capsys, "compare", actuator, session)
    assert code == 3 and "not a validation: the model was identified from this recording" in error


def test_a_width_that_was_changed_after_the_identification_is_refused(actuator, tmp_path, capsys):
    file = table(tmp_path / "new.csv", unit="m", first_v=0.7)
    changed = "[actuator.parameters]\nshell.width_m = 0.05\ndielectric.breakdown_v_per_m = 3e7\n"
    text = actuator.read_text() + "[model.physical.measured]\nshell.width_m = "
    named = (
        "shell.width_m is 0.05 in [actuator.parameters], but was 0.0498 when [model.physical] was"
    )
    actuator.write_text(f"{text}0.0498\n{changed}")
    code, _, error = run(capsys, "compare", actuator, file)
    assert code == 2 and named in error
    with pytest.raises(InputError, match=r"shell.width_m is 0.05 in \[actuator.parameters\], but"):
        load_twin(actuator)
    actuator.write_text(f"{text}0.05\n{changed}")
    assert load_twin(actuator).shell.width_m == 0.05


@pytest.mark.parametrize("unit", ["m", "1", "F"])
def test_a_table_is_predicted(actuator, tmp_path, capsys, unit):
    file = table(tmp_path / "new.csv", unit=unit, first_v=0.7)
    code, text, error = run(capsys, "compare", actuator, file, "--json")
    answer = json.loads(text)
    assert (code, error, answer["status"]) == (0, "", "ok")
    noise = CAPACITANCE_STD_F if unit == "F" else LENGTH_STD_M
    assert answer["rms_error"] == pytest.approx(noise, rel=4.0 / np.sqrt(2.0 * 800))
    assert answer["fit_percent"] > 99.0 and answer["inside_band"] > 0.93


def both_signals(path):
    """A table of lengths and capacitances."""
    length, farad = (np.loadtxt(table(path, unit=unit), delimiter=",", skiprows=1)
                     for unit in ("m", "F"))  # fmt: skip
    header = "time_s,voltage_v,length_m,capacitance_f"
    rows = np.column_stack([length, farad[:, 2]])
    np.savetxt(path, rows, "%.12g", ",", header=header, comments="")
    return path


def test_both_signals_of_a_table_are_compared(actuator, tmp_path, capsys):
    file = both_signals(tmp_path / "new.csv")
    named = "--output", "length_m", "--output", "capacitance_f"
    for options, signals in (
        ((), ["length", "capacitance"]), (named, ["length", "capacitance"]),
        (named[2:], ["capacitance"]),
    ):  # fmt: skip
        code, text, error = run(capsys, "compare", actuator, file, *options, "--json")
        assert code == 0, error
        assert [one["signal"] for one in json.loads(text)["experiments"]] == signals
    code, _, error = run(capsys, "compare", actuator, file, *named, "--model", "linear")
    assert code == 2 and "--output is given 2 times, but a linear model has one output" in error
    # a model of lengths alone says nothing of the noise of capacitances
    text = actuator.read_text()
    actuator.write_text("\n".join(line for line in text.splitlines()
                                  if not line.startswith("capacitance_")))  # fmt: skip
    code, text, error = run(capsys, "compare", actuator, file, "--json")
    assert code == 0, error
    assert [one["signal"] for one in json.loads(text)["experiments"]] == ["length"]
    code, _, error = run(capsys, "compare", actuator, file, *named)
    assert code == 2 and "does not state the noise of values in F" in error


def test_a_folder_of_tables_and_a_time_that_is_nan_are_named(actuator, tmp_path, capsys):
    folder = tmp_path / "tables"
    folder.mkdir()
    file = table(folder / "new.csv")
    for options in ((), ("--input", "voltage_v")):
        code, _, error = run(capsys, "compare", actuator, folder, *options)
        assert code == 2 and "no session.h5, but 1 files such as new.csv" in error
        assert "name each" in error and error.count("\n") == 1
    lines = file.read_text().splitlines()
    lines[6] = "nan," + lines[6].partition(",")[2]
    file.write_text("\n".join(lines))
    code, _, error = run(capsys, "compare", actuator, file)
    assert code == 2 and "Column time_s has nan in row 6 (1 such rows)" in error


def test_what_the_user_states_counts_before_the_file(actuator, tmp_path, capsys):
    file = table(tmp_path / "new.csv")
    assert run(capsys, "compare", actuator, file, "--mass-kg", "0.2")[0] == 0
    code, _, error = run(capsys, "compare", actuator, file, "--mass-kg", "0.25")
    assert code == 3 and "the predicted length" in error
    assert run(capsys, "compare", actuator, file, "--gain-v-per-v", "5250")[0] == 3
    names = "--input", "voltage_v", "--output", "length_m"
    assert run(capsys, "compare", actuator, file, *names, "--free-offset")[0] == 0
    assert run(capsys, "compare", actuator, file, "--longest-m", "0.0985")[0] == 3


def test_a_model_of_another_actuator_is_worse_than_the_mean(actuator, tmp_path, capsys):
    file = table(tmp_path / "new.csv", law=PlanarHasel(length_m=0.068))
    code, _, error = run(capsys, "compare", actuator, file)
    assert code == 3 and "the predicted length is worse than the mean of the record" in error


def test_several_tables_are_compared_together(actuator, tmp_path, capsys):
    files = [table(tmp_path / f"{k}.csv", seed=k) for k in (1, 2)]
    code, text, _ = run(capsys, "compare", actuator, *files, "--json")
    answer = json.loads(text)
    assert code == 0 and answer["samples"] == 1600
    assert [one["experiment"] for one in answer["experiments"]] == ["1.csv", "2.csv"]


@pytest.mark.parametrize(
    ("left_out", "unit", "options", "message"),
    [
        ("physical", "m", ["--model", "physical"], "The actuator file has no [model.physical]."),
        ("covariance", "m", [], "[model.physical] has no covariance"),
        ("residuals", "m", [], "does not state the noise of values in m"),
        (
            "geometry",
            "1",
            [],
            "the length at zero strain is not known. State it with --z",
        ),
        ("drive", "m", [], "The gain from column voltage_v to the actuator's voltage is"),
        ("", "N", ["--output", "force_n"], "Column force_n is without a unit, but the physical"),
        ("", "m", ["--experiment", "step"], "--experiment is for sessions"),
        ("", "m", ["--model", "physical", "--at-rest"], "are for linear models. Leave them out"),
        ("", "m", ["--model", "linear", "--free-offset"], "--free-offset needs a physical model"),
    ],
)
def test_what_is_missing_is_named(tmp_path, capsys, left_out, unit, options, message):
    actuator = written(tmp_path / "A.toml", left_out=left_out)
    code, _, error = run(
        capsys, "compare", actuator, table(tmp_path / "n.csv", unit=unit), *options
    )
    assert code == 2 and message in error and error.count("\n") == 1, error


def test_an_unknown_mass_is_named(actuator, tmp_path, capsys):
    text = actuator.read_text().replace(f"mass_kg = {MASS_KG}\n", "", 1)
    actuator.write_text(text)
    code, _, error = run(capsys, "compare", actuator, table(tmp_path / "new.csv"))
    assert code == 2 and "The hung mass of this table is not known. State it with --mass" in error


def test_a_status_that_is_not_ok_needs_the_size_of_the_error(tmp_path, capsys):
    file = table(tmp_path / "new.csv")
    model = written(tmp_path / "A.toml", status="model error: lengths", residuals=False)
    code, _, error = run(capsys, "compare", model, file)
    assert code == 2 and "but no residuals that say how large its error is" in error
    model = written(tmp_path / "B.toml", status="model error: lengths")
    code, _, error = run(capsys, "compare", model, file)
    assert code == 0 and "warning: [model.physical] has the status 'model error" in error


def test_a_drift_is_part_of_the_prediction(tmp_path, capsys):
    """8 s of the law itself, which does not drift."""
    file = table(tmp_path / "new.csv")
    none = {"drift__stiffness_per_s": 1e-9, "drift__stiffness_s": 600.0}
    code, text, _ = run(capsys, "compare", written(tmp_path / "A.toml", **none), file, "--json")
    assert (code, json.loads(text)["status"]) == (0, "ok")
    # 0.4 % of the force after 8 s is 40 um of 10 mm, ten times the noise
    fast = none | {"drift__stiffness_per_s": -5e-4}
    code, text, _ = run(capsys, "compare", written(tmp_path / "B.toml", **fast), file, "--json")
    assert code == 3 and json.loads(text)["status"].startswith("model error: only ")


def test_another_kind_of_actuator_is_refused(tmp_path, capsys):
    model = written(tmp_path / "A.toml", kind="dea-stack")
    code, _, error = run(capsys, "compare", model, table(tmp_path / "new.csv"))
    assert code == 2 and "is of the kind 'planar-hasel', but [actuator] of 'dea-stack'" in error


@pytest.mark.long
def test_options_of_tables_and_unknown_experiments_are_refused_for_sessions(
    actuator, session, capsys
):
    code, _, error = run(capsys, "compare", actuator, session, "--mass-kg", "0.2")
    assert code == 2 and "--mass-kg is for tables, but a session states this itself" in error
    code, _, error = run(capsys, "compare", actuator, session, "--experiment", "chirp")
    assert code == 2 and "has no experiment chirp" in error and "It has held, step." in error


@pytest.mark.long
def test_a_session_of_another_kind_is_warned_of(session, tmp_path, capsys):
    columns = ColumnOptions()
    options = TableOptions(None, (), None, None, None, None, columns)
    for kind, words in (
        ("planar-hasel", ""),
        ("dea-stack", "states a planar-hasel, but [actuator]"),
    ):
        known = load_actuator(written(tmp_path / f"{kind}.toml", kind=kind))
        record, _ = motion_of_file(session, options, known)
        assert words in capsys.readouterr().err
        assert record.name == str(session)  # session.h5 would not tell two runs apart
    with pytest.raises(InputError, match=r"--mass-kg is for tables, but a session states this"):
        motion_of_file(session, TableOptions(None, (), None, 0.2, None, None, columns), known)
