"""Margins and models that no longer belong to the rest of their actuator file."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import cli, main
from haselab.models.plant import Plant

WHOLE = """\
[actuator]
name = "leg"
[sensing.strain_map]
slope_per_f = 8.09e8
offset = -0.38
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
natural_frequency_rad_s = 28.0
damping_ratio = 0.15
rate_hz = 100.0
loop_delay_s = 0.0075
"""
OTHER = ("natural_frequency_rad_s = 28.0", "natural_frequency_rad_s = 14.0")


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return int(str(stop.value.code)), printed.out, printed.err


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole file with a controller, designed once for all tests."""
    path = tmp_path_factory.mktemp("designed") / "leg.toml"
    path.write_text(WHOLE)
    cli.main(["design", str(path)], standalone_mode=False)
    return path


@pytest.fixture
def leg(designed: Path, tmp_path: Path) -> Path:
    """A test's own copy of it."""
    return Path(shutil.copy(designed, tmp_path))


def changed(path: Path, *pairs: tuple[str, str]) -> None:
    text = path.read_text()
    for old, new in pairs:
        assert text.count(old) == 1
        text = text.replace(old, new)
    path.write_text(text)


def built(capsys: pytest.CaptureFixture[str], leg: Path, *more: str) -> tuple[int, str]:
    """Code and message of a build, which needs a board that does not exist to get no further."""
    arguments = (*more, "--board", "none-such", "--build-dir", leg.parent / "fw")
    code, _, error = run(capsys, "firmware", "build", leg, *arguments)
    return code, error


def test_a_controller_with_the_margins_of_its_model_is_built(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "none-such" in built(capsys, leg)[1]  # only the board is wrong
    _, out, error = run(capsys, "report", leg, "--json")
    assert (json.loads(out)["doubts"], error) == ({}, "")


def test_a_controller_of_an_earlier_model_is_refused_until_it_is_designed_again(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(leg, OTHER)
    stated = tomllib.loads(leg.read_text())["controller"]["margins"]["phase_margin_deg"]
    true = json.loads(run(capsys, "margins", leg, "--delay-s", "0.0075", "--json")[1])
    code, error = built(capsys, leg)
    assert code == 2 and error.count("\n") == 1
    assert f"states a phase margin of {stated:.3g} deg" in error
    assert (
        f"the pid is unstable, with a phase margin of {true['phase_margin_deg']:.3g} deg" in error
    )
    assert f"haselab design {leg}" in error
    _, out, warning = run(capsys, "report", leg, "--json")
    assert warning == f"haselab: warning: {json.loads(out)['doubts']['controller']}\n"
    assert "but with [model] of the same file" in Path(json.loads(out)["report"]).read_text()
    assert run(capsys, "design", leg)[0] == 0
    assert "none-such" in built(capsys, leg)[1]


@pytest.mark.parametrize("key", ["kp", "kd"])
def test_gains_changed_by_hand_do_not_have_the_margins_of_the_design(
    leg: Path, capsys: pytest.CaptureFixture[str], key: str
) -> None:
    value = tomllib.loads(leg.read_text())["controller"]["parameters"][key]
    changed(leg, (f"{key} = {value!r}\n", f"{key} = {3.0 * value!r}\n"))
    assert "but with [model] of the same file the pid has" in built(capsys, leg)[1]


@pytest.mark.parametrize(
    ("key", "factor", "said"),
    [
        ("delay_margin_s", 1.1, "a delay margin of"),
        ("peak_sensitivity", 0.9, "a peak sensitivity of"),
        ("crossover_rad_s", 1.1, "a crossover at"),
        ("worst_phase_margin_deg", 1.1, "a worst phase margin of"),
        ("worst_gain_margin_db", 2.0, "a worst gain margin of"),
    ],
)
def test_every_stated_margin_is_verified(
    leg: Path, capsys: pytest.CaptureFixture[str], key: str, factor: float, said: str
) -> None:
    value = tomllib.loads(leg.read_text())["controller"]["margins"][key]
    changed(leg, (f"\n{key} = {value!r}\n", f"\n{key} = {factor * value!r}\n"))
    code, error = built(capsys, leg)
    assert code == 2 and f"[controller] states {said} {factor * value:.3g}" in error
    assert f"the pid has {said} {value:.3g}" in error


def test_a_misspelled_margin_is_named(leg: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changed(
        leg, ("[controller.margins]\nphase_margin_deg", "[controller.margins]\nphase_margin_dg")
    )
    _, _, warning = run(capsys, "report", leg, "--json")
    said = "[controller.margins] phase_margin_dg has no effect; did you mean phase_margin_deg?"
    assert warning == f"haselab: warning: {said} {leg}\n"


def test_a_changed_delay_of_the_loop_is_noticed(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(leg, ("loop_delay_s = 0.0075", "loop_delay_s = 0.02"))
    true = json.loads(run(capsys, "margins", leg, "--delay-s", "0.02", "--json")[1])
    _, out, warning = run(capsys, "report", leg, "--json")
    assert warning == f"haselab: warning: {json.loads(out)['doubts']['controller']}\n"
    assert "was designed for a loop delay of 0.0075 s, but [model] states loop_delay_s" in warning
    assert f"it has a phase margin of {true['phase_margin_deg']:.3g} deg instead of" in warning
    changed(leg, ("loop_delay_s = 0.02", "loop_delay_s = 0.00751"))  # the margins are the same
    assert run(capsys, "report", leg)[2] == ""
    changed(leg, ("loop_delay_s = 0.00751", "loop_delay_s = 0.02"))
    assert run(capsys, "design", leg)[0] == 0
    assert run(capsys, "report", leg)[2] == ""
    changed(leg, ("loop_delay_s = 0.02\n", ""))  # the design alone states a delay
    assert run(capsys, "report", leg)[2] == ""
    arguments = ("--rate-hz", 1000, "--delay-s", 0.0018, "--accept-shortfalls")
    assert run(capsys, "design", leg, *arguments)[0] == 0  # another rate has its own delay
    assert run(capsys, "report", leg)[2] == ""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ki = ", "Ki = ", "[controller.parameters] lacks ki, has the key Ki"),
        ("kp = ", "# kp = ", "[controller.parameters] lacks kp. A pid has kp, ki, kd, "),
    ],
)
def test_a_misspelled_or_missing_gain_is_named(
    leg: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    changed(leg, (f"\n{old}", f"\n{new}"))
    assert said in built(capsys, leg)[1]
    code, out, _ = run(capsys, "report", leg, "--json")
    assert code == 0 and "cannot be verified" in out


def test_a_typed_controller_states_margins_that_are_verified(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    controller = tomllib.loads(leg.read_text())["controller"]
    typed = WHOLE + (
        '[controller]\nkind = "pid"\nlimits = {low = -0.05, high = 0.09}\n'
        "loop = {rate_hz = 100.0, measurement_delay_s = 0.0075}\n[controller.parameters]\n"
        + "".join(f"{name} = {value!r}\n" for name, value in controller["parameters"].items())
    )
    leg.write_text(typed)
    assert "none-such" in built(capsys, leg)[1]  # no margins stated, so nothing to verify
    margin = controller["margins"]["phase_margin_deg"]
    leg.write_text(f"{typed}[controller.margins]\nphase_margin_deg = {margin:.0f}\n")
    assert "none-such" in built(capsys, leg)[1]  # a rounded number is the same
    leg.write_text(f"{typed}[controller.margins]\nphase_margin_deg = {margin - 5.0:.0f}\n")
    code, error = built(capsys, leg)
    assert code == 2 and f"states a phase margin of {margin - 5.0:.0f} deg, but" in error
    model = typed[typed.index("[model]") : typed.index("[controller]")]
    leg.write_text(leg.read_text().replace(model, ""))
    code, error = built(capsys, leg)
    assert code == 2 and "cannot be verified. The actuator file has no [model]" in error


def test_each_controller_of_the_file_has_its_own_margins(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(leg, OTHER)
    spec = leg.parent / "spec.toml"
    spec.write_text("rise_time_s = 5.0\nphase_margin_deg = 45.0\n")
    arguments = ("--controller", "pi", "--spec", spec, "--accept-shortfalls")
    assert run(capsys, "design", leg, *arguments)[0] == 0
    assert "none-such" in built(capsys, leg)[1]
    assert (
        "the pid is unstable, with a phase margin" in built(capsys, leg, "--controller", "pid")[1]
    )
    doubt = json.loads(run(capsys, "report", leg, "--json")[1])["doubts"]["controller"]
    assert doubt.count("but with [model]") == 1


def test_a_model_identified_through_another_voltage_map_is_refused(
    leg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    to_volt, rate_hz = tomllib.loads(WHOLE)["drive"]["voltage_map"], 100.0
    rng = np.random.default_rng(3)
    strain = np.repeat(rng.uniform(-0.03, 0.06, 60), 20)
    volt = to_volt["a1_v"] * np.exp(to_volt["b1"] * strain)
    volt += to_volt["a2_v"] * np.exp(to_volt["b2"] * strain)
    y = Plant(0.8, 28.0, 0.15, 0.004).simulate(strain, rate_hz, np.arange(strain.size) / rate_hz)
    rows = np.column_stack([np.arange(y.size) / rate_hz, volt, y + 1e-4 * rng.normal(size=y.size)])
    record = tmp_path / "chirp.csv"
    np.savetxt(record, rows, "%.9g", ",", header="time_s,voltage_v,strain", comments="")
    code, _, _ = run(capsys, "identify", "transfer", record, "--input", "voltage_v", "--output",
                     "strain", "--through-voltage-map", "--actuator", leg)  # fmt: skip
    assert code == 0 and run(capsys, "design", leg)[0] == 0
    used = tomllib.loads(leg.read_text())["model"]["through_voltage_map"]
    assert used == [to_volt[name] for name in ("a1_v", "b1", "a2_v", "b2")]
    assert "none-such" in built(capsys, leg)[1]
    changed(leg, ("a1_v = 1.324", "a1_v = 1.2"))
    code, error = built(capsys, leg)
    assert code == 2 and "[model] was identified through another [drive.voltage_map]" in error
    assert error.count("\n") == 1
    code, _, warning = run(capsys, "design", leg)
    assert code == 0 and "was identified through another [drive.voltage_map]" in warning


def test_a_run_with_such_a_file_warns_before_it_plays(
    leg: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changed(leg, OTHER, ("loop_delay_s = 0.0075", "loop_delay_s = 0.02"))
    study, rig = tmp_path / "study.toml", tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\n')
    study.write_text(
        'name = "beyond the limit of the file"\n[triangle]\nlow_v = 0.0\nhigh_v = 2.0\n'
        "frequency_hz = 0.25\ncycles = 3\nskipped_cycles = 1\nframe_rate_hz = 100.0\n"
    )
    arguments = ("--rig", rig, "--actuator", leg, "--out", tmp_path / "out")
    code, _, error = run(capsys, "run", study, *arguments)
    warning, delay, refusal = error.splitlines()
    assert delay.startswith("haselab: warning: The pid was designed for a loop delay of 0.0075 s")
    assert warning.startswith("haselab: warning: [controller] states a phase margin of")
    assert code == 2 and "is outside [0, 1.8] V" in refusal


@pytest.mark.parametrize("gain", ["-1.1", "1e30"])
def test_an_unstable_loop_is_called_unstable_instead_of_margins_that_are_no_numbers(
    leg: Path, capsys: pytest.CaptureFixture[str], gain: str
) -> None:
    changed(leg, ("gain = 0.8\n", f"gain = {gain}\n"))
    code, error = built(capsys, leg)
    assert code == 2
    assert "but with [model] of the same file the pid is unstable" in error
    assert "nan" not in error and "inf" not in error


def test_a_highest_drive_in_another_unit_than_the_map_is_noticed(
    leg: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """1.8 V typed in mV; the map gives 2.47 V at a strain of 0.2."""
    changed(leg, ("high_v = 1.8\n", "high_v = 1800.0\n"))
    said = "high_v in [drive] is 1800 V, but [drive.voltage_map] gives at most 2.47 V"
    assert said in built(capsys, leg)[1]
    assert said in run(capsys, "design", leg)[2]
    changed(leg, ("high_v = 1800.0\n", "high_v = 18.0\n"))  # a drive that is larger than needed
    assert "high_v in [drive]" not in built(capsys, leg)[1]
