"""Keys of a model.json: an unknown one is refused, and those of haselab's own files are not."""

import json

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.models import Plant

RATIONAL = {"numerator": [400.0], "denominator": [1.0, 8.0, 400.0]}
PLANT = {"gain": 1.0, "natural_frequency_rad_s": 20.0, "damping_ratio": 0.2}
MARGINS = ("--kp", "0.1", "--ki", "1.0", "--delay-s", "0")
RATE_HZ = 200.0


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (RATIONAL | {"delay": 0.05}, "A model has no key delay. Did you mean delay_s?"),
        (RATIONAL | {"period_s": 0.01}, "A model has no key period_s. The keys are covariance,"),
        (RATIONAL | {"gain": 2.0}, "A model has no key gain."),
        (PLANT | {"delay": 0.05}, "A model has no key delay. Did you mean delay_s?"),
        ({"plant": PLANT | {"delay": 0.05}}, "no key plant.delay. Did you mean delay_s?"),
        ({"plant": PLANT, "loop_delay": 0.05}, "no key loop_delay. Did you mean loop_delay_s?"),
        ({"plant": PLANT, "delay_s": 0.05}, "delay_s is beside `plant`. Move it into `plant`:"),
        (
            {"plant": PLANT | {"slow_modes": [{"gain": 0.5, "time_constant_s": 6.0, "tau": 1.0}]}},
            "A model has no key plant.slow_modes.0.tau. The keys are gain, time_constant_s.",
        ),
        ({"plant": RATIONAL}, "Put them at the top of the file, without `plant`:"),
    ],
)
def test_an_unknown_key_is_refused_in_one_line(model, message, tmp_path, capsys):
    path = tmp_path / "model.json"
    path.write_text(json.dumps(model))
    for command in (("design",), ("margins", *MARGINS), ("export", "--to", "json")):
        code, out, error = run(capsys, command[0], path, *command[1:])
        assert (code, out) == (2, "")
        assert message in error and error.count("\n") == 1


@pytest.fixture
def record(tmp_path):
    """A chirp on a resonance, sampled at 200 Hz."""
    t = np.arange(2000) / RATE_HZ
    u = np.sin(2.0 * np.pi * (0.3 + 0.6 * t) * t)
    y = Plant(1.0, 20.0, 0.2, 0.01).simulate(u, RATE_HZ, t)
    y += 0.01 * np.random.default_rng(0).normal(size=t.size)
    path = tmp_path / "chirp.csv"
    np.savetxt(path, np.c_[t, u, y], delimiter=",", header="time_s,u,y", comments="")
    return path


@pytest.mark.parametrize(
    "command",
    [
        ("transfer",),
        ("transfer", "--zeros", "1", "--delay", "0.01"),
        ("transfer", "--choose", "zeros"),
        ("transfer", "--bootstrap", "100"),
        ("transfer", "--nonlinear", "hammerstein-2"),
        ("frequency-response", "--fit"),
    ],
)
def test_the_files_of_identify_and_export_are_accepted(command, record, tmp_path, capsys):
    path, exported = tmp_path / "fit.json", tmp_path / "exported.json"
    name, *options = command
    assert run(capsys, "identify", name, record, *options, "--out", path)[0] == 0
    assert run(capsys, "margins", path, *MARGINS)[0] == 0
    assert run(capsys, "export", path, "--to", "json", "--out", exported)[0] == 0
    assert run(capsys, "margins", exported, *MARGINS)[0] == 0


@pytest.mark.parametrize("command", ["arx", "subspace"])
def test_a_model_in_discrete_time_points_to_identify_transfer(command, record, tmp_path, capsys):
    path = tmp_path / "discrete.json"
    assert run(capsys, "identify", command, record, "--out", path)[0] == 0
    code, _, error = run(capsys, "design", path)
    assert code == 2 and error.count("\n") == 1
    assert "in discrete time" in error and "haselab identify transfer FILE --out" in error
