"""`haselab identify model-comparison` and `haselab plan-experiment` on files."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.base import Estimate, InputError, ResultError
from haselab.cli.identify.group import command as identify
from haselab.cli.identify.plan_experiment import command as plan
from haselab.models import Plant, SlowMode, VoltagePlant
from haselab.signals import linear_chirp, square

PLANT = VoltagePlant("mechanical", (0.05, 0.004), 5.11, 0.1, 0.01, 0.35, 3.0)


def write(path, drive_v, plant=PLANT, noise=1e-3):
    time_s = np.arange(drive_v.size) / 100.0
    y = plant.simulate(drive_v, 100.0, time_s)
    y = y + noise * np.random.default_rng(2).normal(size=y.size)
    table = np.column_stack([time_s, drive_v, y])
    np.savetxt(path, table, "%.7g", ",", header="time_s,drive_v,y", comments="")
    return str(path)


def printed(command, *arguments):
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture
def alternation(tmp_path):
    turns, rest = 1.5 * square(0.5, 5.0, 100.0), np.ones(500)
    drive_v = np.concatenate([rest[:100], np.full(500, 1.5), turns, rest, turns])
    return write(tmp_path / "alternation.csv", drive_v)


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    (tmp_path / "twin.toml").write_text('reading = "rad"\n[acquisition]\ndrive_low_v = -2.0\n')
    return str(tmp_path / "rig.toml")


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"voltage_plant": PLANT.to_dict()}))
    return str(path)


def test_the_verdict_comes_with_its_evidence_and_a_model_for_the_plan(alternation, tmp_path):
    out = tmp_path / "verdict.json"
    answer = json.loads(
        printed(
            identify,
            "model-comparison",
            alternation,
            "--question",
            "creep",
            "--json",
            "--out",
            str(out),
        )
    )
    assert answer["verdict"] == "supports mechanical"
    assert answer["supported"] == "mechanical"
    assert [rival["excluded"] for rival in answer["candidates"]] == [False, True]
    assert {"bic", "log_likelihood", "probability", "lead", "misfit"} <= set(
        answer["candidates"][1]
    )
    assert VoltagePlant.from_dict(answer["voltage_plant"]).creep == "mechanical"
    assert json.loads(out.read_text()) == answer
    page = printed(identify, "model-comparison", alternation, "--question", "creep")
    assert page.splitlines()[0] == "supports mechanical"
    assert "excluded" in page


def test_the_plan_of_a_bipolar_rig_alternates_and_writes_its_drive(model, rig, tmp_path):
    out = tmp_path / "drive.csv"
    arguments = (model, "--rig", rig, "--goal", "creep", "--duration-s", "20")
    answer = json.loads(printed(plan, *arguments, "--json", "--out", str(out)))
    assert answer["chosen"].startswith("alternation")
    head, columns, *rows = out.read_text().splitlines()
    assert (head, columns) == ("# rate_hz = 100", "time_s,drive_v")
    drive_v = np.array([float(row.split(",")[1]) for row in rows])
    assert drive_v.size / 100.0 == answer["duration_s"]
    assert -2.0 <= drive_v.min() < 0.0 < drive_v.max() <= 2.0
    assert answer["chosen"] in printed(plan, *arguments)


def test_the_default_rig_has_one_polarity_and_the_plan_says_so(model, tmp_path):
    rig = tmp_path / "unipolar.toml"
    rig.write_text('kind = "twin"\nreading = "rad"\n')
    page = printed(plan, model, "--rig", str(rig), "--goal", "creep", "--duration-s", "20")
    assert "has one polarity" in page
    assert "alternation" not in page.split("The window")[0]


def test_a_linear_model_is_good_enough_to_plan_with(rig, tmp_path):
    linear = Plant(0.5, 5.11, 0.09, 0.01, (SlowMode(0.25, 4.0),))
    path = tmp_path / "linear.json"
    path.write_text(json.dumps({"plant": linear.to_dict()}))
    answer = json.loads(
        printed(
            plan, str(path), "--rig", rig, "--goal", "creep_share", "--duration-s", "20", "--json"
        )
    )
    assert answer["ranked"][0]["std"]["creep_share"] > 0.0


def test_answers_that_agree_and_answers_that_do_not(tmp_path):
    files = {}
    for name, value in (("a", 5.1), ("b", 5.2), ("c", 6.6)):
        path = tmp_path / f"{name}.json"
        estimate = Estimate.normal(value, 0.1, "rad/s").to_dict()
        path.write_text(json.dumps({"natural_frequency_rad_s": estimate}))
        files[name] = str(path)
    ask = ("model-comparison", "--question", "agreement")
    assert printed(identify, *ask, files["a"], files["b"]).splitlines()[0] == "agree"
    answer = json.loads(printed(identify, *ask, *files.values(), "--json"))
    assert answer["verdict"] == "disagree: a and c; b and c"
    unknown = {"value": None, "std": None, "ci95": [None, None], "unit": "rad/s"}
    (tmp_path / "b.json").write_text(json.dumps({"natural_frequency_rad_s": unknown}))
    assert printed(identify, *ask, files["a"], files["b"]).splitlines()[0] == "cannot tell"


def test_modes_of_a_proportional_input(tmp_path):
    u = np.random.default_rng(3).normal(size=1000)
    time_s = np.arange(1000) / 100.0
    y = Plant(0.5, 5.11, 0.09, 0.01).simulate(u, 100.0, time_s)
    y = y + 0.01 * np.random.default_rng(4).normal(size=1000)
    np.savetxt(tmp_path / "u.csv", np.column_stack([u, y]), "%.7g", ",", header="u,y", comments="")
    page = printed(identify, "model-comparison", str(tmp_path / "u.csv"), "--question", "modes",
                "--linear", "--input", "u", "--rate-hz", "100")  # fmt: skip
    assert page.splitlines()[0] == "supports one"


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["model-comparison", "{file}", "--question", "creep", "--output", "z"], "lacks z"),
        (["model-comparison", "{file}", "--question", "creep", "--risk", "0.9"], r"risk = 0\.9"),
        (
            ["model-comparison", "{file}", "--question", "creep", "--linear"],
            "not supported with --question creep",
        ),
        (["model-comparison", "{model}", "--question", "agreement"], "has no estimate"),
    ],
)
def test_bad_use_of_a_model_comparison_is_reported_in_one_line(
    alternation, model, arguments, match
):
    arguments = [argument.format(file=alternation, model=model) for argument in arguments]
    with pytest.raises(InputError, match=match):
        CliRunner().invoke(identify, arguments, catch_exceptions=False)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["--goal", "colour"], "--goal is colour, but must be one of creep, reading"),
        (["--goal", "all", "--capacitance-f", "0"], "--capacitance-f is 0 F"),
        (["--goal", "all", "--baseline-v", "9"], "baseline_v = 9 V"),
        (["--goal", "all", "--duration-s", "-1"], "duration_s = -1 s"),
        (["--goal", "all", "--noise-std", "0"], "noise_std = 0"),
    ],
)
def test_bad_use_of_a_plan_is_reported_in_one_line(model, rig, arguments, match):
    with pytest.raises(InputError, match=match):
        CliRunner().invoke(plan, [model, "--rig", rig, *arguments], catch_exceptions=False)


def test_a_plan_without_a_drive_has_no_result(model, rig):
    with pytest.raises(ResultError, match="no drive stays inside the limits"):
        CliRunner().invoke(
            plan,
            [model, "--rig", rig, "--goal", "all", "--largest-output", "1e-9"],
            catch_exceptions=False,
        )


def test_a_chirp_decides_the_frequency_axis_on_the_command_line(tmp_path):
    drive_v = 1.0 + 0.4 * linear_chirp(0.1, 8.0, 10.0, 100.0)
    file = write(tmp_path / "chirp.csv", drive_v)
    page = printed(identify, "model-comparison", file, "--question", "reading")
    assert page.splitlines()[0] == "supports rad"
