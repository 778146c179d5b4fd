"""`haselab design` and `margins` for controllers of the actuator file, of any kind."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from haselab.cli.main import main
from haselab.controllers import CONTROLLERS, ControllerKind, Parameter

ACTUATOR = """\
[model]
gain = 0.9
natural_frequency_rad_s = 32.0
damping_ratio = 0.12
rate_hz = 100.0
loop_delay_s = 0.0075
[controller]
kind = "pi"
parameters = {kp = 0.05, ki = 2.0}
limits = {low = -0.05, high = 0.1}
[[controller.alternatives]]
kind = "integral"
parameters = {gain_per_s = 2.0}
[[controller.alternatives]]
kind = "silent"
"""


class Integral:
    def __init__(self, gain_per_s: float) -> None:
        self.gain_per_s = gain_per_s

    def start(self, setting) -> None: ...

    def step(self, reference, measurement) -> float:
        return 0.0

    def linear_feedback(self, period_s):
        return (self.gain_per_s * period_s, 0.0), (1.0, -1.0)


class Silent:
    def start(self, setting) -> None: ...

    def step(self, reference, measurement) -> float:
        return 0.0


KINDS = {
    "integral": ControllerKind("integral", Integral, (Parameter("gain_per_s", "1/s", 1.0, 0.0),)),
    "silent": ControllerKind("silent", Silent),
}


@pytest.fixture
def actuator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    points = [
        SimpleNamespace(name=name, value="plug_in", dist=None, load=lambda kind=kind: kind)
        for name, kind in KINDS.items()
    ]
    monkeypatch.setattr(CONTROLLERS, "others", lambda: points)
    path = tmp_path / "a.toml"
    path.write_text(ACTUATOR)
    return path


def run(capsys, *arguments) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return int(str(stop.value.code)), printed.out, printed.err


def test_margins_are_those_of_the_file_s_controller(actuator, capsys) -> None:
    code, text, _ = run(capsys, "margins", actuator, "--json")
    of_file = json.loads(text)
    given = json.loads(run(capsys, "margins", actuator, "--kp", 0.05, "--ki", 2, "--json")[1])
    assert code == 0 and of_file == given and of_file["stable"]


def test_a_kind_with_a_linear_feedback_has_margins(actuator, capsys) -> None:
    """An integral of 2/s is the PI without its proportional part."""
    code, text, _ = run(capsys, "margins", actuator, "--controller", "integral", "--json")
    same = json.loads(run(capsys, "margins", actuator, "--kp", 0, "--ki", 2, "--json")[1])
    found = json.loads(text)
    assert code == 0
    for name in ("phase_margin_deg", "gain_margin_db", "crossover_rad_s"):
        assert found[name] == pytest.approx(same[name], rel=1e-6)


@pytest.mark.parametrize("command", ["margins", "design"])
def test_default_parameters_are_stated_for_a_kind_that_the_file_does_not_have(
    actuator, capsys, command
) -> None:
    text = actuator.read_text()
    assert 'kind = "integral"' in text
    actuator.write_text(text.replace('kind = "integral"', 'kind = "silent"'))
    code, found, error = run(capsys, command, actuator, "--controller", "integral", "--json")
    assert code == 0 and json.loads(found)["stable"]
    said = "'integral' is not in the file, so its default parameters are used (integral, gain_per_s"
    assert said in error
    if command == "design":
        held = tomllib.loads(actuator.read_text())["controller"]
        assert set(held["parameters"]) == {"gain_per_s"}, "they are in the file now"


def test_a_design_of_such_a_kind_writes_its_margins_and_keeps_the_others(actuator, capsys) -> None:
    code, text, _ = run(capsys, "design", actuator, "--controller", "integral", "--json")
    answer = json.loads(text)
    assert code == 0 and answer["searched"] is False
    held = tomllib.loads(actuator.read_text())["controller"]
    assert held["kind"] == "integral" and held["parameters"] == {"gain_per_s": 2.0}
    assert held["margins"]["phase_margin_deg"] == answer["phase_margin_deg"]
    assert [one["kind"] for one in held["alternatives"]] == ["pi", "silent"]


@pytest.mark.parametrize("command", ["margins", "design"])
def test_a_kind_without_one_is_refused_with_what_to_do(actuator, capsys, command) -> None:
    code, _, error = run(capsys, command, actuator, "--controller", "silent")
    assert code == 2 and error.count("\n") == 1
    assert "have no method linear_feedback, so their margins cannot be computed" in error
    code, _, error = run(capsys, command, actuator, "--controller", "nobody")
    assert code == 2 and "No controller 'nobody' is registered" in error


def test_an_unstable_loop_is_no_design(actuator, capsys) -> None:
    actuator.write_text(ACTUATOR.replace("gain_per_s = 2.0", "gain_per_s = 200.0"))
    code, _, error = run(capsys, "design", actuator, "--controller", "integral")
    assert code == 3 and "is unstable with a delay of 0.0075 s" in error
    assert actuator.read_text() == ACTUATOR.replace("gain_per_s = 2.0", "gain_per_s = 200.0")
