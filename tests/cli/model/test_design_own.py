"""`haselab design --controller KIND` for kinds that compute their own parameters."""

from __future__ import annotations

import json
import math
import re
import tomllib

import pytest

from haselab.cli.actuator_file import load_actuator
from haselab.cli.main import main
from haselab.controllers import known_actuator
from haselab.models.actuator.spelling import misspelled_keys

FILE = """
[actuator]
name = "leg"
mass_kg = 0.25
geometry = {zero_length_m = 0.051}

[drive]
low_v = 0.0
high_v = 2.0
gain_v_per_v = 5000.0
highest_field_v_per_m = 34e6

[model.physical]
kind = "planar-hasel"
mass_kg = 0.25
parameters = {"shell.shear_modulus_pa" = 15.6e3}
"""


def run(capsys, *arguments):
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        code = stop.code
    seen = capsys.readouterr()
    return code, seen.out, seen.err


def test_a_kind_with_a_design_writes_its_parameters_into_the_actuator_file(tmp_path, capsys):
    file = tmp_path / "A.toml"
    file.write_text(FILE)
    code, out, _ = run(capsys, "design", file, "--controller", "force", "--delay-s", 0.0056,
                       "--rate-hz", 100, "--json")  # fmt: skip
    assert code == 0
    answer = json.loads(out)
    section = tomllib.loads(file.read_text())["controller"]
    assert section["kind"] == "force" and section["parameters"] == answer["parameters"]
    assert set(answer["parameters"]) == {"kp", "ki", "kd", "filter_s", "reference_s"}
    assert section["limits"]["low"] < 0.0 < section["limits"]["high"]  # strains, for the loop
    assert section["loop"] == {"rate_hz": 100.0, "measurement_delay_s": 0.0056}
    assert "peak sensitivity is at most 1.8" in answer["robustness"]


def test_a_physical_model_with_an_error_gives_a_warning(tmp_path, capsys):
    file = tmp_path / "A.toml"
    file.write_text(FILE + 'status = "model error: lengths are off"\n')
    code, _, err = run(capsys, "design", file, "--controller", "force", "--delay-s", 0.0056)
    said = "the status of [model.physical], which the design uses, is: model error: lengths are off"
    assert code == 0 and err == f"haselab: warning: {said}. File: {file}\n"


CURLING = """
[actuator]
name = "strip"
geometry = {zero_length_m = 0.0963}

[drive]
low_v = 0.0
high_v = 2.0
gain_v_per_v = 5000.0

[model.physical]
kind = "curling-hasel"
mass_kg = 0.05
parameters = {"actuator.curl_rad" = 0.5, "actuator.damping_n_s_per_m" = 2.0}
"""


def test_the_limits_end_before_the_pouches_are_slack(tmp_path, capsys):
    file = tmp_path / "A.toml"
    file.write_text(CURLING)
    code, _, said = run(capsys, "design", file, "--controller", "observer", "--delay-s", 0.0056)
    assert code == 0
    found = known_actuator(load_actuator(file), file)
    limits = tomllib.loads(file.read_text())["controller"]["limits"]
    assert (limits["low"], limits["high"]) == found.sensed_range() != found.reachable()
    assert "where the pouches are slack" in said and f"instead of {limits['low']:.3g}" in said


def test_a_reach_without_zero_strain_is_refused(tmp_path, capsys):
    """Of a drive to 0.8 V, whose loops `run` would refuse: 0.0963 m is the length at 0.9 V."""
    file = tmp_path / "A.toml"
    file.write_text(CURLING.replace("high_v = 2.0", "high_v = 0.8"))
    before = file.read_text()
    code, _, said = run(capsys, "design", file, "--controller", "observer")
    assert code == 3 and file.read_text() == before
    assert re.search(r"starts at zero strain, but .* drive of 0 to 0\.8 V reaches strains of", said)
    assert "Change the limits of the drive, or define zero strain as the length at" in said


def test_a_kind_that_guarantees_margins_prints_them_and_writes_them(tmp_path, capsys):
    file = tmp_path / "A.toml"
    file.write_text(FILE)
    code, out, _ = run(capsys, "design", file, "--controller", "h-infinity", "--delay-s", 0.0056,
                       "--rate-hz", 100, "--json")  # fmt: skip
    assert code == 0
    answer, section = json.loads(out), tomllib.loads(file.read_text())["controller"]
    epsilon = answer["stability_margin"]
    assert 0.25 * (1.0 - 1e-3) < epsilon < 1.0
    factor = (1.0 + epsilon) / (1.0 - epsilon)
    assert answer["guaranteed_gain_margin_db"] == pytest.approx(20.0 * math.log10(factor))
    assert section["margins"] == {name: answer[name] for name in (
        "stability_margin", "guaranteed_gain_margin_db", "guaranteed_phase_margin_deg"
    )}  # fmt: skip
    assert misspelled_keys(tomllib.loads(file.read_text())) == []


def test_without_a_physical_model_the_command_that_adds_it_is_named(tmp_path, capsys):
    file = tmp_path / "A.toml"
    file.write_text(FILE.split("[model.physical]")[0])
    code, _, error = run(capsys, "design", file, "--controller", "force")
    assert code == 2 and "haselab identify actuator RUN --actuator A.toml" in error
