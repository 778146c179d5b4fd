"""A fit gives the same notes on its records in the command and in Python, and loses none."""

import json

import numpy as np
from click.testing import CliRunner
from scipy.signal import chirp, resample

import haselab as hl
from haselab.cli.main import cli
from haselab.models import Plant

RATE_HZ = 50.0
PLANT = Plant(0.5, 5.11, 0.2, 0.05)


def table(path, rows=None, seed=1):
    """A chirp of 10 s, held between its samples."""
    time_s = np.arange(500) / RATE_HZ
    u = chirp(time_s, 0.1, 10.0, 5.0, phi=-90.0)
    y = PLANT.simulate(u, RATE_HZ, time_s) + 2e-3 * np.random.default_rng(seed).normal(size=500)
    columns = np.column_stack([time_s, u, y])[slice(None) if rows is None else rows]
    np.savetxt(path, columns, "%.17g", ",", header="time_s,u,y", comments="")
    return path


def answer(*arguments):
    """The JSON document of a command."""
    result = CliRunner().invoke(cli, [*map(str, arguments), "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def notes_of(*arguments):
    """The notes of `identify transfer`."""
    return answer("identify", "transfer", *arguments)["notes"]


def test_python_calls_an_unstated_hold_an_assumption_as_the_command_does(tmp_path):
    path = table(tmp_path / "r.csv")
    fit = hl.fit_transfer(hl.records(path))
    assert any("assumed to be held from sample to sample" in note for note in fit.notes)
    assert list(fit.notes) == notes_of(path)
    stated = hl.fit_transfer(hl.records(path, hold="zero"))
    assert not any("held from sample" in note for note in stated.notes)
    assert list(stated.notes) == notes_of(path, "--hold", "zero")


def test_python_says_what_became_of_missing_rows_as_the_command_does(tmp_path):
    rows = np.r_[0:200, 206:500]
    path = table(tmp_path / "gap.csv", rows)
    fit = hl.fit_transfer(hl.records(path))
    (missing,) = [note for note in fit.notes if "6 rows are missing in 1 places" in note]
    assert list(fit.notes).count(missing) == 1
    assert list(fit.notes) == notes_of(path)


def test_a_choice_keeps_its_own_notes_beside_those_of_the_records(tmp_path):
    notes = notes_of(table(tmp_path / "r.csv"), "--choose", "slow-modes")
    assert any("held from sample to sample" in note for note in notes)
    assert any("slow" in note for note in notes)


def test_a_prediction_takes_the_hold_of_the_fit(tmp_path):
    # A measured input, smooth between its samples: the plant sees it at 20 times the rate.
    time_s = np.arange(400) / 10.0
    band = np.fft.irfft(np.r_[0, np.random.default_rng(2).normal(size=120) * 20, np.zeros(80)], 400)
    fine = resample(band, 400 * 20)
    y = PLANT.simulate(fine, 200.0, np.arange(fine.size) / 200.0)[::20]
    y = y + 2e-4 * np.random.default_rng(3).normal(size=400)
    path, model = tmp_path / "m.csv", tmp_path / "model.json"
    rows = np.column_stack([time_s, band, y])
    np.savetxt(path, rows[:250], "%.17g", ",", header="time_s,u,y", comments="")
    answer("identify", "transfer", path, "--hold", "band-limited", "--out", model)
    other = tmp_path / "other.csv"
    later = rows[250:] - [time_s[250], 0.0, 0.0]
    np.savetxt(other, later, "%.17g", ",", header="time_s,u,y", comments="")
    right = answer("compare", model, other, "--hold", "band-limited")
    wrong = CliRunner().invoke(cli, ["compare", str(model), str(other), "--hold", "zero", "--json"])
    held = json.loads(wrong.stdout)
    assert held["status"].startswith("model error: ") and right["status"] == "ok"
    errors = right["rms_error"], held["rms_error"]
    assert errors[0] < 0.2 * errors[1]
    fit = hl.fit_transfer(hl.records(path, hold="band-limited"))
    found = fit.compare(hl.records(other, hold="band-limited"))
    assert abs(found.rms_error / errors[0] - 1.0) < 1e-3
    assert errors[0] < 0.02 * np.std(y)
