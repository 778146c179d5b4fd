"""One actuator.toml through init, identify, design and compare, as a user runs them."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import ACTUATORS
from haselab.cli.actuator_file import load_actuator
from haselab.cli.identify.actuator import law_of_section
from haselab.cli.main import cli, main
from haselab.control import PidGains, margins
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.models.posterior import PlantPosterior

TRUTH = Plant(0.8, 28.0, 0.15, 0.004)
RATE_HZ, NOISE = 100.0, 2e-4


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def record(path, seed, plant=TRUTH, offset=0.01):
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.03, 0.06, 60), 20)
    time_s = np.arange(u.size) / RATE_HZ
    y = plant.simulate(u, RATE_HZ, time_s) + offset + NOISE * rng.standard_normal(u.size)
    rows = np.column_stack([time_s, u, y])
    np.savetxt(path, rows, "%.9g", ",", header="time_s,u,y", comments="")
    return path


def new_files(folder):
    actuator = folder / "leg.toml"
    cli.main(["init", "my leg", "--out", str(actuator)], standalone_mode=False)
    actuator.write_text(actuator.read_text() + '\n[mine]\ncolour = "red"  # of the shell\n')
    return actuator, record(folder / "one.csv", 1), record(folder / "two.csv", 2)


@pytest.fixture
def files(tmp_path):
    return new_files(tmp_path)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """Files whose actuator has a model, identified once for all tests."""
    found = new_files(tmp_path_factory.mktemp("identified"))
    arguments = ["identify", "transfer", str(found[1]), "--actuator", str(found[0])]
    cli.main(arguments, standalone_mode=False)
    return found


@pytest.fixture
def known(identified, tmp_path):
    """A test's own copy of them."""
    return tuple(Path(shutil.copy(path, tmp_path)) for path in identified)


def test_a_new_file_names_the_actuator_and_is_not_overwritten(files, capsys):
    actuator, *_ = files
    data = tomllib.loads(actuator.read_text())
    assert data["actuator"]["name"] == "my leg" and data["actuator"]["kind"] == "planar-hasel"
    code, _, error = run(capsys, "init", "other", "--out", actuator)
    assert code == 2 and "was not changed" in error


@pytest.mark.parametrize("name", ['a "b" \\ c', "ü"])
def test_any_printable_name_is_kept(name, tmp_path, capsys):
    path = tmp_path / "a.toml"
    assert run(capsys, "init", name, "--mass-kg", 0.3, "--high-v", 2, "--out", path)[0] == 0
    data = tomllib.loads(path.read_text())
    assert data["actuator"]["name"] == name and data["actuator"]["mass_kg"] == 0.3
    assert data["drive"] == {"low_v": 0.0, "high_v": 2.0}
    code, _, error = run(capsys, "init", name, "--kind", "My Kind", "--out", tmp_path / "b.toml")
    assert code == 2 and "lower-case letters" in error


def test_the_model_is_written_with_its_full_covariance_and_origin(files, capsys):
    actuator, first, _ = files
    code, _, error = run(capsys, "identify", "transfer", first, "--actuator", actuator)
    assert (code, error) == (0, "")
    data = tomllib.loads(actuator.read_text())
    model = data["model"]
    assert model["natural_frequency_rad_s"] == pytest.approx(28.0, rel=0.01)
    assert model["residual_std"] == pytest.approx(NOISE, rel=0.1)
    matrix = np.array(model["covariance"]["matrix"])
    assert np.count_nonzero(matrix - np.diag(np.diag(matrix))) > 0
    names = tuple(model["covariance"]["names"])
    posterior = PlantPosterior.from_dict(model["covariance"])
    assert posterior.nominal.gain == model["gain"] and "delay_s" in names
    origin = data["provenance"]["model"]
    assert origin["command"].endswith(f"identify transfer {first} --actuator {actuator}")
    assert origin["input"] == ["one.csv"] and origin["status"] == "ok"
    assert 'colour = "red"  # of the shell' in actuator.read_text()


def test_a_model_file_has_the_band_of_the_actuator_file(files, tmp_path, capsys):
    """The band contains the noise of the output, which both files state."""
    actuator, first, second = files
    model = tmp_path / "model.json"
    for arguments in (("--actuator", actuator), ("--out", model)):
        assert run(capsys, "identify", "transfer", first, *arguments)[0] == 0
    inside = [
        json.loads(run(capsys, "compare", path, second, "--json")[1])["inside_band"]
        for path in (actuator, model)
    ]
    assert inside[0] == inside[1] == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / 1200))
    answer = json.loads(model.read_text())
    del answer["residual_std"]
    model.write_text(json.dumps(answer))  # as haselab wrote it before
    without = json.loads(run(capsys, "compare", model, second, "--json")[1])
    assert without["inside_band"] is None and "does not state residual_std" in without["band"]


@pytest.mark.parametrize(
    ("options", "is_said"),
    [((), True), (("--hold", "zero"), False), (("--delay", "0.004"), False)],
)
def test_a_delay_that_depends_on_the_hold_of_the_input_has_a_note(files, options, is_said, capsys):
    """A measured input is no staircase: its delay would be too short by half a sample."""
    _, first, _ = files
    answer = json.loads(run(capsys, "identify", "transfer", first, *options, "--json")[1])
    note = "too short by half a sample, 0.005 s."
    assert any(text.endswith(note) for text in answer["notes"]) is is_said


def test_design_reads_the_model_and_writes_the_controller(known, capsys):
    actuator, *_ = known
    code, text, _ = run(capsys, "design", actuator, "--json")
    answer = json.loads(text)
    controller = tomllib.loads(actuator.read_text())["controller"]
    assert code == 0 and controller["kind"] == "pid"
    gains = PidGains(**controller["parameters"])
    model = tomllib.loads(actuator.read_text())["model"]
    plant = Plant.from_dict(model)
    found = margins(plant, gains, loop_delay_s=0.01, rate_hz=100.0)
    assert controller["margins"]["phase_margin_deg"] == pytest.approx(found.phase_margin_deg)
    assert controller["plausible"]["margins"] == answer["posterior"]["margins"]["value"]
    assert "uncertainty" not in controller


def test_demands_typed_into_the_file_are_those_of_the_design(known, capsys):
    actuator, *_ = known
    text = actuator.read_text()
    typed = "[controller]\n\n[controller.demands]\nphase_margin_deg = 70.0  # careful\n"
    actuator.write_text(text.replace("[controller]\n", typed))
    assert run(capsys, "design", actuator)[0] == 0
    controller = tomllib.loads(actuator.read_text())["controller"]
    assert controller["demands"]["phase_margin_deg"] == 70.0
    assert controller["margins"]["worst_phase_margin_deg"] >= 70.0
    assert "phase_margin_deg = 70.0  # careful" in actuator.read_text()


def test_the_limits_are_those_that_the_drive_reaches(known, capsys):
    actuator, *_ = known
    text = actuator.read_text().replace("# high_v = 2.0", "high_v = 1.6")
    eq4 = "\n[drive.voltage_map]\na1_v = 1.324\nb1 = 3.124\na2_v = -0.2805\nb2 = -26.92\n\n[model]"
    actuator.write_text(text.replace("\n[model]", eq4, 1))
    assert run(capsys, "design", actuator)[0] == 0
    limits = tomllib.loads(actuator.read_text())["controller"]["limits"]
    # eq. 4: 1.324 exp(3.124 x 0.0692) - 0.2805 exp(-26.92 x 0.0692) is 1.600
    assert limits["low"] == pytest.approx(-0.05)
    assert limits["high"] == pytest.approx(0.0692, abs=2e-4)


def test_a_model_typed_by_hand_is_used_and_its_dependents_say_no_uncertainty(files, capsys):
    actuator, first, _ = files
    text = actuator.read_text()
    typed = "[model]\ngain = 0.8\nnatural_frequency_rad_s = 28\ndamping_ratio = 0.15\n"
    actuator.write_text(text.replace("[model]\n", typed))
    code, text, _ = run(capsys, "design", actuator, "--json")
    assert code == 0 and json.loads(text)["uncertainty"].startswith("no uncertainty")
    controller = tomllib.loads(actuator.read_text())["controller"]
    assert controller["uncertainty"] == "no uncertainty: [model] has no covariance"
    code, text, _ = run(capsys, "compare", actuator, first, "--json")
    answer = json.loads(text)
    assert code == 0 and answer["inside_band"] is None
    assert answer["band"].startswith("no uncertainty") and answer["fit_percent"] > 85


def test_compare_predicts_a_record_that_was_not_used(known, capsys):
    actuator, first, second = known
    code, text, _ = run(capsys, "compare", actuator, second, "--json")
    answer = json.loads(text)
    assert code == 0 and answer["status"] == "ok"
    # An exact model leaves the noise: its rms, up to the few numbers that are fitted.
    assert answer["rms_error"] == pytest.approx(NOISE, rel=0.1)
    assert answer["inside_band"] == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / 1200))
    assert answer["notes"] == []
    rows = np.loadtxt(second, delimiter=",", skiprows=1)
    spread = np.sqrt(np.mean((rows[:, 2] - rows[:, 2].mean()) ** 2))
    fit = 100 * (1 - answer["rms_error"] / spread)
    assert answer["fit_percent"] == pytest.approx(fit, abs=1e-9)
    code, text, error = run(capsys, "compare", actuator, first, "--json")
    assert code == 3 and json.loads(text)["status"].startswith("not a validation")
    assert "100 % of the samples were used for the fit. Use another record" in error
    assert answer["used_for_fit"] == 0.0


def rewritten(path, first, **how):
    """The rows of a record in another text."""
    rows = np.loadtxt(first, delimiter=",", skiprows=1)[how.pop("rows", slice(None))]
    rows[:, 2] *= how.pop("factor", 1.0)
    np.savetxt(path, rows, comments="", **how)
    return path


@pytest.mark.parametrize(
    "how",
    [
        {"fmt": "%.17g", "delimiter": ",", "header": "# exported\n# again\ntime_s,u,y"},
        {"fmt": "%.12g", "delimiter": ";", "header": "time_s;u;y (%)", "factor": 100.0},
        {"fmt": "%.6g", "delimiter": ",", "header": "time_s,u,y"},
        {"fmt": "%.9g", "delimiter": ",", "header": "time_s,u,y", "rows": slice(0, 600)},
        {"fmt": "%.9g", "delimiter": ",", "header": "time_s,u,y", "rows": slice(333, 453)},
    ],
    ids=["preamble and digits", "percent", "six digits", "half", "a tenth of it"],
)
@pytest.mark.parametrize("form", ["toml", "json"])
def test_a_record_of_the_fit_is_known_by_its_samples(known, tmp_path, capsys, how, form):
    model, first, _ = known
    if form == "json":
        model = tmp_path / "model.json"
        assert run(capsys, "identify", "transfer", first, "--out", model)[0] == 0
    again = rewritten(tmp_path / "again.csv", first, **how)
    code, text, error = run(capsys, "compare", model, again, "--json")
    answer = json.loads(text)
    assert code == 3 and answer["used_for_fit"] == 1.0 and answer["fit_percent"] > 98.0
    assert error.splitlines()[-1].startswith("haselab: not a validation: 100 %")


def test_records_of_the_fit_are_known_after_an_export_and_a_design(known, tmp_path, capsys):
    actuator, first, second = known
    plant, other = tmp_path / "plant.json", tmp_path / "other.toml"
    assert run(capsys, "export", actuator, "--to", "plant", "--out", plant)[0] == 0
    assert run(capsys, "design", plant, "--out", other)[0] == 0
    for model in (plant, other):
        assert run(capsys, "compare", model, first)[0] == 3
        assert run(capsys, "compare", model, second)[0] == 0


def test_a_record_that_contains_the_one_of_the_fit_has_its_share(known, tmp_path, capsys):
    actuator, first, second = known
    rows = np.vstack([np.loadtxt(path, delimiter=",", skiprows=1) for path in (first, second)])
    rows[:, 0] = np.arange(len(rows)) / RATE_HZ
    both = tmp_path / "both.csv"
    np.savetxt(both, rows, "%.9g", ",", header="time_s,u,y", comments="")
    code, text, _ = run(capsys, "compare", actuator, both, "--json")
    # 256 hashes below the limit in each half, 0.78 of them well inside their cells: 4 standard
    # deviations of a binomial share
    assert json.loads(text)["used_for_fit"] == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(400))
    assert code == 3


def test_the_hashes_of_an_older_version_are_not_used(known, tmp_path, capsys):
    actuator, first, _ = known
    old = tmp_path / "old.toml"
    text = actuator.read_text()
    a, b = text.index("[model.training_output]"), text.index("[", text.index("hashes =") + 10)
    hashes = re.search(r"hashes = (\[.*?\])", text, re.DOTALL)[1]
    table = f"[model.fitted_to]\nstep = 1e-4\nhashes = {hashes}\n"
    old.write_text(text[:a] + table + text[b:])
    code, text, error = run(capsys, "compare", old, first, "--json")
    assert code == 0 and json.loads(text)["used_for_fit"] is None
    assert "warning: the model does not state the samples that it was fitted to" in error


def test_a_repetition_with_a_coarse_converter_is_no_copy(files, tmp_path, capsys):
    actuator, first, _ = files
    again, rng = tmp_path / "again.csv", np.random.default_rng(4)
    rows = np.loadtxt(first, delimiter=",", skiprows=1)
    clean = TRUTH.simulate(rows[:, 1], RATE_HZ, rows[:, 0])
    lsb = 0.01 * np.std(clean)  # ten times the noise
    for path in (first, again):
        rows[:, 2] = lsb * np.round(clean / lsb + 0.1 * rng.normal(size=len(rows)))
        np.savetxt(path, rows, "%.9g", ",", header="time_s,u,y", comments="")
    assert run(capsys, "identify", "transfer", first, "--actuator", actuator)[0] == 0
    code, text, error = run(capsys, "compare", actuator, again, "--json")
    assert (code, json.loads(text)["used_for_fit"]) == (0, None)
    assert "it can be a copy or a repetition. Use a record with another input" in error
    rewritten(tmp_path / "copy.csv", first, fmt="%.6g", delimiter=",", header="time_s,u,y")
    assert run(capsys, "compare", actuator, tmp_path / "copy.csv")[0] == 3


def test_a_prediction_worse_than_the_mean_is_not_ok(known, tmp_path, capsys):
    actuator, _, second = known
    wrong = rewritten(tmp_path / "wrong.csv", second, fmt="%.9g", delimiter=",",
                      header="time_s,u,y", factor=-1.0)  # fmt: skip
    code, text, error = run(capsys, "compare", actuator, wrong, "--json")
    answer = json.loads(text)
    assert code == 3 and answer["fit_percent"] < 0.0
    assert answer["status"].startswith("the prediction is worse than the mean of the record")
    assert "Check the columns, their units" in error


EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
MAP = "\n[drive.voltage_map]\na1_v = 1.324\nb1 = 3.124\na2_v = -0.2805\nb2 = -26.92\n"


@pytest.fixture
def driven(files, tmp_path):
    """An actuator file with its voltage map, and two records in mV and %."""
    actuator, *plain = files
    actuator.write_text(actuator.read_text() + MAP)
    for path in plain:
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        rows[:, 1:] = np.c_[1e3 * EQ4.voltage_v(rows[:, 1]), 100.0 * rows[:, 2]]
        np.savetxt(path, rows, "%.9g", ";", header="t (s);U (mV);S (%)", comments="")
    return actuator, *plain, ("--input", "U", "--output", "S")


def test_units_that_contradict_the_model_are_refused(driven, capsys):
    actuator, first, second, names = driven
    through = "--through-voltage-map"
    assert (
        run(capsys, "identify", "transfer", first, *names, through, "--actuator", actuator)[0] == 0
    )
    model = tomllib.loads(actuator.read_text())["model"]
    assert (model["input_unit"], model["output_unit"]) == ("1", "1")
    assert run(capsys, "compare", actuator, second, *names, through)[0] == 0
    code, _, error = run(capsys, "compare", actuator, second, *names)
    assert code == 2 and error.splitlines()[-1] == (
        "haselab: The model's input is a pure number, such as a strain, but column U is in V. Add "
        f"--through-voltage-map: {second}"
    )
    second.write_text(second.read_text().replace("S (%)", "S (mm)"))
    code, _, error = run(capsys, "compare", actuator, second, *names, through)
    assert code == 2
    assert "model's output is a pure number, such as a strain, but column S is in m. Name" in error
    code, _, error = run(capsys, "identify", "transfer", first, second, *names)
    assert code == 2 and "Column S is in m, but in another file a pure number" in error
    swapped = ("--input", "S", "--output", "U", through, "--actuator", actuator)
    code, _, error = run(capsys, "identify", "transfer", first, *swapped)
    assert code == 2 and "converts a voltage, but column S is a pure number" in error


def test_a_model_from_volts_takes_no_strain_map_and_no_limits_of_strain(driven, tmp_path, capsys):
    actuator, first, second, names = driven
    out = tmp_path / "volts.json"
    assert (
        run(capsys, "identify", "transfer", first, *names, "--actuator", actuator, "--out", out)[0]
        == 0
    )
    code, _, error = run(capsys, "compare", actuator, second, *names, "--through-voltage-map")
    assert code == 2 and "model's input is in V, but --through-voltage-map gives a strain" in error
    code, _, error = run(capsys, "design", actuator)
    assert code == 2 and "[drive.voltage_map] expects a strain" in error
    code, _, error = run(capsys, "design", out)
    assert code == 2 and "Give the limits in V with --limits LOW HIGH" in error
    assert run(capsys, "design", out, "--limits", 0, 2)[0] == 0


def test_another_actuator_is_seen_by_the_band(known, tmp_path, capsys):
    actuator, *_ = known
    other = record(tmp_path / "other.csv", 3, Plant(0.8, 20.0, 0.15, 0.004))
    code, text, _ = run(capsys, "compare", actuator, other, "--json")
    answer = json.loads(text)
    assert answer["inside_band"] < 0.5 and answer["fit_percent"] < 70
    assert code == 3 and answer["status"].startswith("model error: the rms error is ")
    assert answer["notes"] == []


def test_a_file_without_a_model_says_which_command_writes_one(files, capsys):
    actuator, first, _ = files
    for command in (("design", actuator), ("compare", actuator, first)):
        code, _, error = run(capsys, *command)
        assert code == 2 and "has no [model]" in error and "identify transfer" in error
    code, _, error = run(capsys, "identify", "transfer", first, "--actuator", "none.toml")
    assert code == 2 and "haselab init" in error


def test_a_section_with_a_wrong_value_is_named(files, capsys):
    actuator, first, _ = files
    actuator.write_text(actuator.read_text().replace("low_v = 0.0", 'low_v = "zero"'))
    code, _, error = run(capsys, "identify", "transfer", first, "--actuator", actuator)
    assert code == 2 and "drive.low_v: must be a number, not a text" in error


def test_a_design_keeps_the_controllers_of_other_kinds_beside_its_own(known, capsys):
    actuator, *_ = known
    own = "[controller]\nkind = 'mine'\nparameters = {gain = 2.0}\n"
    actuator.write_text(actuator.read_text().replace("[controller]\n", own))
    assert run(capsys, "design", actuator)[0] == 0
    assert run(capsys, "design", actuator, "--structure", "pi")[0] == 0
    held = tomllib.loads(actuator.read_text())["controller"]
    assert held["kind"] == "pi"
    assert [one["kind"] for one in held["alternatives"]] == ["pid", "mine"]
    assert held["alternatives"][1]["parameters"] == {"gain": 2.0}
    first = held["alternatives"][0]
    assert run(capsys, "design", actuator, "--structure", "pi")[0] == 0  # the same once more
    held = tomllib.loads(actuator.read_text())["controller"]
    assert [one["kind"] for one in held["alternatives"]] == ["pid", "mine"]
    assert held["alternatives"][0] == first


def test_a_misspelled_key_is_warned_of_once_and_keys_of_ones_own_are_not(known, capsys):
    actuator, *_ = known
    text = actuator.read_text().replace("# high_v = 2.0", "hihg_v = 2.0")
    actuator.write_text(text)
    code, _, error = run(capsys, "design", actuator)
    assert code == 0
    line = f"haselab: warning: [drive] hihg_v has no effect; did you mean high_v? {actuator}\n"
    assert error == line


@pytest.mark.parametrize(
    "command",
    ["design {a}", "identify transfer no.csv --actuator {a}",
     "calibrate --rig twin --capacitor 1e-9 --actuator {a}",
     "identify capacitance-map no.csv --actuator {a}",
     "identify voltage-map no.csv --actuator {a}"],
)  # fmt: skip
def test_a_read_only_file_is_refused_before_the_work(files, capsys, command):
    actuator, *_ = files
    text = actuator.read_text()
    actuator.chmod(0o444)
    code, _, error = run(capsys, *command.format(a=actuator).split())
    assert code == 2 and error.count("\n") == 1 and "The file is read-only" in error
    assert actuator.read_text() == text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('kind = "planar-hasel"', 'kind = "unicorn"',
         "[actuator] kind 'unicorn' is unknown; the known kinds are planar-hasel, peano-hasel, "
         "curling-hasel, dea-stack."),
        ("[mine]", "[contorller]", "[contorller] has no effect; did you mean [controller]?"),
        ("[mine]", "[Modle]", "[Modle] has no effect; did you mean [model]?"),
    ],
)  # fmt: skip
def test_an_unknown_kind_and_a_misspelled_section_are_warned_of(known, capsys, old, new, said):
    actuator, *_ = known
    actuator.write_text(actuator.read_text().replace(old, new))
    code, _, error = run(capsys, "design", actuator)
    assert (code, error) == (0, f"haselab: warning: {said} {actuator}\n")


def test_init_warns_of_an_unknown_kind_and_not_of_one_without_a_law(tmp_path, capsys):
    code, _, error = run(capsys, "init", "a", "--kind", "unicorn", "--out", tmp_path / "a.toml")
    assert code == 0 and error.startswith("haselab: warning: [actuator] kind 'unicorn' is unknown")
    code, _, error = run(capsys, "init", "b", "--kind", "peano-hasel", "--out", tmp_path / "b.toml")
    assert (code, error) == (0, "")


_MAP = "[sensing.strain_map]\nslope_per_f = 4.9e8\noffset = -0.27\n"
_CURVE = "[drive.voltage_map]\na1_v = 1.3\nb1 = 3.1\na2_v = -0.3\nb2 = -27.0\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{_MAP}range_f = [8e-10, 5e-10]", "range_f: [8e-10, 5e-10] must have the"),
        (f"{_MAP}range_f = [nan, 5e-10]", "range_f.0: must be a finite number (got nan)"),
        (f"{_MAP}band = [0.01, -0.01]", "band: [0.01, -0.01] must have the lower end"),
        (f"{_MAP}hysteresis_strain = -0.1", "hysteresis_strain: must be greater than or"),
        (f"{_CURVE}strain_low = 0.2\nstrain_high = 0.1", "strain_low = 0.2 must be below strain_"),
        ("[drive]\nlow_v = 3\nhigh_v = 1", "drive: low_v = 3 must be below high_v"),
        ("[drive]\nhighest_field_v_per_m = -1.0", "must be greater than 0 (got -1.0)"),
        ("[controller]\nlimits = {low = 0.1, high = -0.05}", "low = 0.1 must be below high = -0"),
        ('[[controller.alternatives]]\nkind = "x"\nlimits = {low = 0.1, high = 0.1}',
         "alternatives.0.limits: low = 0.1 must be below high = 0.1"),
        ("[controller.demands]\nphase_margin_deg = -5.0", "phase_margin_deg = -5; it must be "
        "within"),
    ],
)  # fmt: skip
def test_reversed_and_impossible_ranges_are_refused_when_the_file_is_read(
    tmp_path, capsys, text, said
):
    actuator = tmp_path / "a.toml"
    model = "[model]\ngain = 1.0\nnatural_frequency_rad_s = 30.0\ndamping_ratio = 0.1\n"
    actuator.write_text(model + "rate_hz = 100.0\nloop_delay_s = 0.0075\n" + text + "\n")
    code, _, error = run(capsys, "design", actuator)
    assert code == 2 and said in error and error.endswith(f"{actuator}\n")


def test_the_highest_field_lowers_the_limits_of_a_design(known, capsys):
    """1.28e7 V/m in 0.5 mm, 4000 V/V: 1.6 V, as of the test of high_v above."""
    actuator, *_ = known
    text = actuator.read_text().replace("# high_v = 2.0", "highest_field_v_per_m = 1.28e7")
    text = text.replace("# gain_v_per_v = 5000.0", "gain_v_per_v = 4000.0")
    text = text.replace("# gap_m = 1e-3", "gap_m = 0.5e-3")
    eq4 = "\n[drive.voltage_map]\na1_v = 1.324\nb1 = 3.124\na2_v = -0.2805\nb2 = -26.92\n\n[model]"
    actuator.write_text(text.replace("\n[model]", eq4, 1))
    assert run(capsys, "design", actuator)[0] == 0
    limits = tomllib.loads(actuator.read_text())["controller"]["limits"]
    assert limits["high"] == pytest.approx(0.0692, abs=2e-4)


def test_init_states_the_gain_of_the_amplifier(tmp_path, capsys):
    path = tmp_path / "a.toml"
    assert run(capsys, "init", "leg", "--gain-v-per-v", "1000", "--out", path)[0] == 0
    assert tomllib.loads(path.read_text())["drive"]["gain_v_per_v"] == 1000.0


def test_compare_draws_the_prediction_with_its_band(known, capsys, tmp_path):
    actuator, _, second = known
    figure = tmp_path / "prediction.svg"
    assert run(capsys, "compare", actuator, second, "--plot", figure)[0] == 0
    text = figure.read_text()
    assert "predicted, 95 % band" in text and "Measured less predicted" in text


@pytest.mark.parametrize("section", ["drive.voltage_map", "sensing.strain_map"])
@pytest.mark.parametrize(
    ("matrix", "rows"), [("[[1.0, 0.0], [0.0]]", "[2, 1]"), ("[[1.0]]", "[1]")], ids=str
)
def test_a_ragged_covariance_of_a_map_is_one_line(files, tmp_path, capsys, section, matrix, rows):
    actuator, *_ = files
    numbers = "slope_per_f = 1e8\noffset = -0.1\n"
    if section == "drive.voltage_map":
        numbers = MAP.split("]\n")[1]
    actuator.write_text(f"{actuator.read_text()}\n[{section}]\n{numbers}covariance = {matrix}\n")
    code, _, error = run(capsys, "report", actuator, "--out", tmp_path / "page.html")
    assert code == 2 and error == (
        f"haselab: 1 error: {section}.covariance: must be 4 rows of 4 numbers, not rows "
        f"of {rows}. Change these values. File: {actuator}\n"
    )


def test_a_model_of_a_length_is_not_designed_for_a_loop_of_strain(tmp_path, capsys):
    path = tmp_path / "metres.toml"
    path.write_text(
        "[drive]\nlow_v = 0.0\nhigh_v = 2.0\n"
        "voltage_map = {a1_v = 1.324, b1 = 3.124, a2_v = -0.2805, b2 = -26.92}\n"
        "[model]\ngain = 1.0\nnatural_frequency_rad_s = 32.0\ndamping_ratio = 0.12\n"
        'rate_hz = 100.0\nloop_delay_s = 0.0075\ninput_unit = "1"\noutput_unit = "m"\n'
    )
    code, _, error = run(capsys, "design", path)
    assert code == 2 and "The output of [model] is in m, but the maps of this file are for" in error
    path.write_text(path.read_text().replace('output_unit = "m"', 'output_unit = "1"'))
    assert run(capsys, "design", path)[0] == 0


@pytest.mark.parametrize("kind", ["planar-hasel", "peano-hasel", "curling-hasel", "dea-stack"])
def test_the_parameters_of_a_new_file_are_the_defaults_of_its_kind(kind, tmp_path, capsys):
    path = tmp_path / "A.toml"
    assert run(capsys, "init", "x", "--kind", kind, "--out", path)[0] == 0
    head, mark, rest = path.read_text().partition("[actuator.parameters]\n")
    lines, gap, tail = rest.partition("\n\n")
    stated = [line.removeprefix("# ") if " = " in line else line for line in lines.splitlines()]
    path.write_text(head + mark + "\n".join(stated) + gap + tail)
    law = law_of_section(load_actuator(path).actuator, path)
    assert law == ACTUATORS.find(kind)()
    assert sum(" = " in line for line in stated) == len(law.described())
