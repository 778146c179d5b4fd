"""`haselab compare` by the physical model of an actuator file, as a user runs it."""

import hashlib
import json
import tomllib

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, Drive, PlanarHasel, SampledLaw
from haselab.base import SilentProgress
from haselab.cli.main import main
from haselab.identify.physical.unknowns import INSTRUMENTS, fitted_parameters, usual
from haselab.pipelines.motion import motion_of_session
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.observer import FIDUCIALS
from haselab.runtime.runner import Runner
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.layout import ExperimentPlan
from haselab.store.session.reader import SessionReader
from haselab.study.definition import builtin_study
from haselab.study.run import RunOptions, recording, session_header

LAW = twin_of_reading("hz").planar_hasel
LENGTH_STD_M, CAPACITANCE_STD_F = 4e-6, 3.3e-13
GAIN, MASS_KG, ZERO_M = 5000.0, 0.2, 0.05


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def written(path, *, status="ok", kind="planar-hasel", residuals=True, left_out="", **changed):
    """An actuator file whose model is the twin's truth, known to a part in 100,000."""
    values = {**fitted_parameters(LAW), "load.added_inertia_kg": 0.0}
    values |= {name: usual(name) for name in INSTRUMENTS}
    values |= {name.replace("__", "."): value for name, value in changed.items()}
    std = {name: 1e-5 * abs(value) or 1e-7 for name, value in values.items()}
    rows = np.diag(np.array(list(std.values())) ** 2).tolist()
    sections = {
        "actuator": f'[actuator]\nkind = "{kind}"\nmass_kg = {MASS_KG}\n',
        "geometry": f"[actuator.geometry]\nzero_length_m = {ZERO_M}\n",
        "drive": f"[drive]\ngain_v_per_v = {GAIN}\n",
        "physical": f'[model.physical]\nkind = "planar-hasel"\nstatus = "{status}"\n'
        "mass_kg = 0.25\n[model.physical.parameters]\n"
        + "".join(f'"{name}" = {value!r}\n' for name, value in values.items()),
        "covariance": f"[model.physical.covariance]\nnames = {json.dumps(list(values))}\n"
        f"matrix = {rows}\n",
        "residuals": f"[model.physical.residuals]\nlength_noise_m = {LENGTH_STD_M}\n"
        f"length_worst_m = {LENGTH_STD_M}\nlength_factor = 0.95\n"
        f"capacitance_noise_f = {CAPACITANCE_STD_F}\ncapacitance_worst_f = {CAPACITANCE_STD_F}\n",
    }
    without = {left_out} | (set() if residuals else {"residuals"})
    without |= {"covariance", "residuals"} if left_out == "physical" else set()
    wanted = [text for name, text in sections.items() if name not in without]
    path.write_text("\n".join(wanted))
    return path


@pytest.fixture
def actuator(tmp_path):
    return written(tmp_path / "A.toml")


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Two short experiments of the twin with another mass. The first one begins under voltage."""
    folder = tmp_path_factory.mktemp("predicted") / "run"
    config = twin_of_reading("hz")
    load = config.load.model_copy(update={"mass_kg": MASS_KG})
    config = config.model_copy(update={"load": load})
    rig = guard(make_twin(config, 3), Safety(SafetySettings()))
    arm_simulated(rig)
    options = RunOptions(folder, 3, "none", config.model_dump(mode="json"))
    header = session_header(builtin_study(quick=True), rig.description, options)
    plans = [ExperimentPlan(name, "steps", FIDUCIALS, {}) for name in ("step", "held")]
    with (
        recording(rig, options, header, plans) as (writer, camera),
        Runner(rig, writer, camera, 2000.0, 0.02, SilentProgress()) as runner,
    ):
        runner.settle(1.2, 0.5)
        runner.play("step", np.repeat([1.2, 0.4, 1.6], 60), 100.0, MASS_KG)
        runner.play("held", np.repeat([1.6, 0.9], 40), 100.0, MASS_KG)
    return folder


def table(path, *, seed=1, law=LAW, unit="m", first_v=0.0):
    """A table of the drive and what the law does, by the simulation alone."""
    rng = np.random.default_rng(seed)
    count = 800
    time_s = 0.01 * np.arange(count)
    u = np.repeat(rng.uniform(0.0, 1.8, 40), 20)
    u[:20] = first_v
    drive = Drive(
        np.append(time_s, 8.0), GAIN * u, np.full(count, MASS_KG * GRAVITY_M_S2),
        np.full(count, MASS_KG), np.zeros(count),
    )  # fmt: skip
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(GAIN * u[0], 0.0, MASS_KG * GRAVITY_M_S2)
    seen = sampled.respond(drive, time_s, start)
    length_m = seen.length_m + LENGTH_STD_M * rng.standard_normal(count)
    capacitance_f = law.capacitance_f(seen.length_m)
    measured = {
        "m": ("length_m", length_m),
        "1": ("strain", length_m / ZERO_M - 1.0),
        "F": ("capacitance_f", capacitance_f + CAPACITANCE_STD_F * rng.standard_normal(count)),
        "N": ("force_n", length_m),
    }
    name, values = measured[unit]
    rows = np.column_stack([time_s, u, values])
    np.savetxt(path, rows, "%.12g", ",", header=f"time_s,voltage_v,{name}", comments="")
    return path


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
    digest = tomllib.loads(actuator.read_text())
    assert "provenance" not in digest
    found = hashlib.sha256((session / "session.h5").read_bytes()).hexdigest()
    actuator.write_text(
        actuator.read_text() + f'\n[provenance.model.physical]\nsha256 = ["{found}"]\n'
    )
    code, _, error = run(capsys, "compare", actuator, session)
    assert code == 3 and "not a validation: the model was identified from this recording" in error


@pytest.mark.parametrize("unit", ["m", "1", "F"])
def test_a_table_is_predicted(actuator, tmp_path, capsys, unit):
    file = table(tmp_path / "new.csv", unit=unit, first_v=0.7)
    code, text, error = run(capsys, "compare", actuator, file, "--json")
    answer = json.loads(text)
    assert (code, error, answer["status"]) == (0, "", "ok")
    noise = CAPACITANCE_STD_F if unit == "F" else LENGTH_STD_M
    assert answer["rms_error"] == pytest.approx(noise, rel=4.0 / np.sqrt(2.0 * 800))
    assert answer["fit_percent"] > 99.0 and answer["inside_band"] > 0.93


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
