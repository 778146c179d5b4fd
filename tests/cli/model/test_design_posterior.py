"""`haselab design` on models that carry their covariance."""

import json
import math
import tomllib

import numpy as np
import pytest

from haselab.base import to_plain
from haselab.cli.main import main
from haselab.models import Plant, PlantPosterior

NAMES = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
VALUES = (1.0, 32.1, 0.12, 0.012)
SPEC = "frequency_spread = 0.0\n"


def model_of(std, values=VALUES):
    posterior = PlantPosterior(
        NAMES, (False, True, True, False), np.array(values), np.diag(std) ** 2
    )
    plant = Plant(*values).to_dict() | {"covariance": to_plain(posterior.to_dict())}
    return {"plant": plant}


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


@pytest.fixture
def wide(tmp_path):
    (tmp_path / "spec.toml").write_text(SPEC)
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model_of((0.05, 0.05, 0.2, 0.001))))
    return path


def test_a_model_with_its_covariance_is_judged_and_a_doubtful_share_is_a_warning(
    wide, tmp_path, capsys
):
    arguments = ("design", wide, "--structure", "pi", "--spec", tmp_path / "spec.toml")
    out = tmp_path / "controller.toml"
    code, text, error = run(capsys, *arguments, "--json", "--out", out)
    answer = json.loads(text)
    share = answer["posterior"]["margins"]
    assert code == 0 and 0.3 < share["value"] < 0.7
    assert share["std"] == pytest.approx(math.sqrt(share["value"] * (1 - share["value"]) / 400))
    assert error.startswith("haselab: warning: only ") and error.count("\n") == 1
    assert f"{100 * share['value']:.4g} % of 400 plausible plants" in error
    table = tomllib.loads(out.read_text())["controller"]["plausible"]
    assert table["draws"] == 400 and table["margins"] == share["value"]
    # The same gains as without the covariance.
    bare = json.loads(wide.read_text())
    del bare["plant"]["covariance"]
    wide.write_text(json.dumps(bare))
    code, text, error = run(capsys, *arguments, "--json")
    assert (code, error) == (0, "")
    del answer["posterior"]
    bare_answer = json.loads(text)
    assert bare_answer.pop("uncertainty") == "no uncertainty: the model has no covariance"
    assert bare_answer == answer


def test_gains_by_probability_reach_the_share_or_say_what_is_reachable(wide, tmp_path, capsys):
    arguments = ("design", wide, "--structure", "pi", "--spec", tmp_path / "spec.toml")
    code, text, error = run(capsys, *arguments, "--probability", 0.9, "--draws", 200)
    assert (code, error) == (0, "")
    line = next(line for line in text.splitlines() if line.startswith("posterior"))
    assert float(line.split()[1]) >= 90.0
    assert "% of 200 plausible plants" in line and "keep 50 deg and 6 dB" in line
    wide.write_text(json.dumps(model_of((1.0, 0.05, 0.2, 0.001))))  # positive: 84 %
    code, text, error = run(capsys, *arguments, "--probability", 0.97, "--draws", 100)
    assert (code, text) == (3, "") and error.count("\n") == 1
    assert "at most" in error and "lower --probability" in error


def test_a_probability_without_a_covariance_is_exit_2(tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"plant": Plant(*VALUES).to_dict()}))
    code, _, error = run(capsys, "design", path, "--probability", 0.9)
    assert code == 2 and "needs the covariance of the model" in error and error.count("\n") == 1


def changed(key, value):
    model = model_of((0.05, 0.05, 0.2, 0.001))
    model["plant"]["covariance"][key] = value
    return model


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (changed("values", [1.0, 32.1, None, 0.012]), "damping_ratio is not identifiable"),
        (changed("matrix", [[None] * 4] * 4), "gain is not identifiable"),
        (changed("values", [1.0, 40.0, 0.12, 0.012]), "belongs to other parameters"),
        (changed("matrix", [[1.0]]), "has rows of [1] numbers, but its 4 names need as many"),
        (changed("matrix", [[1.0] * 4, [1.0]]), "has rows of [4, 1] numbers"),
        (changed("matrix", "wide"), "matrix: must be a number, not a text"),
        (changed("names", ["gain"] * 4), "all names must differ"),
    ],
)
def test_a_covariance_that_cannot_be_used_is_one_line_and_exit_2(model, message, tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model))
    code, out, error = run(capsys, "design", path)
    assert (code, out) == (2, "") and message in error and error.count("\n") == 1
    assert error.rstrip().endswith("model.json")


def test_a_fitted_model_carries_its_covariance_into_the_design(tmp_path, capsys):
    """Three poles and a zero: from a file of columns to the share."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.normal(size=500), 4)
    time_s = np.arange(u.size) / 400.0
    y = Plant(1.0, 32.1, 0.12, 0.01).simulate(u[::4], 100.0, time_s)
    data, fit = tmp_path / "data.npz", tmp_path / "fit.json"
    np.savez(data, u=u, y=y + 0.02 * rng.normal(size=u.size), rate_hz=400.0)
    arguments = ("identify", "transfer", data, "--held-at-hz", 100, "--poles", 2, "--zeros", 1,
                 "--delay", 0.01, "--out", fit)  # fmt: skip
    assert run(capsys, *arguments)[0] == 0
    covariance = json.loads(fit.read_text())["covariance"]
    assert covariance["names"][-2:] == ["gain", "numerator_1"]
    assert [len(row) for row in covariance["matrix"]] == [5] * 5
    code, text, _ = run(capsys, "design", fit, "--structure", "pi", "--json", "--draws", 50)
    assert code == 0 and json.loads(text)["posterior"]["stable"]["value"] == 1.0


def test_a_number_that_is_not_identifiable_is_named(tmp_path, capsys):
    """A slow branch that the record does not show: null in the file, its name in the error."""
    rng = np.random.default_rng(5)
    u = rng.normal(size=400)
    y = Plant(1.0, 32.1, 0.12, 0.01).simulate(u, 100.0, np.arange(400) / 100.0)
    data, fit = tmp_path / "data.npz", tmp_path / "fit.json"
    np.savez(data, u=u, y=y + 0.02 * rng.normal(size=u.size), rate_hz=100.0)
    assert run(capsys, "identify", "transfer", data, "--slow-modes", 1, "--out", fit)[0] == 0
    assert None in json.loads(fit.read_text())["covariance"]["values"]
    code, _, error = run(capsys, "design", fit)
    assert code == 2 and error.startswith("haselab: slow_") and "is not identifiable" in error
    assert error.count("\n") == 1
