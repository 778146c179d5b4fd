"""What a sheet has been through changes it."""

from __future__ import annotations

import pytest

from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import TwinBench


def stretched_m(config: TwinConfig, peak_v: float) -> float:
    """Length after a second at 1.2 V, of a sheet that has been driven to `peak_v` before."""
    bench = TwinBench(config, 1)
    rest_m = bench.length_m
    precondition(bench, peak_v)
    assert abs(bench.length_m / rest_m - 1.0) < 0.03  # back at rest, but for creep
    bench.write(1.2)
    bench.wait(1.0)
    return bench.length_m


@pytest.mark.long
def test_a_sheet_that_was_driven_before_gives_way_more() -> None:
    config = twin_of_reading("hz")
    new_m, softened_m = stretched_m(config, 0.0), stretched_m(config, 2.0)
    # The Mullins effect takes `share` of the stiffness; much of it acts here.
    assert softened_m > new_m * (1.0 + 0.005)
    firm = config.model_copy(update={"mullins": config.mullins.model_copy(update={"share": 0.0})})
    change = stretched_m(firm, 2.0) / stretched_m(firm, 0.0) - 1.0
    assert abs(change) < 0.2 * (softened_m / new_m - 1.0)  # what creep alone leaves
