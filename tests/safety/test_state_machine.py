"""Every way out of a run ends at 0 V with the sensing signal off."""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError, LimitError, SafetyError, SilentProgress
from haselab.control import Saturation
from haselab.controllers import pid_controller
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig import Rig
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner
from haselab.safety import instrument_state as at_rest
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
LOOP = LoopSettings(pid_controller(0.4, 0.7), Saturation(-0.04, 0.1), EQ4, StrainMap(4.9e8, -0.27))


class Bench:
    """A twin with a recorder; `play` runs in the runner's context."""

    def __init__(self, folder: Path, config: TwinConfig | None = None) -> None:
        config = config or twin_of_reading("hz")
        self.twin = TwinBench(config, 3)
        self.rig: Rig = rig_of(self.twin, config)
        self.path = folder / "session.h5"
        self.session = SessionWriter(self.path, [ExperimentPlan("x", "test", 6, {})], 2000, {})
        self.camera_recorder = CameraRecorder(self.rig.camera, self.session, folder, "none")

    def runner(self) -> Runner:
        return Runner(self.rig, self.session, self.camera_recorder, 2000.0, 0.02, SilentProgress())

    def assert_safe(self) -> None:
        assert self.twin.output_v == 0.0
        codes = [self.twin.read() for _ in range(3)][-1]
        # Neither drive nor carrier: what is left on the voltage monitor is its own noise.
        assert abs(codes[:, 0]).max() < 6.0 * 0.3e-3 / self.rig.description.volt_per_code + 1.0


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


@pytest.mark.parametrize("ended_by", [None, KeyboardInterrupt(), DeviceError("the disk is full.")])
def test_a_remaining_output_is_reported_whatever_ended_the_run(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, ended_by: BaseException | None
) -> None:
    monkeypatch.setattr(TwinBench, "zero", lambda self: None)
    reported = r"Output not at 0 V: .*Switch the high voltage off by hand\."
    with pytest.raises(SafetyError, match=reported) as caught, bench.runner() as runner:
        runner.play("x", np.full(30, 1.5), 100.0, 0.25)
        if ended_by is not None:
            raise ended_by
    if ended_by is not None:
        assert f"The run had ended by {type(ended_by).__name__}" in str(caught.value)


def test_a_run_that_ends_well_ends_at_zero(bench: Bench) -> None:
    with bench.runner() as runner:
        runner.play("x", np.full(30, 1.5), 100.0, 0.25)
        assert bench.twin.output_v > 7000.0
    bench.assert_safe()
    bench.session.close()
    with SessionReader(bench.path) as reader:
        assert reader.experiment("x").codes.shape == (30, 2000, 2)


@pytest.mark.parametrize("error", [KeyboardInterrupt, DeviceError, ValueError])
def test_an_error_from_the_acquisition_ends_at_zero(bench: Bench, error, monkeypatch) -> None:
    read, count = bench.twin.read, iter(range(100))

    def failing():
        if next(count) == 15:
            raise error("in mid-run")
        return read()

    with monkeypatch.context() as patch:
        patch.setattr(bench.twin, "read", failing)
        with pytest.raises(error, match="in mid-run"), bench.runner() as runner:
            runner.play("x", np.full(60, 1.2), 100.0, 0.25)
    bench.assert_safe()
    bench.session.close()
    with SessionReader(bench.path) as reader:
        assert len(reader.experiment("x").codes) == 15
        assert any("ended by" in what for _, what in reader.events())


def test_a_voltage_above_the_limit_is_refused_before_anything_moves(bench: Bench) -> None:
    with bench.runner() as runner, pytest.raises(LimitError, match=r"2\.1 V is outside \[0, 2\]"):
        runner.play("x", np.array([0.5] * 20 + [2.1]), 100.0, 0.25)
    assert bench.session.experiment("x").codes.shape[0] == 0
    bench.assert_safe()


def test_a_lost_carrier_trips_the_loop(bench: Bench) -> None:
    read, count = bench.twin.read, iter(range(1000))

    def unplugged():
        if next(count) == 20:
            bench.twin.off()
        return read()

    bench.rig = dataclasses.replace(bench.rig)
    bench.twin.read = unplugged  # type: ignore[method-assign]
    lost = r"No strain in 5 blocks .*No capacitance \(amplitude lost\)"
    with pytest.raises(SafetyError, match=lost), bench.runner() as runner:
        runner.close_loop("x", np.zeros(200), LOOP, 100.0, 0.25)
    del bench.twin.read
    bench.assert_safe()


def test_a_breakdown_ends_at_zero(tmp_path: Path) -> None:
    config = TwinConfig.model_validate({"dielectric": {"breakdown_v_per_m": 15e6}})
    bench = Bench(tmp_path, config)
    with pytest.raises(SafetyError, match="Dielectric breakdown"), bench.runner() as runner:
        runner.play("x", np.linspace(0.0, 2.0, 100), 100.0, 0.25)
    assert bench.twin.output_v == 0.0
    with pytest.raises(SafetyError, match="The output is at 0 V"):
        bench.twin.read()  # a broken actuator stays off


def test_a_map_that_asks_for_more_than_the_drive_has_is_refused(bench: Bench) -> None:
    wild = dataclasses.replace(LOOP, voltage_map=VoltageMap(3.0, 3.0, -0.3, -20.0))
    with bench.runner() as runner, pytest.raises(LimitError, match="drive voltage"):
        runner.close_loop("x", np.zeros(20), wild, 100.0, 0.25)
    bench.assert_safe()


class Charged:
    """A supply whose capacitor runs down after its switch was opened."""

    def __init__(self, time_constant_s: float) -> None:
        self._tau_s, self._off_s = time_constant_s, 0.0
        self.reported: list[float] = []

    def set_voltage(self, voltage_v: float) -> None: ...

    def off(self) -> None:
        self._off_s = self._off_s or time.monotonic()

    def is_off(self) -> bool:
        return self._off_s > 0.0

    def read_voltage(self) -> float:
        passed_s = time.monotonic() - self._off_s if self._off_s else 0.0
        self.reported.append(1500.0 * math.exp(-passed_s / self._tau_s))
        return self.reported[-1]


def test_a_supply_that_runs_down_slowly_is_waited_for(bench: Bench) -> None:
    bench.rig.supply = supply = Charged(0.05)  # below 50 V after 0.17 s
    with bench.runner() as runner:
        runner.play("x", np.full(30, 1.5), 100.0, 0.25)
    assert supply.reported[0] > 50.0 > supply.reported[-1]
    bench.assert_safe()


def test_a_supply_that_does_not_discharge_is_reported(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(at_rest, "_DISCHARGE_S", 0.2)
    bench.rig.supply = Charged(1e6)
    with (
        pytest.raises(SafetyError, match=r"off by hand.* supply still shows 1500 V, 0\.2 s after"),
        bench.runner() as runner,
    ):
        runner.play("x", np.full(30, 1.5), 100.0, 0.25)
    bench.assert_safe()


def test_a_supplys_own_meter_may_be_off_by_its_tolerance(bench: Bench) -> None:
    bench.rig.supply = supply = Charged(1e6)
    supply.tolerance_v = 1600.0
    with bench.runner() as runner:
        runner.play("x", np.full(30, 1.5), 100.0, 0.25)
    assert supply.reported[-1] > 1400.0
    bench.assert_safe()
