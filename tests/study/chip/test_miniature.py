"""The study's step, scaled to a supply that reaches less."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.control import margins
from haselab.firmware import FrontEnd
from haselab.rig.chip import SupplyModel, read_design
from haselab.study.chip.miniature import (
    RELAY_AGE_S,
    MiniatureDesign,
    design_miniature,
    relay_setting,
)

DATA = Path(__file__).parents[2] / "firmware" / "data"
RUN = read_design(DATA, "pid", FrontEnd()).tables
GAIN = 5000.0


@pytest.fixture(scope="module")
def design() -> MiniatureDesign:
    return design_miniature(RUN, SupplyModel(), GAIN)


@pytest.mark.long
def test_both_maps_mean_the_same_about_the_new_zero(design: MiniatureDesign) -> None:
    new_strain = np.linspace(-0.005, 0.03, 8)
    strain = design.zero_strain + (1.0 + design.zero_strain) * new_strain
    volt = [RUN.voltage_map(), design.voltage_map]
    assert volt[1].voltage_v(new_strain) == pytest.approx(volt[0].voltage_v(strain), rel=1e-12)
    farad = np.linspace(4e-10, 6e-10, 5)
    old, new = (each.strain(farad) for each in (RUN.strain_map(), design.strain_map))
    assert new == pytest.approx((1.0 + old) / (1.0 + design.zero_strain) - 1.0, rel=1e-9)
    length_m = RUN.actuator.geometry.zero_length_m * (1.0 + design.zero_strain)
    assert design.zero_length_m == pytest.approx(length_m, rel=1e-12)


@pytest.mark.long
def test_step_and_saturation_stay_within_the_reach(design: MiniatureDesign) -> None:
    limits = design.setting.saturation
    volt = GAIN * design.voltage_map.voltage_v([limits.low, limits.high])
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
    found = margins(RUN.plant(), design.gains, loop_delay_s=delay_s, rate_hz=setting.rate_hz)
    assert found.stable
    assert found.phase_margin_deg >= 50.0
    assert found.gain_margin_db >= 6.0


def test_a_supply_that_holds_no_step_is_refused() -> None:
    with pytest.raises(ResultError, match=r"a supply of 1500 V.* leaves no room for a step"):
        design_miniature(RUN, SupplyModel(highest_v=1500.0), GAIN)


@pytest.mark.long
def test_the_other_reading_has_its_bench_too() -> None:
    """Its voltage map reaches less: the demands are those of its own step."""
    other = read_design(DATA / "rad", "pid", FrontEnd()).tables
    found = design_miniature(other, SupplyModel(), GAIN)
    assert 0.005 <= found.step < 0.04
    assert found.setting.saturation.low < 0.0 < found.step < found.setting.saturation.high
