"""`haselab identify` on files: the contract's keys, exit codes and one-line errors."""

import json
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import lfilter

from haselab.base import InputError, ResultError
from haselab.cli.identify.group import command
from haselab.models import (
    LAWS,
    Deformation,
    LinearMap,
    Ogden,
    Plant,
    PrandtlIshlinskii,
    PronyCreep,
    VoltageMap,
)
from haselab.signals import triangle

PLANT = Plant(0.5, 5.11, 0.09, 0.02)
TIME_S = np.arange(2000) / 100.0


def write(path, **columns):
    rows = zip(*columns.values(), strict=True)
    text = "\n".join(",".join(repr(float(cell)) for cell in row) for row in rows)
    path.write_text(",".join(columns) + "\n" + text + "\n")
    return str(path)


def ask(*arguments):
    result = CliRunner().invoke(command, [*arguments, "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def is_estimate(entry):
    return set(entry) == {"value", "std", "ci95", "unit"}


def recorded(path, seed):
    rng = np.random.default_rng(seed)
    u = np.sin(2 * np.pi * (0.1 * TIME_S + 0.1 * TIME_S**2))
    y = PLANT.simulate(u, 100.0, TIME_S) + 0.005 * rng.normal(size=TIME_S.size)
    return write(path, u=u, y=y)


@pytest.fixture
def sweep(tmp_path):
    return recorded(tmp_path / "sweep.csv", 1)


def test_transfer_answers_with_the_keys_of_the_contract(sweep, tmp_path):
    out = tmp_path / "model.json"
    answer = ask("transfer", sweep, "--rate-hz", "100", "--out", str(out))
    truth = {"natural_frequency_rad_s": 5.11, "damping_ratio": 0.09, "gain": 0.5, "delay_s": 0.02}
    for key, value in truth.items():
        assert is_estimate(answer[key])
        assert abs(answer[key]["value"] - value) <= 4 * answer[key]["std"], key
    assert answer["status"] == "ok"
    assert len(answer["poles"]) == 2
    assert {"zeros", "slow_modes", "fit_percent", "validation_fit_percent",
            "residual_whiteness_p"} <= set(answer)  # fmt: skip
    assert json.loads(out.read_text()) == answer


def test_transfer_takes_known_numbers_and_several_files(sweep, tmp_path):
    again = recorded(tmp_path / "again.csv", 2)
    answer = ask("transfer", sweep, again, "--rate-hz", "100", "--delay", "0.02", "--at-rest",
                 "--no-offset", "--fix", "damping_ratio=0.09")  # fmt: skip
    assert answer["delay_s"]["value"] == 0.02
    assert answer["damping_ratio"]["std"] == 0.0


def test_frequency_response_answers_with_arrays_of_one_length(sweep):
    answer = ask("frequency-response", sweep, "--rate-hz", "100")
    keys = ("frequency_hz", "magnitude", "phase_rad", "coherence", "magnitude_std", "phase_std_rad")
    assert len({len(answer[key]) for key in keys}) == 1
    frequency_hz = np.array(answer["frequency_hz"])
    near = (frequency_hz > 0.3) & (frequency_hz < 1.5)
    expected = np.abs(PLANT.frequency_response(2 * np.pi * frequency_hz[near]))
    assert np.abs(np.array(answer["magnitude"])[near] / expected - 1).max() < 0.05


def test_free_response_answers_null_for_a_missing_envelope(tmp_path):
    noise = 1e-5 * np.random.default_rng(2).normal(size=400)
    x = 0.01 * np.exp(-4.0 * TIME_S[:400]) * np.cos(5.1 * TIME_S[:400]) + noise
    answer = ask("free-response", write(tmp_path / "x.csv", x=x, time_s=TIME_S[:400]))
    assert answer["damped_frequency_rad_s"]["value"] == pytest.approx(5.1, rel=0.01)
    assert answer["natural_frequency_rad_s"]["value"] == pytest.approx(6.48, rel=0.01)
    assert answer["envelope_positive_decay_per_s"] is None or is_estimate(
        answer["envelope_positive_decay_per_s"]
    )


def test_hyperelastic_uses_only_the_requested_range(tmp_path):
    stretch = np.linspace(1.0, 5.0, 100)
    stress_pa = Ogden(15e3, 2.4).nominal_stress_pa(stretch)
    stress_pa = stress_pa + 10.0 * np.random.default_rng(3).normal(size=100)
    file = write(tmp_path / "s.csv", stretch=stretch, nominal_stress_pa=stress_pa)
    answer = ask("hyperelastic", file, "--model", "ogden", "--stretch-max", "3")
    assert answer["stretch_range"][1] <= 3.0
    assert answer["parameters"]["mu_pa"]["unit"] == "Pa"
    assert {"model", "r_squared", "aic", "candidates"} <= set(answer)
    assert len(ask("hyperelastic", file)["candidates"]) == len(LAWS)


def test_regions_and_maps_answer_with_the_keys_of_the_contract(tmp_path):
    rng = np.random.default_rng(4)
    stretch = np.linspace(1.0, 2.0, 60)
    load_n = np.where(stretch < 1.6, 3.0 * stretch, 4.8 + 6.0 * (stretch - 1.6))
    load_n = load_n + 0.01 * rng.normal(size=60)
    answer = ask("regions", write(tmp_path / "r.csv", stretch=stretch, load_n=load_n))
    assert answer["regions"][0]["stretch"] == pytest.approx([1.0, 1.6], abs=0.05)
    assert {"slope_n", "r_squared"} <= set(answer["regions"][0])
    assert "chosen" in answer

    strain = 0.05 - 0.09 * np.cos(2 * np.pi * 0.25 * TIME_S)
    volts = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain)
    volts = volts + 0.01 * rng.normal(size=strain.size)
    answer = ask("voltage-map", write(tmp_path / "v.csv", strain=strain, voltage_v=volts))
    assert next(iter(answer)) == "residual_std_v"
    assert {"a1_v", "b1", "a2_v", "b2", "monotone", "hysteresis_width", "r_squared"} <= set(answer)
    assert answer["monotone"] is True

    capacitance = LinearMap(4.923e6, -0.276).relative_capacitance(strain)
    capacitance = capacitance + 1e-11 * rng.normal(size=strain.size)
    answer = ask(
        "capacitance-map",
        write(tmp_path / "c.csv", relative_capacitance=capacitance, strain=strain),
    )
    assert answer["slope"]["value"] == pytest.approx(4.923e6, rel=0.01)
    assert answer["offset"]["value"] == pytest.approx(-0.276, abs=0.003)


def test_no_result_is_a_result_error_with_the_reason_in_the_json(tmp_path):
    rng = np.random.default_rng(5)
    file = write(tmp_path / "n.csv", u=rng.normal(size=500), y=rng.normal(size=500))
    result = CliRunner().invoke(command, ["transfer", file, "--rate-hz", "100", "--json"])
    assert isinstance(result.exception, ResultError)
    assert json.loads(result.stdout)["status"].startswith("no result")


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["transfer", "{sweep}"], "states no sampling rate. Add --rate-hz"),
        (["transfer", "{sweep}", "--input", "v", "--rate-hz", "9"], "lacks v; it has u, y"),
        (["transfer", "{sweep}", "--delay", "soon", "--rate-hz", "9"], "--delay is soon"),
        (["transfer", "{sweep}", "--fix", "gain", "--rate-hz", "9"], "--fix is gain"),
        (["transfer", "{sweep}", "--rate-hz", "-1"], "--rate-hz is -1 Hz"),
        (["transfer", "{sweep}", "--poles", "9", "--rate-hz", "9"], "poles = 9; it must be"),
        (["hyperelastic", "{sweep}"], "lacks stretch, nominal_stress_pa"),
    ],
)
def test_bad_use_is_reported_in_one_line(sweep, arguments, match):
    arguments = [argument.format(sweep=sweep) for argument in arguments]
    with pytest.raises(InputError, match=match):
        CliRunner().invoke(command, arguments, catch_exceptions=False)


def test_the_exit_codes_are_those_of_the_contract(tmp_path):
    rng = np.random.default_rng(6)
    noise = write(tmp_path / "n.csv", u=rng.normal(size=500), y=rng.normal(size=500))
    for code, file in ((3, noise), (2, str(tmp_path / "none.csv"))):
        done = subprocess.run(
            [sys.executable, "-m", "haselab.cli", "identify", "transfer", file, "--rate-hz", "9"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == code
        assert done.stdout == ""
        assert done.stderr.startswith("haselab: ")
        assert done.stderr.count("\n") == 1


def test_the_hair_dryer_file_gives_a_model_that_predicts(shared_data, tmp_path):
    data = np.loadtxt(shared_data / "identification/hair-dryer.csv", delimiter=",", skiprows=1)
    file = write(tmp_path / "dryer.csv", u=data[:, 0], y=data[:, 1])
    answer = ask("transfer", file, "--input", "u", "--output", "y", "--rate-hz", "12.5")
    assert answer["validation_fit_percent"] >= 85.0


def test_a_map_of_any_two_columns_is_written_with_its_spread(tmp_path):
    x = np.tile(np.concatenate([np.linspace(0.0, 1.0, 60), np.linspace(1.0, 0.0, 60)]), 2)
    y = np.tanh(2.0 * x) + 0.01 * np.random.default_rng(7).normal(size=x.size)
    file = write(tmp_path / "m.csv", strain=x, reading=y)
    answer = ask("map", file, "--x", "strain", "--y", "reading", "--monotone")
    assert answer["monotone"] and answer["status"] == "ok"
    off = np.array(answer["y"]) - np.tanh(2.0 * np.array(answer["x"]))
    assert (np.abs(off) <= 4.0 * np.array(answer["y_std"])).all()


def test_a_difference_equation_is_written_with_its_modes(tmp_path):
    u = np.random.default_rng(8).normal(size=600)
    y = lfilter([0.0, 0.0, 0.4], [1.0, -1.5, 0.7], u) + 0.01 * np.random.default_rng(9).normal(
        size=600
    )
    file = write(tmp_path / "a.csv", u=u, y=y)
    answer = ask("arx", file, "--rate-hz", "10", "--na", "2", "--nb", "1", "--nk", "2")
    assert [is_estimate(e) for e in (*answer["a"], *answer["b"])] == [True] * 3
    assert is_estimate(answer["modes"][0]["natural_frequency_rad_s"])
    assert answer["continuous"]["delay_s"] == pytest.approx(0.1)
    assert ask("arx", file, "--rate-hz", "10")["orders"]["nk"] == 2
    with pytest.raises(InputError, match=r"Give all three, or none to choose them"):
        CliRunner().invoke(
            command, ["arx", file, "--rate-hz", "10", "--na", "2"], catch_exceptions=False
        )


def test_several_tests_of_one_rubber_are_fitted_together(tmp_path):
    files, kinds = [], ("uniaxial", "equibiaxial")
    for k, kind in enumerate(kinds):
        stretch = np.linspace(1.0, 2.5, 40)
        stress_pa = Ogden(15e3, 2.4).nominal_stress_pa(*Deformation(kind).stretches(stretch))
        stress_pa = stress_pa + 10.0 * np.random.default_rng([10, k]).normal(size=40)
        files.append(write(tmp_path / f"{kind}.csv", stretch=stretch, nominal_stress_pa=stress_pa))
    named = [word for kind in kinds for word in ("--deformation", kind)]
    answer = ask("hyperelastic", *files, *named, "--model", "ogden", "--at-stretch", "4")
    assert [test["kind"] for test in answer["tests"]] == list(kinds)
    mu = answer["parameters"]["mu_pa"]
    assert abs(mu["value"] - 15e3) <= 4.0 * mu["std"]
    assert is_estimate(answer["asked"][0]["nominal_stress_pa"])
    assert any("Stretch 4 is outside the data" in note for note in answer["notes"])
    for options, match in (
        (["--deformation", "uniaxial"] * 3, "given 3 times for 2 files"),
        (
            ["--deformation", "prestretched"],
            "--prestretch with --deformation prestretched, and only",
        ),
        (["--deformation", "uniaxial", "--lateral-stretch", "3"], "only with it"),
    ):
        with pytest.raises(InputError, match=match):
            CliRunner().invoke(command, ["hyperelastic", *files, *options], catch_exceptions=False)


@pytest.fixture
def loops(tmp_path):
    u = np.tile(triangle(0.0, 2.0, 0.25, 1, 100.0), 3)
    y = PrandtlIshlinskii(0.1, (0.1, 0.3), (0.05, 0.04)).simulate(u)
    y = y + 5e-4 * np.random.default_rng(7).normal(size=u.size)
    return write(tmp_path / "loops.csv", u=u, y=y)


def test_hysteresis_answers_with_a_verdict_and_estimates(loops):
    answer = ask("hysteresis", loops, "--rate-hz", "100", "--from-s", "4")
    assert answer["verdict"] == answer["model"] == "prandtl-ishlinskii"
    assert is_estimate(answer["width"])
    assert [cycle["cycle"] for cycle in answer["cycles"]] == [1, 2]
    threshold = answer["parameters"]["threshold_1"]
    assert abs(threshold["value"] - 0.1) <= 4 * threshold["std"]
    assert answer["parameters"]["rate_dependence_s"]["value"] is None
    asked = ask("hysteresis", loops, "--rate-hz", "100", "--operators", "3", "--model",
                "prandtl-ishlinskii")  # fmt: skip
    assert "threshold_3" in asked["parameters"]


def test_creep_answers_with_a_verdict_and_a_forecast(tmp_path):
    u = np.r_[np.zeros(100), np.ones(1500)]
    y = PronyCreep(1.0, (0.2,), (3.0,)).simulate(u, 50.0)
    y = y + 0.002 * np.random.default_rng(8).normal(size=u.size)
    file = write(tmp_path / "held.csv", u=u, y=y)
    answer = ask("creep", file, "--rate-hz", "50", "--forecast-s", "60")
    assert answer["verdict"] == "prony"
    assert is_estimate(answer["parameters"]["time_constant_1_s"])
    low, high = answer["forecast"]["output"]["ci95"]
    assert low <= 1.2 <= high
    slow = PronyCreep(1.0, (0.2,), (300.0,)).simulate(np.ones(200), 50.0)
    slow = slow + 0.002 * np.random.default_rng(9).normal(size=200)
    short = write(tmp_path / "short.csv", y=slow)
    answer = ask("creep", short, "--rate-hz", "50", "--unit-step", "--model", "prony")
    assert "not identifiable" in " ".join(answer["notes"])


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["hysteresis", "{loops}"], "states no sampling rate"),
        (["hysteresis", "{loops}", "--rate-hz", "9", "--operators", "99"], "operators = 99"),
        (["hysteresis", "{loops}", "--rate-hz", "9", "--from-s", "1e9"], "counted_from_s"),
        (["hysteresis", "{loops}", "--rate-hz", "9", "--input", "volts"], "lacks volts"),
        (["creep", "{loops}", "--rate-hz", "-9"], "--rate-hz is -9 Hz"),
        (["creep", "{loops}", "--rate-hz", "9", "--leave-out-s", "1e9"], "leave_out_s"),
        (["creep", "{loops}", "--rate-hz", "9", "--forecast-s", "-1"], "after_s = -1 s"),
    ],
)
def test_bad_use_of_hysteresis_and_creep_is_reported_in_one_line(loops, arguments, match):
    arguments = [argument.format(loops=loops) for argument in arguments]
    with pytest.raises(InputError, match=match):
        CliRunner().invoke(command, arguments, catch_exceptions=False)
