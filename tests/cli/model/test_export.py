"""`haselab export`: what identify writes goes to other tools and comes back."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import signal
from scipy.io import loadmat, savemat

from haselab.base import InputError
from haselab.cli.main import cli
from haselab.models import Plant, RationalModel, SlowMode

PLANT = Plant(0.5, 5.11, 0.09, 0.012, (SlowMode(0.4, 4.7),))
OMEGA_RAD_S = np.geomspace(0.01, 50.0, 50)


def export(*arguments):
    result = CliRunner().invoke(
        cli, ["export", *map(str, arguments), "--json"], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(json.dumps({"plant": PLANT.to_dict()}))
    return path


def test_a_plant_goes_through_every_form_and_comes_back(model, tmp_path):
    mat, general = tmp_path / "model.mat", tmp_path / "rational.json"
    export(model, "--to", "mat", "--out", mat, "--input-name", "voltage")
    export(mat, "--to", "json", "--out", general)
    assert json.loads(general.read_text())["input"] == "voltage"
    plant = Plant.from_dict(export(general, "--to", "plant")["plant"])
    expected = PLANT.frequency_response(OMEGA_RAD_S)
    assert np.abs(plant.frequency_response(OMEGA_RAD_S) / expected - 1).max() <= 1e-10
    assert plant.delay_s == 0.012


def test_the_names_of_the_fit_are_kept(model, tmp_path):
    named = json.loads(model.read_text()) | {"input": "U", "output": "Weg"}
    model.write_text(json.dumps(named))
    answer = export(model, "--to", "json")
    assert (answer["input"], answer["output"]) == ("U", "Weg")
    assert export(model, "--to", "json", "--output-name", "x")["output"] == "x"


def test_the_mat_file_holds_what_tf_takes(model, tmp_path):
    path = tmp_path / "model.mat"
    export(model, "--to", "mat", "--out", path)
    struct = loadmat(path, simplify_cells=True)["model"]
    assert {"num", "den", "delay", "Ts", "InputName", "OutputName"} == set(struct)
    _, gain = signal.TransferFunction(struct["num"], struct["den"]).freqresp(OMEGA_RAD_S)
    expected = PLANT.frequency_response(OMEGA_RAD_S) * np.exp(1j * OMEGA_RAD_S * struct["delay"])
    assert np.abs(gain / expected - 1).max() <= 1e-10


def test_a_fit_with_zeros_keeps_its_poles_and_gain(tmp_path):
    number = {"value": 0.7, "std": 0.1, "ci95": [0.5, 0.9], "unit": ""}
    fit = {
        "natural_frequency_rad_s": None, "damping_ratio": None, "gain": number,
        "delay_s": number | {"value": -0.001},
        "poles": [[-1.0, 2.0], [-1.0, -2.0], [-4.0, 0.0], [-0.2, 0.0]], "zeros": [[-3.0, 0.0]],
        "slow_modes": [{"gain": number, "time_constant_s": number | {"value": 5.0}}],
    }  # fmt: skip
    path = tmp_path / "fit.json"
    path.write_text(json.dumps(fit))
    made = RationalModel.from_dict(export(path, "--to", "json"))
    assert made.delay_s == 0.0
    assert sorted(made.poles.real) == pytest.approx([-4.0, -1.0, -1.0, -0.2])
    s = 1j * OMEGA_RAD_S
    fast = 0.7 * (1 + s / 3) / ((1 + s / 4) * (1 + 0.4 * s + 0.2 * s**2))
    expected = fast + 0.7 / (5.0 * s + 1.0)
    assert np.abs(made.frequency_response(OMEGA_RAD_S) / expected - 1).max() <= 1e-10
    with pytest.raises(InputError, match="a Plant must not have one"):
        export(path, "--to", "plant")
    path.write_text(json.dumps(fit | {"gain": number | {"value": None}}))
    with pytest.raises(InputError, match="gain: must be a valid number \\(got None\\)"):
        export(path, "--to", "json")


def test_a_twin_file_is_named_and_not_called_an_actuator_file(tmp_path):
    path = tmp_path / "my-twin.toml"
    path.write_text('name = "my twin"\n[load]\nmass_kg = 0.2\n')
    for words in (["export", path, "--to", "json"], ["design", path]):
        with pytest.raises(InputError, match="is a twin file") as caught:
            cli.main(list(map(str, words)), standalone_mode=False)
        assert str(caught.value) == (
            f"{path} is a twin file, which has no [model]. Name an actuator file, or export the "
            f"twin with: haselab export {path} --to fmu --out TWIN.fmu"
        )


def test_what_is_no_model_is_refused(model, tmp_path):
    with pytest.raises(InputError, match="--to mat needs a file to write"):
        export(model, "--to", "mat")
    path = tmp_path / "x.json"
    path.write_text("{}")
    with pytest.raises(InputError, match="The model has the keys none"):
        export(path, "--to", "json")
    mat = tmp_path / "x.mat"
    savemat(mat, {"model": {"num": [1.0], "den": [1.0, 2.0], "Ts": 0.1}})
    with pytest.raises(InputError, match="discrete time"):
        export(mat, "--to", "json")
    savemat(mat, {"model": {"num": [1.0]}})
    with pytest.raises(InputError, match="must have num and den"):
        export(mat, "--to", "json")
