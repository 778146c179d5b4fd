"""A bench with the limits of an actuator file."""

from __future__ import annotations

from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.actuator_bench import prepare_bench
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin

GAIN = 5000.0  # of the twin


def tables_of(**drive: float) -> ActuatorTables:
    return ActuatorTables.model_validate({"drive": {"low_v": 0.0, "high_v": 1.5, **drive}})


@pytest.mark.parametrize("gain", [{}, {"gain_v_per_v": GAIN}, {"gain_v_per_v": 0.96 * GAIN}])
def test_the_drive_is_limited_to_that_of_the_actuator(gain: dict[str, float]) -> None:
    rig = make_twin(twin_of_reading("hz"), 1)
    assert prepare_bench(rig, tables_of(**gain), Path("a.toml"), 2000.0) == ""
    assert (rig.description.drive_limits.low, rig.description.drive_limits.high) == (0.0, 1.5)


@pytest.mark.parametrize(("gain", "times"), [(500.0, "10"), (50e3, "0.1"), (1.0, "5e+03")])
def test_another_gain_than_that_of_the_rig_is_refused(gain: float, times: str) -> None:
    rig = make_twin(twin_of_reading("hz"), 1)
    before = rig.description
    message = rf"gain of 5000: .* would be {times.replace('+', '.')} times as high .* a\.toml"
    with pytest.raises(InputError, match=message):
        prepare_bench(rig, tables_of(gain_v_per_v=gain), Path("a.toml"), 2000.0)
    assert rig.description == before
