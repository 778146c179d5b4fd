"""`haselab design`, run as a user runs it."""

import json
import math
import tomllib

import pytest

from haselab.base import Estimate
from haselab.cli.main import main
from haselab.control import PidGains, margins
from haselab.models.plant import Plant, SlowMode

PLANT = Plant(1.0, 32.1, 0.12, slow_modes=(SlowMode(0.5, 6.0),))
KEYS = {
    "kp", "ki", "kd", "derivative_filter_s", "phase_margin_deg", "gain_margin_db",
    "delay_margin_s", "peak_sensitivity", "crossover_rad_s", "rise_time_s",
    "raw_rise_time_s", "overshoot", "settling_time_s",
}  # fmt: skip


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"plant": PLANT.to_dict()}))
    return path


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def test_the_answer_holds_the_contracts_keys_and_true_margins(model, tmp_path, capsys):
    out = tmp_path / "deep" / "controller.toml"
    code, text, error = run(capsys, "design", model, "--structure", "pi", "--json", "--out", out)
    assert (code, error) == (0, "")
    answer = json.loads(text)
    assert set(answer) >= KEYS
    gains = PidGains(answer["kp"], answer["ki"])
    found = margins(PLANT, gains, loop_delay_s=0.01, rate_hz=100.0)
    assert answer["phase_margin_deg"] == pytest.approx(found.phase_margin_deg)
    assert answer["delay_margin_s"] == pytest.approx(found.delay_margin_s)
    assert tomllib.loads(out.read_text())["model"]["gain"] == PLANT.gain
    written = tomllib.loads(out.read_text())["controller"]
    assert written["kind"] == "pi"
    assert written["parameters"]["ki"] == answer["ki"]
    assert written["limits"] == {"low": -0.05, "high": 0.1}
    assert written["loop"] == {"rate_hz": 100.0, "measurement_delay_s": 0.01}
    assert math.isclose(written["predicted"]["overshoot"], answer["overshoot"])


def test_demands_of_a_file_are_met_or_the_command_exits_with_3(model, tmp_path, capsys):
    spec, out = tmp_path / "spec.toml", tmp_path / "controller.toml"
    spec.write_text("rise_time_s = 0.01\novershoot = 0.02\n")
    arguments = ("design", model, "--spec", spec, "--structure", "pi", "--out", out)
    code, text, error = run(capsys, *arguments)
    assert (code, text) == (3, "") and not out.exists()
    assert "rise time in s" in error and error.count("\n") == 1
    assert run(capsys, *arguments, "--accept-shortfalls")[0] == 0
    assert (
        "rise time in s"
        in tomllib.loads(out.read_text())["controller"]["predicted"]["shortfalls"][0]
    )


def test_a_step_that_rings_is_named_beside_its_rise_time(tmp_path, capsys):
    model = tmp_path / "model.json"
    model.write_text(json.dumps({"plant": Plant(1.0, 30.0, 0.03).to_dict()}))
    spec = tmp_path / "spec.toml"
    spec.write_text("rise_time_s = 0.05\novershoot = 1.0\nphase_margin_deg = 20.0\n")
    words = ("design", model, "--structure", "pi", "--spec", spec, "--accept-shortfalls")
    code, _, error = run(capsys, *words)
    assert code == 0 and "the step response rings by" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "model.json is not a JSON document"),
        ("{}", "The model has the keys none"),
        ('{"poles": []}', "The model has the keys poles"),
        ('{"plant": {"gain": 1}}', "natural_frequency_rad_s"),
        ('{"plant": {"natural_frequency_rad_s": 5, "damping_ratio": 0.1}}', "gain"),
        (
            '{"plant": {"gain": 1, "natural_frequency_rad_s": -3, "damping_ratio": 0.1}}',
            "natural_frequency_rad_s: must be greater than 0",
        ),
    ],
)
def test_an_unusable_model_is_one_line_and_exit_2(text, message, tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(text)
    code, out, error = run(capsys, "design", path)
    assert (code, out) == (2, "")
    assert message in error and error.count("\n") == 1


def test_the_answer_of_identify_transfer_is_a_model(tmp_path, capsys):
    """Estimates with intervals stand for their values; a delay estimated below zero is zero."""
    fitted = {
        "natural_frequency_rad_s": Estimate.normal(32.1, 0.1, "rad/s").to_dict(),
        "damping_ratio": Estimate.normal(0.12, 0.001, "").to_dict(),
        "gain": Estimate.normal(1.0, 0.01, "").to_dict(),
        "delay_s": Estimate.normal(-1e-4, 1e-4, "s").to_dict(),
        "poles": [[-3.9, 31.9], [-3.9, -31.9]],
        "slow_modes": [
            {
                "gain": Estimate.normal(0.5, 0.01, "").to_dict(),
                "time_constant_s": Estimate.normal(6.0, 0.1, "s").to_dict(),
            }
        ],
    }
    answers = []
    for name, content in (("fit.json", fitted), ("model.json", {"plant": PLANT.to_dict()})):
        (tmp_path / name).write_text(json.dumps(content))
        code, text, _ = run(
            capsys, "design", tmp_path / name, "--structure", "pi", "--json", "--seed", "4"
        )
        assert code == 0
        answers.append(json.loads(text))
    assert answers[0] == answers[1]


@pytest.mark.parametrize("text", ["rise = 1\n", "rise_time_s = \n", "overshoot = true\n"])
def test_an_unusable_specification_is_one_line_and_exit_2(text, model, tmp_path, capsys):
    spec = tmp_path / "spec.toml"
    spec.write_text(text)
    code, _, error = run(capsys, "design", model, "--spec", spec)
    assert code == 2 and error.count("\n") == 1


def test_a_missing_model_is_exit_2(tmp_path, capsys):
    code, _, error = run(capsys, "design", tmp_path / "none.json")
    assert code == 2 and error.endswith("none.json\n")


def test_delay_and_rate_are_those_that_the_model_was_measured_with(tmp_path, capsys):
    model = tmp_path / "model.json"
    stated = {"plant": PLANT.to_dict(), "rate_hz": 50.0, "loop_delay_s": 0.023}
    for options, expected in (
        ((), {"rate_hz": 50.0, "measurement_delay_s": 0.023}),
        (("--delay-s", 0.004), {"rate_hz": 50.0, "measurement_delay_s": 0.004}),
        (("--rate-hz", 200), {"rate_hz": 200.0, "measurement_delay_s": 0.023}),
    ):
        model.write_text(json.dumps(stated))
        out = tmp_path / "controller.toml"
        arguments = ("design", model, "--structure", "pi", "--out", out, *options)
        assert run(capsys, *arguments, "--accept-shortfalls", "--force")[0] == 0
        assert tomllib.loads(out.read_text())["controller"]["loop"] == expected
    for wrong in ("late", -1.0, [0.01]):
        model.write_text(json.dumps(stated | {"loop_delay_s": wrong}))
        code, _, error = run(capsys, "design", model)
        assert code == 2
        assert error.startswith("haselab: 1 error: loop_delay_s: must be ")


def test_margins_of_a_designed_controller_are_those_that_the_design_stated(tmp_path, capsys):
    """The model states no rate and no delay; the design had options for both."""
    file = tmp_path / "a.toml"
    file.write_text("[model]\ngain = 0.8\nnatural_frequency_rad_s = 32.0\ndamping_ratio = 0.3\n"
                    "[drive]\nhigh_v = 2.0\n")  # fmt: skip
    options = ("--rate-hz", 50, "--delay-s", 0.02, "--controller", "pi", "--accept-shortfalls")
    assert run(capsys, "design", file, *options)[0] == 0
    stated = tomllib.loads(file.read_text())["controller"]["margins"]
    code, out, _ = run(capsys, "margins", file, "--controller", "pi", "--json")
    found = json.loads(out)
    assert (code, found["rate_hz"], found["delay_s"]) == (0, 50.0, 0.02)
    assert found["gain_margin_db"] == pytest.approx(stated["gain_margin_db"], abs=1e-6)
    code, out, _ = run(capsys, "margins", file, "--controller", "pi", "--rate-hz", 100, "--json")
    assert (json.loads(out)["rate_hz"], json.loads(out)["delay_s"]) == (100.0, 0.02)


def test_a_misspelled_gain_is_not_a_missing_model(tmp_path, capsys):
    file = tmp_path / "a.toml"
    file.write_text("[model]\ngian = 0.8\ndamping_ratio = 0.3\n[drive]\nhigh_v = 2.0\n")
    code, _, error = run(capsys, "design", file)
    assert code == 2 and "[model] has gian, damping_ratio, but neither gain nor numerator" in error


def test_margins_of_given_gains_are_those_of_the_library(model, capsys):
    code, text, _ = run(
        capsys, "margins", model, "--kp", 0, "--ki", 8.95, "--kd", 0.0152,
        "--derivative-filter-s", 0.005, "--json",
    )  # fmt: skip
    answer, gains = json.loads(text), PidGains(0.0, 8.95, 0.0152, 0.005)
    found = margins(PLANT, gains, loop_delay_s=0.01, rate_hz=100.0)
    assert code == 0 and answer["stable"] is True
    for key in ("phase_margin_deg", "gain_margin_db", "delay_margin_s", "peak_sensitivity"):
        assert answer[key] == pytest.approx(getattr(found, key)), key


def test_a_plant_of_negative_gain_is_refused_with_the_way_out(tmp_path, capsys):
    path = tmp_path / "negative.json"
    path.write_text(json.dumps({"plant": Plant(-1.0, 32.1, 0.12).to_dict()}))
    code, _, error = run(capsys, "design", path)
    assert code == 2 and "--limits" in error
    assert "a minus before the name of the output column" in error


def test_margins_of_a_derivative_without_its_filter_say_so(model, capsys):
    words = ("margins", model, "--kp", 0.5, "--ki", 2.0, "--kd", 0.01)
    code, _, error = run(capsys, *words)
    assert code == 0 and "the derivative is not filtered" in error and error.count("\n") == 1
    assert run(capsys, *words, "--derivative-filter-s", 0.02)[::2] == (0, "")


def test_default_limits_are_reported_if_the_drive_reaches_further(model, tmp_path, capsys):
    """The map of eq. 4 of the paper reaches a strain of 0.069 at 1.6 V, and 0.133 at 2 V."""
    path = tmp_path / "A.toml"
    assert run(capsys, "design", model, "--out", path)[0] == 0
    text = path.read_text()
    kept = text[: text.index("[controller.limits]")]
    for high_v, named in ((2.0, True), (1.6, False)):
        path.write_text(
            f"{kept}\n[drive]\nlow_v = 0.0\nhigh_v = {high_v}\n[drive.voltage_map]\n"
            "a1_v = 1.324\nb1 = 3.124\na2_v = -0.2805\nb2 = -26.92\n"
            "strain_low = -0.04\nstrain_high = 0.3\nresidual_v = 0.01\n"
        )
        code, _, error = run(capsys, "design", path, "--json")
        assert code == 0 and ("No limits are stated" in error) == named
        if named:
            assert "strains of -0.05 to 0.1. The voltage map reaches -0.04 to 0.133" in error
            assert run(capsys, "design", path, "--json", "--limits", "-0.04", "0.05")[2] == ""
