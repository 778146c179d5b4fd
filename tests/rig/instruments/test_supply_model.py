"""The emulated high-voltage supply: its limits, and its driver's commands on a pseudo-terminal."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from haselab.rig.bench_config import SupplyConfig
from haselab.rig.chip import SupplyModel, SupplyOutput
from haselab.rig.chip.simulator import SLOT_S

QUIET = SupplyModel(ripple_v=0.0)


def settled_v(model: SupplyModel, volt: float) -> float:
    output = SupplyOutput(model, 1)
    output.rail(volt)
    return float(output.advance(8000)[-1])


def test_the_set_point_is_a_multiple_of_its_step_and_never_above_the_reach() -> None:
    assert settled_v(QUIET, 2503.0) == pytest.approx(2505.0, abs=1e-6)
    assert settled_v(QUIET.model_copy(update={"highest_v": 3000.0}), 4000.0) == pytest.approx(3000)


def test_a_command_takes_effect_when_its_bytes_are_over_and_processed() -> None:
    output = SupplyOutput(QUIET, 1)
    output.rail(100.0)
    wait = int(np.ceil((len("SVset 100\r") * 10 / 115_200 + QUIET.processing_s) / SLOT_S))
    volt = output.advance(2 * wait)
    assert (volt[:wait] == 0.0).all()
    assert volt[wait] > 0.0


def test_it_rises_no_faster_than_its_current_charges_the_load_and_then_like_its_regulator() -> None:
    output = SupplyOutput(QUIET, 1)
    output.rail(4000.0)
    volt = output.advance(8000)
    fastest_v = QUIET.current_a / QUIET.load_f * SLOT_S
    rises = np.diff(volt)
    assert 0.99 * fastest_v < rises.max() <= fastest_v * (1.0 + 1e-12)
    near = np.flatnonzero((volt > 3990.0) & (volt < 3999.0))  # there the regulator is slower
    left_v = 4000.0 - volt[near]
    assert left_v[1:] / left_v[:-1] == pytest.approx(np.exp(-SLOT_S / QUIET.response_s), rel=1e-9)
    output.rail(0.0)
    falls = np.diff(output.advance(8000))
    most_v = (QUIET.current_a + 4000.0 / QUIET.divider_ohm) / QUIET.load_f * SLOT_S
    assert -most_v * (1.0 + 1e-9) <= falls.min() < -fastest_v


def test_the_ripple_has_its_size() -> None:
    output = SupplyOutput(SupplyModel(ripple_v=4.0), 3)
    output.rail(2000.0)
    volt = output.advance(20_000)[10_000:]
    # The deviation of n values scatters by 1 / sqrt(2 n), here 0.7 %.
    assert volt.std() == pytest.approx(4.0, rel=5.0 * 0.007)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_the_driver_of_a_real_supply_sets_it() -> None:
    pytest.importorskip("serial")
    from haselab.rig.instruments.petapicovoltron import PetaPicoVoltron
    from haselab.rig.twin.serve.supply.server import SupplyServer

    output = SupplyOutput(QUIET, 1)
    server = SupplyServer(output)
    try:
        supply = PetaPicoVoltron(SupplyConfig(port=server.port, highest_v=5000.0))
        supply.set_voltage(3000.0)
        output.advance(8000)
        assert supply.read_voltage() == pytest.approx(3000.0, abs=1.0)
        supply.off()
        assert supply.is_off()
        assert output.advance(8000)[-1] == pytest.approx(0.0, abs=1.0)
        supply.close()
    finally:
        server.close()
