"""`haselab identify frequency-response` on files: methods, pooled files, the fit, refusals."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.base import InputError, ResultError
from haselab.cli.identify.group import command
from haselab.models import Plant
from haselab.pipelines.design.model_file import read_any_plant

PLANT = Plant(0.5, 5.11, 0.09, 0.02)
TIME_S = np.arange(4000) / 100.0
ARRAYS = ("frequency_hz", "magnitude", "phase_rad", "coherence", "magnitude_std", "phase_std_rad")


def invoke(*arguments):
    return CliRunner().invoke(
        command, ["frequency-response", *map(str, arguments)], catch_exceptions=False
    )


def ask(*arguments):
    result = invoke(*arguments, "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Two periods of random noise of 20 s."""
    rng = np.random.default_rng(1)
    u = np.tile(rng.normal(size=2000), 2)
    y = PLANT.simulate(u, 100.0, TIME_S) + 0.002 * rng.normal(size=TIME_S.size)
    path = tmp_path_factory.mktemp("records") / "noise.csv"
    np.savetxt(path, np.column_stack([u, y]), "%.9g", ",", header="u,y", comments="")
    return path


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("rational", ()),
        ("polynomial", ()),
        ("h1", ("--segment-s", 10)),
        ("h2", ("--segment-s", 10)),
        ("hv", ("--segment-s", 10)),
        ("periodic", ("--period-s", 20)),
    ],
)
def test_every_method_answers_with_arrays_of_one_length_and_its_name(record, method, options):
    answer = ask(record, "--rate-hz", 100, "--method", method, *options)
    assert answer["method"] == method
    assert len({len(answer[key]) for key in ARRAYS}) == 1
    at_hz, magnitude = np.array(answer["frequency_hz"]), np.array(answer["magnitude"])
    expected = np.abs(PLANT.frequency_response(2 * np.pi * at_hz))
    low = at_hz < 0.5
    # Below the resonance every method is within 20 %; segments of 10 s smear.
    assert np.median(np.abs(magnitude / expected - 1)[low]) < 0.2


def test_the_fit_is_printed_and_part_of_the_document(record):
    answer = ask(record, record, "--rate-hz", 100, "--fit")
    truth = {"natural_frequency_rad_s": 5.11, "damping_ratio": 0.09, "gain": 0.5, "delay_s": 0.02}
    for name, value in truth.items():
        estimate = answer["fit"][name]
        assert abs(estimate["value"] - value) <= 5 * estimate["std"], name
    printed = invoke(record, "--rate-hz", 100, "--fit").stdout
    assert "natural_frequency_rad_s" in printed
    assert "chi_squared_ratio" in printed


def test_a_sweep_is_warned_of_and_noise_alone_has_no_fit(tmp_path):
    u = np.sin(2 * np.pi * (0.1 * TIME_S + 0.05 * TIME_S**2))
    path = tmp_path / "sweep.csv"
    np.savetxt(path, np.column_stack([u, PLANT.simulate(u, 100.0, TIME_S)]), "%.9g", ",",
               header="u,y", comments="")  # fmt: skip
    answer = ask(path, "--rate-hz", 100, "--method", "h1")
    assert any("like a single sweep" in note for note in answer["notes"])
    rng = np.random.default_rng(2)
    np.savetxt(path, rng.normal(size=(500, 2)), "%.9g", ",", header="u,y", comments="")
    with pytest.raises(ResultError, match="no result"):
        invoke(path, "--rate-hz", 100, "--fit")


def test_files_of_different_rates_are_refused(record, tmp_path):
    other = tmp_path / "other.csv"
    other.write_text("# rate_hz = 50\n" + record.read_text())
    same = tmp_path / "same.csv"
    same.write_text("# rate_hz = 100\n" + record.read_text())
    with pytest.raises(InputError, match=r"different sampling rates: 100, 50 Hz"):
        invoke(same, other)
    with pytest.raises(InputError, match="the method periodic requires a period"):
        invoke(record, "--rate-hz", 100, "--method", "periodic")


def test_the_file_of_a_fit_holds_the_plant_and_help_names_no_false_range(record, tmp_path):
    out = tmp_path / "fr.json"
    result = invoke(record, "--rate-hz", 100, "--fit", "--out", out)
    assert result.exit_code == 0, result.output
    plant = read_any_plant(out)
    # Five deviations of a fit to a hundred lines at 40 dB are far below a tenth.
    assert abs(plant.natural_frequency_rad_s / PLANT.natural_frequency_rad_s - 1.0) < 0.1
    assert "1000000000" not in invoke("--help").stdout
