"""Numbers in files: neither `true` nor a text is one, in a file of any kind."""

from __future__ import annotations

from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.model_tables import PlantTable
from haselab.pipelines.design.model_file import read_plant
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_file import load_twin
from haselab.store.toml import read_toml, validated
from haselab.study.definition import load_study

TRIANGLE = """
name = "one triangle"
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = {value}
cycles = 5
skipped_cycles = 1
frame_rate_hz = 100.0
"""
CONTROL = TRIANGLE.format(value=0.25) + "[control]\nkind = 'mine'\nparameters = {{ a = {value} }}\n"
OPENERS = {
    "actuator": lambda path: validated(ActuatorTables, read_toml(path, "actuator"), path),
    "model": read_plant,
    "twin": load_twin,
    "rig": load_rig,
    "study": load_study,
}


@pytest.mark.parametrize("value", ["true", '"0.5"'])
@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("actuator", "[controller.margins]\nphase_margin_deg = {value}"),
        ("actuator", "[controller.demands]\nphase_margin_deg = {value}"),
        ("actuator", "[controller.alternatives.margins]\ngain_margin_db = {value}"),
        ("actuator", "[actuator]\nmass_kg = {value}"),
        ("actuator", "[sensing]\nscale_s = [1e-6, {value}]"),
        ("actuator", "[model.physical]\nkind = 'x'\nparameters = {{ a = {value} }}"),
        ("model", "[model]\ngain = {value}\nnatural_frequency_rad_s = 30.0\ndamping_ratio = 0.1"),
        ("twin", "reading = 'hz'\n[load]\nmass_kg = {value}"),
        ("twin", "reading = 'hz'\n[camera]\nparticles = {value}"),
        ("rig", "kind = 'twin'\nseed = {value}"),
        ("study", TRIANGLE),
        ("study", CONTROL),
    ],
)
def test_only_a_number_is_a_number(tmp_path: Path, kind: str, text: str, value: str) -> None:
    if "alternatives" in text:
        text = text.replace(
            "[controller.alternatives", "[[controller.alternatives]]\n[controller.alternatives"
        )
    path = tmp_path / "file.toml"
    path.write_text(text.format(value=value))
    with pytest.raises(InputError, match="number") as raised:
        OPENERS[kind](path)
    assert str(path) in str(raised.value)


def test_keys_that_are_switches_stay_switches() -> None:
    tables = {"margins": {"stable": True, "phase_margin_deg": 60.0},
              "demands": {"keep_crossover": False, "overshoot": 0.1}}  # fmt: skip
    held = validated(ActuatorTables, {"controller": tables}, "a.toml").controller
    assert held is not None
    assert held.margins["stable"] is True and held.demands["keep_crossover"] is False


def test_whole_numbers_and_estimates_are_still_read() -> None:
    model = {"gain": {"value": 1, "std": 0.1, "unit": "1"}, "natural_frequency_rad_s": 30,
             "damping_ratio": 0.1}  # fmt: skip
    assert validated(PlantTable, model, "a.toml").gain == 1.0
    assert validated(TwinConfig, {"reading": "hz", "load": {"mass_kg": 1}}, "").load.mass_kg == 1.0
