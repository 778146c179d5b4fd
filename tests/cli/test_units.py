"""Every number that a command prints as text or draws has its unit, if the unit is known."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from haselab.base import Estimate, InputError
from haselab.cli.main import main
from haselab.cli.model.margins import command as margins
from haselab.cli.readable import readable
from haselab.control.gains import gain_units
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.actuator_bench import refuse_other_kind
from haselab.rig.twin.config import TwinConfig

STRAIN = np.linspace(-0.04, 0.12, 300)
VOLT = 1.324 * np.exp(3.124 * STRAIN) - 0.2805 * np.exp(-26.92 * STRAIN) + 5.0


def printed(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    out, err = capsys.readouterr()
    assert stop.value.code == 0, err
    return out


def write(path: Path, header: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
    return path


def test_a_unit_in_the_answer_is_printed_behind_its_number() -> None:
    gain = Estimate.normal(2.0, 0.5, "")
    lines = readable(
        {"gain": gain, "slow_modes": [{"gain": 3.0}], "input": "u", "gain_unit": "m/V",
         "input_unit": "V", "kp": 4.0, "limits": [-1.0, 1.0], "free": 1.0},
        {"kp": "V/m", "limits": "V", "free": "1"},
    )  # fmt: skip
    text = "\n".join(lines)
    assert re.search(r"^gain +2 m/V   95 %", text) and re.search(r"\n    gain +3 m/V\n", text)
    assert "gain_unit" not in text and "input_unit" not in text
    assert re.search(r"\ninput +u \(V\)\n", text) and re.search(r"\nkp +4 V/m\n", text)
    assert re.search(r"\nlimits +-1, 1 V\n", text) and re.search(r"\nfree +1$", text)


def test_arrays_of_one_size_share_a_line() -> None:
    found = readable({"a": np.zeros(9), "b": 1, "c": np.ones(9), "d": np.ones(10)})
    assert [" ".join(line.split()) for line in found] == [
        "9 values of each a, c (use --json or --out)",
        "b 1",
        "d array of 10 values (use --json or --out)",
    ]


@pytest.mark.parametrize(
    ("source", "output", "gains"),
    [
        ("V", "m", ("V/m", "V/(m s)", "V s/m")),
        ("V", "1", ("V", "V/s", "V s")),
        ("1", "m", ("1/m", "1/(m s)", "s/m")),
        ("1", "1", (None, "1/s", "s")),
        ("", "m", (None, None, None)),
    ],
)
def test_gains_have_the_unit_of_input_over_output(
    source: str, output: str, gains: tuple[str | None, ...]
) -> None:
    units = gain_units(source, output)
    assert tuple(units.get(name) for name in ("kp", "ki", "kd")) == gains


def test_gains_between_strains_say_so_and_an_overshoot_is_one_of_the_step() -> None:
    units = gain_units("1", "1", strains=True)
    shown = {name: units[name] for name in ("kp", "ki", "kd", "limits", "step")}
    assert list(shown.values()) == ["strain/strain", "1/s", "s", "strain", "strain"]
    assert units["overshoot"] == gain_units("V", "m")["overshoot"] == "of the step"


def test_model_design_and_response_state_units(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from haselab.cli import plot

    drawn: list[list[str]] = []
    for module in ("identify.transfer", "identify.response", "model.design", "model.compare"):
        monkeypatch.setattr(
            f"haselab.cli.{module}.save_plot",
            lambda path, chart: drawn.append([panel.y_label for panel in chart().panels]),
        )
    assert plot.PLOT
    rng, step_s = np.random.default_rng(1), 0.005
    u = np.repeat(rng.choice([-1.0, 1.0], 150), 20)
    y, state = np.zeros(u.size), np.zeros(2)
    for k in range(u.size):  # 20 rad/s, damping ratio 0.5
        y[k] = state[0]
        for _ in range(10):
            pull = 400.0 * (0.002 * u[k] - state[0]) - 20.0 * state[1]
            state += 0.1 * step_s * np.array([state[1], pull])
    y += rng.normal(0.0, 1e-5, y.size)
    record = write(tmp_path / "r.csv", "Time (s),u (V),y (m)", step_s * np.arange(u.size), u, y)
    model = tmp_path / "m.json"
    text = printed(capsys, "identify", "transfer", record, "--out", model)
    assert re.search(r"\ngain +0\.00\d+ m/V   95 %", text)
    text = printed(capsys, "design", model, "--limits", -1, 1, "--accept-shortfalls")
    assert re.search(r"^kp +\S+ V/m\nki +\S+ V/\(m s\)\nkd +\S+ V s/m\n", text)
    assert re.search(r"\nstep +\S+ m\nlimits +-1, 1 V\n", text)
    text = printed(capsys, "identify", "frequency-response", record)
    assert text.count("(use --json or --out)") == 1
    assert re.search(r"\npeak_frequency_hz +\S+\npeak_magnitude +0\.00\d+ m/V   95 %", text)
    assert drawn[0] == ["y (m)", "Residual (m)", "u (V)", "Magnitude (m/V)", "Phase (°)"]
    assert drawn[1][:2] == ["Output (m)", "Controller output (V)"]
    assert drawn[2][0] == "Magnitude (m/V)"


def test_the_slope_over_farads_is_per_farad(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = 1e-13 * np.random.default_rng(1).normal(size=STRAIN.size)
    farads = 1e-9 * (1.0 + 2.0 * STRAIN) + noise
    for name, unit in (("capacitance_f", "1/F"), ("relative_capacitance", "")):
        values = farads if unit else farads / 1e-9
        path = write(tmp_path / f"{name}.csv", f"{name},strain", values, STRAIN)
        found = json.loads(printed(capsys, "identify", "capacitance-map", path, "--json"))
        assert found["slope"]["unit"] == unit


@pytest.mark.parametrize(
    ("column", "gain", "noted"),
    [
        ("Ansteuerung (V)", "", False),
        ("voltage_v", "", False),
        ("Ansteuerung", "gain_v_per_v = 5000.0", False),
        ("Ansteuerung", "", True),
    ],
)
def test_only_a_voltage_without_a_unit_is_doubted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], column: str, gain: str, noted: bool
) -> None:
    noise = 0.01 * np.random.default_rng(1).normal(size=STRAIN.size)
    path = write(tmp_path / "v.csv", f"strain,{column}", STRAIN, VOLT + noise)
    actuator = tmp_path / "a.toml"
    actuator.write_text(f"[drive]\n{gain}\n")
    found = json.loads(
        printed(
            capsys, "identify", "voltage-map", path, "--voltage", column.split(" ")[0],
            "--actuator", actuator, "--json",
        )
    )  # fmt: skip
    assert any("states no unit and reaches" in note for note in found["notes"]) == noted


def test_maps_of_one_kind_are_not_played_on_a_twin_of_another() -> None:
    path, twin = Path("leg.toml"), TwinConfig()
    stated = ActuatorTables.model_validate({"actuator": {"kind": "peano-hasel"}})
    with pytest.raises(InputError, match=r"'peano-hasel', but the twin simulates.*'planar-hasel'"):
        refuse_other_kind(stated, path, twin)
    refuse_other_kind(ActuatorTables.model_validate({}), path, twin)
    same = ActuatorTables.model_validate({"actuator": {"kind": "planar-hasel"}})
    refuse_other_kind(same, path, twin)


def test_the_help_of_margins_has_the_units_of_the_gains_for_any_model():
    help_text = {option.name: option.help for option in margins.params if hasattr(option, "help")}
    for source, output in (("V", "m"), ("1", "1")):
        for name in ("ki", "kd"):
            assert f" {gain_units(source, output)[name]}" in help_text[name]
    assert gain_units("V", "m")["kp"] in help_text["kp"]
