"""`haselab identify` and the time axis of a file: contradictions, missing rows, jitter."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.base import InputError
from haselab.cli.identify.group import command
from haselab.cli.main import main
from haselab.models import Plant

RATE_HZ = 200.0
PLANT = Plant(0.5, 9.0, 0.1, 0.03)


def write(path, **columns):
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.12g")
    return str(path)


def recorded(times_s=None, count=3000):
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], size=count // 10), 10)
    t = np.arange(count) / RATE_HZ if times_s is None else times_s
    return t, u, PLANT.simulate(u, RATE_HZ, t) + 0.01 * rng.normal(size=count)


def ask(*arguments):
    result = CliRunner().invoke(command, [*arguments, "--json"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


def is_right(answer):
    for key, value in (("gain", 0.5), ("natural_frequency_rad_s", 9.0), ("delay_s", 0.03)):
        low, high = answer[key]["ci95"]
        assert abs(answer[key]["value"] - value) < 5.0 * answer[key]["std"], key
        assert high - low < 0.1


@pytest.mark.parametrize("method", ["transfer", "arx", "frequency-response"])
def test_a_rate_that_contradicts_the_times_is_refused(tmp_path, method):
    t, u, y = recorded()
    file = write(tmp_path / "a.csv", time_s=t, u=u, y=y)
    with pytest.raises(InputError, match="rows per second"):
        ask(method, file, "--rate-hz", "100")


@pytest.mark.parametrize("method", ["arx", "subspace", "creep", "hysteresis", "frequency-response"])
def test_a_stated_rate_does_not_close_a_gap(tmp_path, method):
    t, u, y = recorded()
    kept = np.r_[0:1000, 1400:3000]
    file = write(tmp_path / "a.csv", time_s=t[kept], u=u[kept], y=y[kept])
    with pytest.raises(InputError, match=r"of 2\.005 s after row 1000 .* 400 rows are missing"):
        ask(method, file, "--rate-hz", "200")


def test_a_rate_that_agrees_with_rounded_times_is_taken(tmp_path):
    t, u, y = recorded()
    file = write(tmp_path / "a.csv", time_s=np.round(t, 3), u=u, y=y)
    is_right(ask("transfer", file, "--rate-hz", "200"))


def test_rows_that_are_missing_do_not_move_the_numbers(tmp_path):
    t, u, y = recorded()
    kept = np.ones(t.size, bool)
    kept[[500, 501, 1700]] = False
    kept[2000:2040] = False
    file = write(tmp_path / "a.csv", time_s=t[kept], u=u[kept], y=y[kept])
    answer = ask("transfer", file)
    is_right(answer)
    assert any("43 rows are missing" in note for note in answer["notes"])


def test_outputs_that_jitter_are_fitted_at_their_own_times(tmp_path):
    rng = np.random.default_rng(8)
    t = np.sort(np.arange(3000) / RATE_HZ + 0.0008 * rng.uniform(-1.0, 1.0, 3000))
    t[0] = 0.0
    t, u, y = recorded(t)
    answer = ask("transfer", write(tmp_path / "a.csv", time_s=t, u=u, y=y))
    is_right(answer)
    assert any("jitter" in note for note in answer["notes"])


def test_rows_that_are_not_valid_are_left_out_with_a_note(tmp_path, capsys):
    x = np.linspace(0.0, 1.0, 60)
    y = np.where(np.arange(60) % 9 == 4, np.nan, x**2)
    source = tmp_path / "c.csv"
    table = np.stack([x, y, np.isfinite(y).astype(float)], axis=1)
    np.savetxt(source, table, delimiter=",", header="x,y,valid", comments="")
    with pytest.raises(SystemExit) as stop:
        main(["identify", "map", str(source)])
    assert stop.value.code == 0
    assert "left out 7 rows with 0 in column valid" in capsys.readouterr().err


def test_rows_that_are_left_out_shift_no_times(tmp_path, capsys):
    rng = np.random.default_rng(1)
    u, valid = rng.standard_normal(400), np.ones(400)
    valid[100:140] = 0.0
    source = tmp_path / "c.csv"
    table = np.stack([np.arange(400) / 50.0, u, np.roll(u, 1), valid], axis=1)
    np.savetxt(source, table, delimiter=",", header="time_s,u,y,valid", comments="")
    with pytest.raises(SystemExit) as stop:
        main(["identify", "frequency-response", str(source), "--rate-hz", "50"])
    assert stop.value.code == 2
    assert "40 rows that have 0 in column valid" in capsys.readouterr().err
