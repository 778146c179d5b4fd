"""Nonlinear models after their fit: compared with new records, and kept out of actuator files."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import haselab as hl
from haselab.base import InputError
from haselab.cli.main import cli
from haselab.identify.transfer.fit import fit_transfer
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.nonlinear import fit_nonlinear
from haselab.models import Plant
from haselab.models.plant import SlowMode

RATE_HZ, NOISE = 400.0, 0.01


def invoke(*arguments):
    return CliRunner().invoke(cli, [*map(str, arguments)], catch_exceptions=False)


def record(path, seed, curve):
    """Random steps through a curve and a resonance."""
    rng = np.random.default_rng(seed)
    u, time_s = np.repeat(rng.uniform(0.0, 2.0, 300), 10), np.arange(3000) / RATE_HZ
    y = Plant(0.5, 5.11, 0.09).simulate(curve(u), RATE_HZ, time_s)
    table = np.column_stack([time_s, u, y + NOISE * rng.normal(size=y.size)])
    np.savetxt(path, table, "%.17g", ",", header="time_s,u,y", comments="")
    return path


@pytest.mark.parametrize(
    ("kind", "curve"),
    [
        ("hammerstein-2", lambda u: u**2),
        ("hammerstein-2", lambda u: 3.0 * u - 0.7 * (u - 0.2) ** 2),
        ("hammerstein-3", lambda u: u + 0.4 * (u - 0.8) ** 3),
    ],
)
def test_compare_applies_the_curve_of_the_model_file(tmp_path, kind, curve):
    first, new = (record(tmp_path / f"{k}.csv", k, curve) for k in (1, 2))
    model = tmp_path / "model.json"
    fitted = invoke(
        "identify", "transfer", first, "--nonlinear", kind, "--hold", "zero", "--out", model
    )
    assert fitted.exit_code == 0, fitted.output
    result = invoke("compare", model, new, "--hold", "zero", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    # The error is the noise, and that of 7 parameters from 3000 samples.
    assert found["rms_error"] == pytest.approx(NOISE, rel=4.0 / np.sqrt(2.0 * 3000) + 7 / 3000)
    assert found["inside_band"] is None and found["status"] == "ok"
    assert "a model file has only that of the linear part" in found["band"]
    fit = fit_nonlinear(hl.records(first, hold="zero"), TransferStructure(), kind)
    in_python = fit.compare(hl.records(new, hold="zero"))
    assert found["fit_percent"] == pytest.approx(in_python.fit_percent, abs=1e-6)


def test_compare_from_rest_agrees_too(tmp_path):
    """The curve is 0 at the input 0, so the output starts at 0."""
    first, new = (record(tmp_path / f"{k}.csv", k, np.square) for k in (1, 2))
    model = tmp_path / "model.json"
    invoke("identify", "transfer", first, "--nonlinear", "hammerstein-2", "--out", model)
    result = invoke("compare", model, new, "--at-rest", "--hold", "zero", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["rms_error"] < 1.1 * NOISE


def test_compare_refuses_a_wiener_model(tmp_path):
    path = record(tmp_path / "r.csv", 1, lambda u: u)
    model = tmp_path / "model.json"
    invoke("identify", "transfer", path, "--nonlinear", "wiener", "--out", model)
    new = record(tmp_path / "new.csv", 2, lambda u: u)
    with pytest.raises(InputError, match=r"\(wiener\), but of the nonlinear models"):
        invoke("compare", model, new)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nonlinear": 5}, "nonlinear is 5, but must be an object"),
        ({"nonlinear": {"kind": "hammerstein-2"}}, "operating_input"),
        ({"gain": 0.0}, "gain is 0, too small for a Hammerstein model"),
        ({"gain": 1e-12}, "gain is 1e-12, too small"),
        ({"nonlinear": {"kind": "hammerstein-2", "operating_input": 1.0}}, "needs gain_2"),
        ({"nonlinear": {"kind": "hammerstein-7", "operating_input": 1.0}}, "'hammerstein-7'"),
    ],
)
def test_a_damaged_nonlinear_model_is_refused(tmp_path, change, message):
    path, model = record(tmp_path / "r.csv", 1, np.square), tmp_path / "model.json"
    invoke("identify", "transfer", path, "--nonlinear", "hammerstein-2", "--out", model)
    damaged = json.loads(model.read_text())
    del damaged["covariance"]
    model.write_text(json.dumps({**damaged, **change}))
    with pytest.raises(InputError, match=message):
        invoke("compare", model, record(tmp_path / "new.csv", 2, np.square))


def test_a_nonlinear_part_of_null_is_none(tmp_path):
    path, model = record(tmp_path / "r.csv", 1, lambda u: u), tmp_path / "model.json"
    invoke("identify", "transfer", path, "--out", model)
    model.write_text(json.dumps({**json.loads(model.read_text()), "nonlinear": None}))
    new = record(tmp_path / "new.csv", 2, lambda u: u)
    assert invoke("compare", model, new, "--hold", "zero").exit_code == 0


def test_a_nonlinear_model_is_refused_for_an_actuator_file(tmp_path):
    path, actuator = record(tmp_path / "r.csv", 1, np.square), tmp_path / "actuator.toml"
    assert invoke("init", "test", "--out", actuator).exit_code == 0
    before = actuator.read_text()
    fit = ("identify", "transfer", path, "--actuator", actuator)
    with pytest.raises(InputError, match="--nonlinear hammerstein-2 excludes --actuator"):
        invoke(*fit, "--nonlinear", "hammerstein-2")
    with pytest.raises(InputError, match=r"\[model\] was not changed.* Leave out --choose"):
        invoke(*fit, "--choose", "nonlinear")
    assert actuator.read_text() == before


@pytest.mark.parametrize("before_s", [0.0, 5.0])
def test_a_record_that_begins_with_its_first_step_says_so(before_s):
    """The slow mode then shows itself in a motion that the initial state explains as well."""
    rate_hz, rng = 50.0, np.random.default_rng(3)
    plant = Plant(0.5, 4.5, 0.15, slow_modes=(SlowMode(0.25, 4.0),))
    time_s = np.arange(0.0, 60.0, 1.0 / rate_hz)
    sweep = np.sin(2 * np.pi * (0.1 + 0.04 * (time_s - 20.0)) * (time_s - 20.0))
    u = np.where(time_s < 5.0, 0.0, np.where(time_s < 20.0, 1.0, 1.0 + 0.3 * sweep))
    y = plant.simulate(u, rate_hz, time_s) + 1e-3 * rng.normal(size=u.size)
    kept = time_s >= 5.0 - before_s
    found = hl.Record(u[kept], rate_hz, y[kept], time_s[kept] - time_s[kept][0])
    fit = hl.fit_transfer(found, TransferStructure(slow_modes=1))
    assert any("before the input first changes" in note for note in fit.notes) == (not before_s)


@pytest.mark.parametrize(
    ("scale", "noted"), [(1.0, False), (1.04, False), (1.2, True), (0.3, False)]
)
@pytest.mark.parametrize("kind", [None, "hammerstein-2"])
def test_compare_notes_inputs_beyond_those_of_the_fit(tmp_path, scale, noted, kind):
    """Random steps of 0 to 2; with --nonlinear the range is that of the recorded input."""
    curve = np.square if kind else lambda u: u
    first, new = record(tmp_path / "1.csv", 1, curve), tmp_path / "2.csv"
    table = np.genfromtxt(record(new, 2, curve), delimiter=",", names=True)
    u = scale * table["u"]
    y = Plant(0.5, 5.11, 0.09).simulate(curve(u), RATE_HZ, table["time_s"])
    y += NOISE * np.random.default_rng(3).normal(size=y.size)
    columns = np.column_stack([table["time_s"], u, y])
    np.savetxt(new, columns, "%.17g", ",", header="time_s,u,y", comments="")
    model, options = tmp_path / "model.json", ("--nonlinear", kind) if kind else ()
    invoke("identify", "transfer", first, *options, "--hold", "zero", "--out", model)
    result = invoke("compare", model, new, "--hold", "zero", "--json")
    assert result.exit_code == 0, result.output
    notes = json.loads(result.stdout)["notes"]
    assert any("the model was fitted to inputs from 0" in note for note in notes) == noted
    one = hl.records(first, hold="zero")
    fit = fit_nonlinear(one, TransferStructure(), kind) if kind else fit_transfer(one)
    assert notes == list(fit.compare(hl.records(new, hold="zero")).notes)
