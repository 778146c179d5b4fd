"""`haselab identify actuator` from tables, as a lab without sessions of haselab has them."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, DeaStack, Drive, SampledLaw, measured_parameters
from haselab.base import InputError
from haselab.cli.identify.common import refuse_copies
from haselab.cli.main import main
from haselab.identify.physical.plausible import motion_before_drive
from haselab.pipelines.motion_table import motion_of_table

LAW = DeaStack(shear_modulus_pa=18e3, permittivity=3.3, damping_n_s_per_m=1.6)
GAIN, LENGTH_STD_M, CAPACITANCE_STD_F = 4000.0, 4e-6, 3e-13
HEADER = "# a stack\n[actuator]\nkind = 'dea-stack'  # mine\nmass_kg = 0.3\nowner = 'ada'\n"


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main(["identify", "actuator", *map(str, arguments)])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def table(path, mass_kg, *, seed=1, law=LAW, gain=GAIN, rows=1200, shift_m=0.0, high_v=9e3):
    """Held random voltages of 0 to 9 kV, what the law does, and noise."""
    rng = np.random.default_rng(seed)
    time_s = 0.01 * np.arange(rows)
    u = np.repeat(rng.uniform(0.0, high_v / gain, rows // 25), 25)
    u[:50] = 0.0
    same = np.ones(rows)
    drive = Drive(
        np.append(time_s, 0.01 * rows), gain * u, mass_kg * GRAVITY_M_S2 * same, mass_kg * same,
        0.0 * same,
    )  # fmt: skip
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(0.0, 0.0, mass_kg * GRAVITY_M_S2)
    seen_m = sampled.respond(drive, time_s, start).length_m
    length_m = seen_m + shift_m + LENGTH_STD_M * rng.standard_normal(rows)
    capacitance_f = law.capacitance_f(seen_m) + CAPACITANCE_STD_F * rng.standard_normal(rows)
    columns = np.column_stack([time_s, 1e3 * u, length_m, 1e12 * capacitance_f])
    np.savetxt(path, columns, "%.12g", ";", header="Zeit (s);U (mV);length_m;C (pF)", comments="")
    return path


@pytest.fixture
def actuator(tmp_path):
    path = tmp_path / "A.toml"
    path.write_text(HEADER + f"[drive]\ngain_v_per_v = {GAIN}\n")
    return path


ASSUMED = "haselab: defaults of the kind dea-stack, which are not fitted: actuator.layers = 50"
COLUMNS = ("--time", "Zeit", "--input", "U", "--output", "length_m", "--output", "C")


@pytest.mark.long
def test_two_tables_of_two_masses_give_the_law(actuator, tmp_path, capsys):
    files = [table(tmp_path / f"{m}.csv", m, seed=k) for k, m in enumerate((0.1, 0.3))]
    masses = "--mass-kg", "0.1", "--mass-kg", "0.3"
    code, text, _ = run(capsys, *files, "--actuator", actuator, *COLUMNS, *masses, "--json")
    answer = json.loads(text)
    assert code == 0 and answer["status"] == "ok", answer["status"]
    for name, true in (("shear_modulus_pa", 18e3), ("permittivity", 3.3),
                       ("damping_n_s_per_m", 1.6), ("layer_thickness_m", 7e-4)):  # fmt: skip
        found = answer["parameters"][f"actuator.{name}"]
        assert found["value"] == pytest.approx(true, abs=4.0 * found["std"]), name
    # 4 standard deviations of the rms of 2,400 values
    within = 4.0 / np.sqrt(2.0 * 2400)
    assert answer["residual_rms"]["length_m"] == pytest.approx(LENGTH_STD_M, rel=within)
    assert answer["residual_rms"]["capacitance_f"] == pytest.approx(CAPACITANCE_STD_F, rel=within)
    written = actuator.read_text()
    assert written.startswith(HEADER)
    physical = tomllib.loads(written)["model"]["physical"]
    assert physical["records"]["gain_v_per_v"] == GAIN and physical["mass_kg"] == 0.3
    # the model predicts a third table, and says that the first is no validation
    new = table(tmp_path / "new.csv", 0.2, seed=9)
    options = ("--time", "Zeit", "--input", "U", "--output", "length_m", "--mass-kg")
    for file, mass_kg, expected in ((new, 0.2, 0), (files[0], 0.1, 3)):
        with pytest.raises(SystemExit) as stop:
            main(["compare", str(actuator), str(file), *options, str(mass_kg)])
        assert stop.value.code == expected
    assert "not a validation" in capsys.readouterr().err


@pytest.mark.long
def test_each_parameter_and_linear_model_is_one_readable_line(actuator, tmp_path, capsys):
    file, out = table(tmp_path / "a.csv", 0.3), tmp_path / "answer.json"
    code, text, err = run(capsys, file, "--actuator", actuator, *COLUMNS, "--out", out)
    assert ASSUMED in err
    answer, lines = json.loads(out.read_text()), text.splitlines()
    assert code == 0 and max(map(len, lines)) <= 120
    sources = answer["determined_by"]["actuator.permittivity"]
    (line,) = [one for one in lines if one.startswith("  actuator.permittivity") and " x" in one]
    assert line.count(" x") == len(sources)
    assert f"{sources[0]['channel']} x{sources[0]['variance_growth']:.3g}" in line
    models = answer["linear_models"]
    shown = [one for one in lines if " V, 0.3 kg " in one]
    assert len(shown) == len(models) == 5
    pole = max(models[0]["poles"], key=lambda one: one[1])
    assert f"{pole[0]:.4g} ± {pole[1]:.4g}i" in shown[0]


def test_dimensions_that_are_stated_are_not_named_as_defaults(actuator, tmp_path, capsys):
    law = DeaStack()
    assert actuator.read_text().startswith(HEADER)
    dimensions = "".join(f'"{k}" = {v}\n' for k, v in measured_parameters(law).items())
    actuator.write_text(f"{actuator.read_text()}\n[actuator.parameters]\n{dimensions}")
    file = table(tmp_path / "few.csv", 0.3, rows=100)
    file.write_text("\n".join(file.read_text().splitlines()[:8]))  # too few for a search
    code, _, err = run(capsys, file, "--actuator", actuator, *COLUMNS)
    assert code == 3 and "defaults of the kind" not in err
    actuator.write_text(actuator.read_text().replace('"actuator.layers" = 50.0\n', ""))
    code, _, err = run(capsys, file, "--actuator", actuator, *COLUMNS)
    assert code == 3 and f"{ASSUMED}. State what you measured in [actuator.parameters]." in err


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--mass-kg", "0.15"), "contradict"),
        (("--mass-kg", "0.3", "--gain-v-per-v", "1"), "check the amplifier's gain"),
    ],
)  # fmt: skip
def test_a_wrong_mass_gain_or_unit_gives_no_numbers(actuator, tmp_path, capsys, options, words):
    before = actuator.read_text()
    file = table(tmp_path / "a.csv", 0.3, rows=600)
    code, text, error = run(capsys, file, "--actuator", actuator, *COLUMNS, *options, "--json")
    assert code == 3 and words in error, error
    assert json.loads(text)["parameters"] == {}
    assert actuator.read_text() == before


@pytest.mark.long
def test_intervals_allow_for_the_gain_or_mass_that_the_capacitances_contradict(
    actuator, tmp_path, capsys
):
    files = [table(tmp_path / f"{m}.csv", m, seed=k) for k, m in enumerate((0.1, 0.3))]
    for gain, masses in ((1.02 * GAIN, (0.1, 0.3)), (GAIN, (0.1, 0.309))):
        stated = "--mass-kg", masses[0], "--mass-kg", masses[1], "--gain-v-per-v", gain
        code, text, _ = run(capsys, *files, "--actuator", actuator, *COLUMNS, *stated, "--json")
        answer = json.loads(text)
        assert code == 0 and "allow for it" in answer["notes"][0], answer
        for name, true in (("actuator.shear_modulus_pa", 18e3), ("actuator.permittivity", 3.3),
                           ("actuator.damping_n_s_per_m", 1.6), ("sensing.scale", 1.0),
                           ("load.added_inertia_kg", 0.0)):  # fmt: skip
            found = answer["parameters"][name]
            low, high = found["ci95"]
            assert low < true < high, (name, found)
            # 4 * 1.96 times an error of 4.4 % of each; of the lighter mass, as an inertia
            assert high - low < 0.35 * (true or 0.3), (name, found)


@pytest.mark.long
def test_a_wrong_side_of_a_stack_gives_an_impossible_inertia_and_a_note(actuator, tmp_path, capsys):
    """50 layers of 0.7 mm with a side of 35 mm instead of 25 mm seem 7 g heavier."""
    actuator.write_text(
        actuator.read_text() + "[actuator.parameters]\nactuator.side_m = 0.035\n"
        "actuator.shear_modulus_pa = 18e3\nactuator.permittivity = 3.3\n"
    )
    files = [table(tmp_path / f"{m}.csv", m, seed=k) for k, m in enumerate((0.1, 0.3))]
    masses = "--mass-kg", "0.1", "--mass-kg", "0.3"
    code, text, _ = run(capsys, *files, "--actuator", actuator, *COLUMNS, *masses, "--json")
    answer = json.loads(text)
    assert code == 0
    # a third of the own mass of 1,000 kg/m3 moves with the end
    missing_kg = 1000.0 * 50 * 7e-4 * (0.035**2 - 0.025**2) / 3.0
    found = answer["parameters"]["load.added_inertia_kg"]
    assert found["value"] == pytest.approx(-missing_kg, abs=4.0 * found["std"])
    assert any("standard deviations below 0, but no inertia is negative" in note
               for note in answer["notes"])  # fmt: skip


@pytest.mark.long
def test_intervals_allow_for_a_wrong_zero_of_a_displacement_sensor(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, shift_m=20e-6)
    code, text, _ = run(capsys, file, "--actuator", actuator, *COLUMNS, "--json")
    found = json.loads(text)["parameters"]
    assert code == 0
    for name, true in (("actuator.layer_thickness_m", 7e-4), ("camera.offset_m", 20e-6)):
        low, high = found[name]["ci95"]
        assert low < true < high, (name, found[name])
    # the zero of 50 um alone moves the 50 layers of 35 mm by 0.14 %
    assert found["actuator.layer_thickness_m"]["std"] < 2.0 * 7e-4 * 50e-6 / 35e-3
    again = "--zero-std-m", "1e-7", "--json"
    narrow = json.loads(run(capsys, file, "--actuator", actuator, *COLUMNS, *again)[1])
    std = narrow["parameters"]["camera.offset_m"]["std"]
    assert std == pytest.approx(1e-7, rel=0.01)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--mass-kg", "0.1", "--mass-kg", "0.2"), "--mass-kg is given 2 times, but there are 1 f"),
        (("--output", "length_m", "--output", "length_m"), "names two columns in m"),
        (("--output", "U"), "Column U is in V, but the physical model has lengths, strains and"),
        (("--mass-kg", "0"), "Use a mass above 0 kg"),
        (("--rate-hz", "50"), "50"),
    ],
)
def test_what_cannot_be_read_is_refused(actuator, tmp_path, capsys, options, words):
    file = table(tmp_path / "a.csv", 0.3, rows=100)
    names = ("--time", "Zeit", "--input", "U")
    if "--output" not in options:
        names += ("--output", "length_m")
    code, _, error = run(capsys, file, "--actuator", actuator, *names, *options)
    assert code == 2 and words in error, error
    assert error.splitlines()[0].endswith(f"was converted from mV to V. File: {file}") or (
        error.count("\n") == 1
    )


def test_a_record_with_few_values_gives_no_numbers(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=100)
    lines = file.read_text().splitlines()
    kept = [*lines[:5], *lines[8:11]]  # rows 5 to 7 are missing
    file.write_text("\n".join(kept))
    code, _, error = run(capsys, file, "--actuator", actuator, *COLUMNS)
    assert code == 3 and "the records have 14 values, too few for the 15 unknowns" in error, error
    assert "1 steps of the times are longer than the usual 0.01 s, the longest is 0.04 s" in error


def test_a_value_that_is_not_finite_is_left_out_without_its_row(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=100)
    lines = file.read_text().splitlines()
    time, volt, _, farad = lines[6].split(";")
    lines[6] = ";".join([time, volt, "inf", farad])
    file.write_text("\n".join(lines))
    code, _, error = run(capsys, file, "--actuator", actuator, *COLUMNS)
    assert code == 2 and "Column length_m has inf in row 6 (1 such rows). Write nan" in error, error
    assert "Keep the rows" in error and "Remove" not in error


def test_times_that_fall_and_records_given_twice_are_refused(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=100)
    copy = tmp_path / "b.csv"
    copy.write_bytes(file.read_bytes())
    for twice in ((file, file), (file, copy)):
        code, _, error = run(capsys, *twice, "--actuator", actuator, *COLUMNS)
        assert code == 2 and "are the same record" in error, error
    head, first, second, *rest = file.read_text().splitlines()
    file.write_text("\n".join([head, second, first, *rest]))
    code, _, error = run(capsys, file, "--actuator", actuator, *COLUMNS)
    assert code == 2 and "does not increase after row 1" in error, error


def test_a_part_of_a_record_in_another_format_is_refused(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=300)
    rows = np.loadtxt(file, delimiter=";", skiprows=1)
    header = "Zeit (s),U (mV),length_m,C (pF)"
    part = tmp_path / "part.csv"
    np.savetxt(part, rows[60:260], "%.10g", ",", header=header, comments="")
    code, _, error = run(capsys, file, part, "--actuator", actuator, *COLUMNS)
    assert code == 2 and "have the same measured values" in error, error


def test_records_that_share_a_part_give_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As two sessions on one twin that begin with the same experiment."""
    shared, one, other = np.random.default_rng(2).normal(size=(3, 500))
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    refuse_copies(files, [np.r_[shared, one], np.r_[shared, other]])
    said = capsys.readouterr().err
    assert said.startswith("haselab: warning: ") and said.count("\n") == 1
    refuse_copies(files, [one, other])
    assert capsys.readouterr().err == ""
    with pytest.raises(InputError, match=r"b\.csv have the same .* They would count twice"):
        refuse_copies(files, [np.r_[shared, one], shared])


def test_an_actuator_that_does_not_move_gives_no_numbers(actuator, tmp_path, capsys):
    for volt in (0.0, 1250.0):
        file = table(tmp_path / f"{volt}.csv", 0.3, rows=300, high_v=2.0)
        rows = np.loadtxt(file, delimiter=";", skiprows=1)
        rows[:, 1] = volt
        np.savetxt(file, rows, "%.12g", ";", header="Zeit (s);U (mV);length_m;C (pF)", comments="")
        code, _, error = run(capsys, file, "--actuator", actuator, *COLUMNS, "--json")
        assert code == 3 and "the actuator does not move" in error, error


def test_a_kind_that_was_assumed_is_named_if_the_record_contradicts_it(tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=300)
    path = tmp_path / "A.toml"
    for kind, assumed in (("", True), ("kind = 'planar-hasel'\n", False)):
        path.write_text(f"[actuator]\nmass_kg = 0.3\n{kind}[drive]\ngain_v_per_v = {GAIN}\n")
        code, _, error = run(capsys, file, "--actuator", path, *COLUMNS, "--json")
        assert code == 3, error
        assert ("states no kind, so planar-hasel was assumed" in error) is assumed, error


def test_a_load_without_equilibrium_is_named(actuator, tmp_path, capsys):
    file = table(tmp_path / "a.csv", 0.3, rows=300)
    code, _, error = run(capsys, file, "--actuator", actuator, *COLUMNS, "--mass-kg", "100")
    assert code == 3 and "(981 N, 0 V). Check the mass (kg)" in error, error


def test_a_record_that_begins_in_motion_is_named():
    time_s = 0.01 * np.arange(60)
    voltage_v = np.where(time_s < 0.2, 0.0, 3e3)
    rng = np.random.default_rng(1)
    still_m = np.where(time_s < 0.2, 0.035, 0.034) + 1e-6 * rng.standard_normal(60)
    moving_m = still_m - 4e-4 * np.exp(-time_s / 0.1)
    constant_v = np.full(60, 3e3)
    for length_m, drive_v, words in (
        (still_m, voltage_v, ""),
        (moving_m, voltage_v, "before the voltage first changes"),
        (moving_m, constant_v, "although the voltage never changes"),
    ):
        record = motion_of_table(
            "a", time_s, drive_v, mass_kg=0.3, length_m=length_m, length_std_m=1e-6
        )
        assert words in motion_before_drive([record]) and bool(words) == bool(
            motion_before_drive([record])
        )


def test_rows_without_a_measured_value_keep_their_voltage():
    time_s, voltage_v = 0.1 * np.arange(6), np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    length_m = np.array([0.1, np.nan, 0.3, np.nan, 0.5, 0.7])
    capacitance_f = np.array([np.nan, 2.0, 3.0, 5.0, np.nan, 4.0])
    whole, parts = (
        motion_of_table(
            "a", time_s, voltage_v, mass_kg=0.1, length_m=m, capacitance_f=f, length_std_m=0.1,
            capacitance_std_f=0.1,
        )
        for m, f in ((np.arange(6.0), np.arange(6.0)), (length_m, capacitance_f))
    )  # fmt: skip
    assert np.array_equal(whole.drive.voltage_v, parts.drive.voltage_v)
    assert np.array_equal(parts.length_time_s, time_s[[0, 2, 4, 5]])
    assert np.array_equal(parts.length_m, length_m[[0, 2, 4, 5]])
    kept = [1, 2, 3, 5]
    assert np.array_equal(parts.capacitance_f, capacitance_f[kept])
    assert np.array_equal(parts.window, whole.window[kept])
    assert np.array_equal(parts.capacitance_later_s, whole.capacitance_later_s[kept])


def test_cells_may_be_empty_and_invalid_rows_keep_their_voltage(actuator, tmp_path, capsys):
    file = tmp_path / "a.csv"
    rows = [f"{0.01 * k},{k},{0.03 + 0.001 * (k % 3)},{int(k != 2)}" for k in range(12)]
    rows[4] = "0.04,4,nan,1"
    file.write_text("\n".join(["time_s,u,length_m,valid", *rows]))
    code, _, error = run(capsys, file, "--actuator", actuator)
    # 12 rows without rows 2 and 4, and no gap
    assert code == 3 and "the records have 10 values" in error, error
    assert "left out 1 rows with 0 in column valid" in error and "steps of the times" not in error
