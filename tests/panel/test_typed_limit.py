"""No drive exceeds the limit that was typed when the bench was armed, in either sign."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, equilibrium_m
from haselab.api.design import Actuator
from haselab.base import LimitError
from haselab.control import Saturation
from haselab.controllers import (
    ControllerKind,
    ControllerSetting,
    KnownActuator,
    Measurement,
)
from haselab.panel.columns import LiveWriter
from haselab.panel.live_bench import LiveBench
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.loop import LoopSettings
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.settings import WatchdogSettings

HZ = twin_of_reading("hz")
ZERO_M = equilibrium_m(HZ.law, 4900.0, 0.25 * GRAVITY_M_S2)  # as in the actuator file
KNOWN = KnownActuator(HZ.law, 0.25, ZERO_M, -1.8, 1.8, 5000.0)
BLOCKS = 60


class Alternating:
    """Puts out its limits, the lower one and the higher one in turn."""

    def start(self, setting: ControllerSetting) -> None:
        self._limits = [setting.drive_low, setting.drive_high]

    def step(self, reference: float, measurement: Measurement) -> float:
        self._limits.reverse()
        return self._limits[1]


class Lowest:
    """Asks for the lowest strain."""

    def start(self, setting: ControllerSetting) -> None:
        self.low = setting.drive_low

    def step(self, reference: float, measurement: Measurement) -> float:
        return self.low


ALTERNATING = ControllerKind("turns", Alternating, output="voltage", alternates=True).choose()
LOWEST = ControllerKind("lowest", Lowest).choose()


class Bench:
    """A bipolar twin of +-2 V behind the panel, with a loop."""

    def __init__(self, folder: Path, loop: LoopSettings) -> None:
        daq = HZ.acquisition.model_copy(update={"drive_low_v": -2.0})
        watchdog = WatchdogSettings(charges_per_s=1e4, swings_per_s=1e4, slow_swings_per_s=1e4)
        safety = Safety(SafetySettings(loop=watchdog))
        self.rig: GuardedRig = guard(
            make_twin(HZ.model_copy(update={"acquisition": daq}), 1), safety
        )
        about = self.rig.description
        self.writer = LiveWriter(folder / "live", about.rate_hz, about.block_samples, (1.0, 1.0))
        self.live = LiveBench(self.rig, self.writer, lambda: loop)
        self.limits = ""

    def arm(self, limit_v: float) -> None:
        request = self.live.do("request", "page", {})
        self.limits = request["limits"]
        self.live.do("arm", "page", {"number": request["number"], "limit_v": limit_v})

    def drives_v(self, blocks: int = BLOCKS) -> list[float]:
        """The drive of each of the next blocks."""
        found = []
        for _ in range(blocks):
            self.live.do("lease", "page", {})
            self.live.step()
            found.append(self.live.state.drive_v)
        return found


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Any]:
    made = []

    def new(loop: LoopSettings) -> Bench:
        made.append(Bench(tmp_path, loop))
        return made[-1]

    yield new
    for one in made:
        one.live.close()
        one.writer.__exit__()


@pytest.fixture
def loop(actuator_file: Path) -> LoopSettings:
    """The map gives 0.98 V at zero strain, 0 V at -4.1 % and -1.4 V at -7 %."""
    return Actuator.load(actuator_file).loop()


def test_a_voltage_of_either_sign_stays_within_the_typed_limit(
    make: Any, loop: LoopSettings
) -> None:
    bench = make(replace(loop, controller=ALTERNATING, actuator=KNOWN))
    bench.arm(0.75)
    assert "In closed loop: up to 1.8 V" in bench.limits  # the actuator's limit, not the map's end
    bench.live.do("loop", "page", {"strain": -0.03})
    drives_v = bench.drives_v(20)
    assert bench.live.state.mode == "loop", bench.live.state.reason
    assert min(drives_v) == -0.75 and max(drives_v) == 0.75  # the controller knows the limits


def test_a_strain_with_a_negative_voltage_stays_within_the_typed_limit(
    make: Any, loop: LoopSettings
) -> None:
    limits = Saturation(-0.07, -0.03)
    bench = make(replace(loop, controller=LOWEST, saturation=limits))
    bench.arm(0.35)
    largest_v = float(-loop.voltage_map.voltage_v(limits.low))
    assert f"In closed loop: up to {largest_v:.3f} V" in bench.limits
    bench.live.do("loop", "page", {"strain": -0.05})
    drives_v = bench.drives_v(20)
    assert bench.live.state.mode == "loop", bench.live.state.reason
    # the last point of a grid of 1001 strains before the limit
    step_v = float(np.abs(loop.voltage_map.slope_v(limits.low))) * 0.04 / 1000.0
    assert -0.35 <= min(drives_v) <= -0.35 + step_v


def test_the_gate_refuses_what_the_panel_lets_through(
    make: Any, loop: LoopSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make(loop)
    bench.arm(0.75)
    monkeypatch.setattr(bench.live, "_next_v", lambda: -0.76)
    assert bench.drives_v(1) == [0.0]
    assert bench.live.state.stage == "tripped"
    assert "drive voltage = -0.76 V is outside [-0.75, 0.75] V" in bench.live.state.reason
    assert "the limit typed on the page" in bench.live.state.reason
    limits = bench.rig.description.drive_limits
    assert (limits.low, limits.high) == (-2.0, 2.0), "the next run has the limits of the rig"
    assert bench.rig.plain.description.drive_limits == limits


@pytest.mark.parametrize("limit_v", [0.5, 1.2, 2.0])
def test_a_loop_whose_strains_need_more_than_the_limit_can_be_closed(
    make: Any, loop: LoopSettings, limit_v: float
) -> None:
    """`haselab design` writes such limits of strain: the map gives 2.5 V at 27.7 %."""
    wide = replace(loop, saturation=Saturation(-0.0503, 0.277))
    bench = make(wide)
    bench.arm(limit_v)
    assert "In closed loop: up to 2 V" in bench.limits  # what the rig can put out
    answer = bench.live.do("loop", "page", {"strain": 0.25})
    reference = bench.live.state.reference
    voltage_v = float(wide.voltage_map.voltage_v(reference))
    assert limit_v - 0.01 < voltage_v <= limit_v
    assert f"The desired strain was limited to {100.0 * reference:.6g} %" in answer["note"]
    assert bench.live.do("loop", "page", {"strain": reference}) == {}
    drives_v = bench.drives_v()
    assert bench.live.state.mode == "loop", bench.live.state.reason
    assert max(np.abs(drives_v)) <= limit_v
    with pytest.raises(LimitError, match="The desired strain is"):
        bench.live.do("loop", "page", {"strain": 0.28})


def test_the_strain_of_a_voltage_controller_is_limited_by_the_physical_model(
    make: Any, loop: LoopSettings
) -> None:
    """The voltage map, of another load or temperature, does not act in such a loop."""
    known = replace(KNOWN, low_v=0.0)
    reached = replace(known, high_v=1.2).reachable()
    wide = replace(loop, controller=ALTERNATING, actuator=known, saturation=Saturation(-0.05, 0.5))
    bench = make(wide)
    bench.arm(1.2)
    answer = bench.live.do("loop", "page", {"strain": 0.4})
    assert bench.live.state.reference == pytest.approx(reached[1], rel=1e-9)
    assert bench.live.state.reference != pytest.approx(wide.voltage_map.reach((0, 0.5), 0, 1.2)[1])
    assert "A drive of -1.2 to 1.2 V does not reach a strain of 40 %" in answer["note"]
    far = replace(wide, saturation=Saturation(0.45, 0.5))
    with pytest.raises(LimitError, match=r"physical model, a drive of 0 to 1\.2 V reaches"):
        far.within(-1.2, 1.2)
    unknown = replace(wide, actuator=None)
    assert unknown.within(-1.2, 1.2) == unknown


def test_a_loop_that_no_drive_within_the_limit_reaches_is_refused(
    make: Any, loop: LoopSettings
) -> None:
    bench = make(replace(loop, saturation=Saturation(0.05, 0.1)))
    bench.arm(1.2)
    with pytest.raises(LimitError, match=r"need 1\.\d+ to 1\.\d+ V, but the drive is limited to"):
        bench.live.do("loop", "page", {"strain": 0.06})
    assert bench.live.state.mode == "drive" and bench.drives_v(1) == [0.0]


def test_a_typed_limit_does_not_change_when_an_oscillation_trips(
    make: Any, loop: LoopSettings
) -> None:
    """The charging energy counts in full charges to the limit of the rig."""
    bench = make(loop)
    bench.arm(0.75)
    bench.live.do("loop", "page", {"strain": -0.03})
    assert bench.live._closed._watchdog._model.drive_reach_v == 2.0
