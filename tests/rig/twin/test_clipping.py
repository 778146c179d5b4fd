"""A converter of any number of bits clips at the ends of its own range, and sensing says so."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.rig.checks.signals import saturated
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.lockin import lockin_of
from haselab.sensing import reason_text

CARRIER_HZ, RANGE_V = 2000.0, 1.2


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_readings_above_the_range_are_clipped_and_named(bits: int) -> None:
    config = twin_of_reading("hz")
    daq = config.acquisition.model_copy(update={"bits": bits, "range_v": RANGE_V})
    config = config.model_copy(update={"acquisition": daq})
    rig = make_twin(config, 1)
    top = 2 ** (bits - 1) - 1
    assert rig.description.top_code == top
    assert (top + 1) * rig.description.volt_per_code == pytest.approx(RANGE_V)
    lockin = lockin_of(rig.description, CARRIER_HZ)
    rig.generator.sine(CARRIER_HZ, 0.05)
    found = []
    # 5 kV reads 1 V, inside the range; 7.5 kV reads 1.5 V.
    for drive_v in (1.0, 1.5):
        rig.source.write(drive_v)
        blocks = np.array([rig.acquisition.read() for _ in range(20)])
        assert blocks.max() <= top and blocks.min() >= -top - 1
        last = blocks[-1:]
        found.append((saturated(last[0, :, 0], top), reason_text(lockin.sense(last).reason[0])))
    inside, outside = found
    assert outside[0] and "clipped" in outside[1]
    if bits > 8:
        assert not inside[0] and inside[1] == ""
