"""The page of an actuator file: what it knows with intervals, and what is missing."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main

WHOLE = """
[actuator]
name = "left leg"
kind = "peano-hasel"
[actuator.geometry]
zero_length_m = 0.05
[sensing.strain_map]
slope_per_f = 4.9e8
offset = -0.27
covariance = [[1e12, 0, 0, 0], [0, 4e-6, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
range_f = [5e-10, 8e-10]
band = [-0.002, 0.003]
[drive]
low_v = 0.0
high_v = 1.8
[drive.voltage_map]
a1_v = 1.324
b1 = 3.124
a2_v = -0.2805
b2 = -26.92
[model]
gain = 0.8
input = "strain"
input_unit = "1"
output = "strain"
output_unit = "1"
natural_frequency_rad_s = 28.0
damping_ratio = 0.15
[model.covariance]
names = ["natural_frequency_rad_s", "damping_ratio", "delay_s", "gain"]
logarithmic = [true, true, false, false]
values = [28.0, 0.15, 0.0, 0.8]
matrix = [[1e-4, 0, 0, 0], [0, 1e-2, 0, 0], [0, 0, 1e-6, 0], [0, 0, 0, 1e-4]]
[model.training_output]
cell = 2e-4
hashes = HASHES
[controller]
kind = "pid"
[controller.parameters]
kp = 0.0
ki = 2.0
kd = 0.02
[controller.limits]
low = -0.01
high = 0.06
[controller.predicted]
overshoot = 0.07
[controller.margins]
phase_margin_deg = 60.0
phase_margin_deg_std = 1.5
[provenance.model]
command = "haselab identify transfer one.csv --actuator leg.toml"
input = ["one.csv"]
sha256 = ["00"]
date = "2026-01-01T00:00:00+00:00"
version = "1"
status = "ok"
""".replace("HASHES", str([7 * k for k in range(256)]))


def report(capsys: pytest.CaptureFixture[str], path: Path, *more: object) -> dict[str, object]:
    with pytest.raises(SystemExit) as stop:
        main(["report", str(path), "--json", *map(str, more)])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    found = json.loads(out)
    assert isinstance(found, dict)
    return found


@pytest.mark.long
def test_the_page_has_every_section_with_intervals_bands_and_provenance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "leg.toml"
    path.write_text(WHOLE)
    answer = report(capsys, path)
    page_path = tmp_path / "leg-report.html"
    assert answer["report"] == str(page_path)
    assert list(answer["missing"]) == ["sensing.scale_s"]  # type: ignore[call-overload]
    page = page_path.read_text()
    text = re.sub(r"<svg.*?</svg>|<[^>]+>", " ", page, flags=re.DOTALL)
    text = re.sub(r"\s+", " ", text)
    assert "<title>left leg</title>" in page and page.count("<svg") == 3
    assert "peano-hasel" in text and "calibrate in Python, see docs/measure/sensing.md" in text
    half = 1.959964 * 1e-2
    low, high = 28.0 * np.exp(-half), 28.0 * np.exp(half)
    assert re.search(rf"natural_frequency_rad_s\s+28.00\s+\[{low:.2f}, {high:.2f}\]", text)
    # 60 with a standard deviation of 1.5: 57.06 to 62.94
    assert re.search(r"margins.phase_margin_deg\s+60.0\s+\[57.1, 62.9\]\s+°", text)
    for name, unit in (
        ("parameters.kp", "strain/strain"), ("parameters.ki", "1/s"), ("parameters.kd", "s"),
        ("limits.low", "strain"), ("limits.high", "strain"), ("predicted.overshoot", "of the step"),
    ):  # fmt: skip
        assert re.search(rf" {name} +\S+ +(— )?{unit} ", text), name
    assert re.search(r"slope_per_f\s+4.900×10⁸\s+\[4.880", text)
    assert "training_output.hashes 256 values: 0, 7, 14, …" in text and "1785" not in text
    assert "one.csv" in text and "identify transfer one.csv" in text
    assert (
        "<details>" in page
        and "<script" not in page
        and "http" not in page.replace("http://www.w3.org", "")
    )
    first = page_path.read_bytes()
    report(capsys, path)  # its own page is written anew
    assert page_path.read_bytes() == first


def test_a_new_file_gives_a_page_of_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new.toml"
    path.write_text("[actuator]\nname = 'new'\n")
    out = tmp_path / "page.html"
    answer = report(capsys, path, "--out", out)
    missing = answer["missing"]
    assert isinstance(missing, dict)
    assert set(missing) == {
        "sensing.scale_s", "sensing.strain_map", "drive.voltage_map", "model", "controller"
    }  # fmt: skip
    assert "No command has written to this file" in out.read_text()


def test_an_actuator_of_a_simulated_run_is_marked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "leg.toml"
    origin = "[provenance.model]\ncommand = 'x'\nsimulated = true\n"
    path.write_text(f"[actuator]\nname = 'leg'\n{origin}")
    report(capsys, path)
    assert "<h1>SIMULATED: leg</h1>" in (tmp_path / "leg-report.html").read_text()


PHYSICAL = """
[actuator]
name = "leg"
kind = "peano-hasel"
[model.physical]
kind = "peano-hasel"
status = "ok"
mass_kg = 0.1
not_identifiable = ["actuator.film_stiffness_n_per_m"]
[model.physical.parameters]
"actuator.pouch_length_m" = 0.02
"actuator.film_stiffness_n_per_m" = 25000.0
"actuator.branch_relaxation_s[0]" = 1.0
"camera.offset_m" = 1e-6
[model.physical.measured]
"actuator.pouches" = 5.0
[model.physical.std]
"actuator.pouch_length_m" = 0.0001
"actuator.film_stiffness_n_per_m" = inf
"actuator.branch_relaxation_s[0]" = 0.3
"camera.offset_m" = 2e-6
[model.physical.determined_by]
"actuator.pouch_length_m" = ["triangle capacitance", "static length"]
[model.physical.covariance]
names = ["actuator.pouch_length_m", "actuator.branch_relaxation_s[0]", "camera.offset_m"]
matrix = [[1e-8, 0, 0], [0, 0.09, 0], [0, 0, 4e-12]]
[model.physical.residuals]
length_noise_m = 2e-6
length_rms_m = 3e-6
"""


def test_the_physical_model_has_intervals_and_what_determines_them_instead_of_its_covariance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "leg.toml"
    path.write_text(PHYSICAL)
    report(capsys, path)
    page = (tmp_path / "leg-report.html").read_text()
    assert "std." not in page and "matrix" not in page and "physical.parameters" not in page
    rows = {
        cells[0]: cells[1:]
        for cells in (
            [re.sub("<[^>]+>", "", cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row)]
            for row in re.findall(r"<tr>.*?</tr>", page, re.DOTALL)
        )
    }
    # 0.02 (1 +- 1.96 * 0.005) m
    assert rows["actuator.pouch_length_m"] == [
        "0.02000", "[0.01980, 0.02020]", "m", "triangle capacitance, static length"
    ]  # fmt: skip
    assert rows["actuator.film_stiffness_n_per_m"][:3] == ["25000", "—", "N/m"]
    low, high = np.exp([-0.3 * 1.96, 0.3 * 1.96])  # a time is positive
    assert rows["actuator.branch_relaxation_s[0]"][:3] == ["1.00", f"[{low:.2f}, {high:.2f}]", "s"]
    assert rows["camera.offset_m"][1:3] == ["[−2.9, 4.9]×10⁻⁶", "m"]  # may be negative
    assert rows["actuator.pouches"][:2] == ["5", "stated, not fitted"]
    assert rows["residuals of the length, rms"][0] == "3×10⁻⁶, of which noise 2×10⁻⁶"
    assert "without which the variance of this parameter" in page


def test_a_file_without_a_physical_model_has_no_section_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "leg.toml"
    path.write_text('[actuator]\nname = "leg"\n')
    report(capsys, path)
    assert "Physical model" not in (tmp_path / "leg-report.html").read_text()
