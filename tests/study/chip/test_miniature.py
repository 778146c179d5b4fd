"""The study's step, scaled to a supply that reaches less."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.control import PidGains, margins
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.rig.chip import SupplyModel
from haselab.study.chip.miniature import (
    RELAY_AGE_S,
    MiniatureDesign,
    design_miniature,
    relay_setting,
)

DATA = Path(__file__).parents[2] / "firmware" / "data"
MODEL = json.loads((DATA / "model.json").read_text(encoding="utf-8"))
GAIN = 5000.0


@pytest.fixture(scope="module")
def design() -> MiniatureDesign:
    return design_miniature(MODEL, SupplyModel(), GAIN)


@pytest.mark.long
def test_both_maps_mean_the_same_about_the_new_zero(design: MiniatureDesign) -> None:
    new_strain = np.linspace(-0.005, 0.03, 8)
    strain = design.zero_strain + (1.0 + design.zero_strain) * new_strain
    before, after = MODEL["voltage_map"], design.model["voltage_map"]
    volt = [VoltageMap(m["a1_v"], m["b1"], m["a2_v"], m["b2"]) for m in (before, after)]
    assert volt[1].voltage_v(new_strain) == pytest.approx(volt[0].voltage_v(strain), rel=1e-12)
    farad = np.linspace(4e-10, 6e-10, 5)
    told = [
        (m["curvature_per_f2"] * farad + m["slope_per_f"]) * farad + m["offset"]
        for m in (MODEL["strain_map"], design.model["strain_map"])
    ]
    assert told[1] == pytest.approx((1.0 + told[0]) / (1.0 + design.zero_strain) - 1.0, rel=1e-9)
    length_m = MODEL["zero_strain_length_m"] * (1.0 + design.zero_strain)
    assert design.model["zero_strain_length_m"] == pytest.approx(length_m, rel=1e-12)


@pytest.mark.long
def test_step_and_saturation_stay_within_the_reach(design: MiniatureDesign) -> None:
    m, limits = design.model["voltage_map"], design.setting.saturation
    to_volt = VoltageMap(m["a1_v"], m["b1"], m["a2_v"], m["b2"])
    volt = GAIN * to_volt.voltage_v([limits.low, limits.high])
    assert 0.0 <= volt[0] < 0.02 * 5000.0
    assert 0.98 * 5000.0 < volt[1] <= 5000.0
    assert design.baseline_v < design.top_v < 0.8 * 5000.0
    assert limits.low < 0.0 < design.step < limits.high
    assert 0.01 <= design.step < 0.04


@pytest.mark.long
def test_the_gains_hold_their_margins_with_the_delay_of_the_serial_line(
    design: MiniatureDesign,
) -> None:
    supply = SupplyModel()
    sent_s = len("SVset 5000\r") * 10 / 115_200
    delay_s = RELAY_AGE_S + 4.5e-3 + sent_s + supply.processing_s + supply.response_s
    setting = relay_setting(supply)
    assert setting.measurement_delay_s == pytest.approx(delay_s, rel=1e-12)
    assert setting.rate_hz == pytest.approx(100.0)
    g = PidGains(**design.controller["pid"])
    found = margins(
        Plant.from_dict(MODEL["plant"]), g, loop_delay_s=delay_s, rate_hz=setting.rate_hz
    )
    assert found.stable
    assert found.phase_margin_deg >= 50.0
    assert found.gain_margin_db >= 6.0


def test_a_supply_that_holds_no_step_is_refused() -> None:
    with pytest.raises(ResultError, match=r"A supply of 1500 V .* leaves no step"):
        design_miniature(MODEL, SupplyModel(highest_v=1500.0), GAIN)


@pytest.mark.long
def test_the_other_reading_has_its_bench_too() -> None:
    """Its voltage map reaches less: the demands are those of its own step."""
    model = json.loads((DATA / "rad" / "model.json").read_text(encoding="utf-8"))
    found = design_miniature(model, SupplyModel(), GAIN)
    assert 0.005 <= found.step < 0.04
    assert found.setting.saturation.low < 0.0 < found.step < found.setting.saturation.high
