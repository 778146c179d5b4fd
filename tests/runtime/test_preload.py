"""Outputs that are known early wait in the device; those that came too late are reported."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import LimitError, SafetyError, SilentProgress
from haselab.rig.bench_config import BenchConfig
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.runner import Runner
from haselab.safety.gate import Gate
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.deadlines import Deadlines
from haselab.store.session.writer import ExperimentPlan, SessionWriter

LEAD = 7


class Queueing:
    """The twin's source, as a board that plays by its own clock."""

    def __init__(self, twin: TwinBench, late: dict[int, int]) -> None:
        self._twin, self._late = twin, late
        self.preloaded: list[np.ndarray] = []
        self.writes = self.missed_outputs = 0

    def write(self, voltage_v: float) -> None:
        late = self._late.get(self.writes, 0)
        self.missed_outputs += late
        if not late:  # else the output stands
            self._twin.write(voltage_v)
        self.writes += 1

    def preload(self, voltages_v: np.ndarray) -> int:
        self.preloaded.append(voltages_v.copy())
        return LEAD

    def zero(self) -> None:
        self._twin.zero()


def bench(late: dict[int, int] | None = None, **settings: Any) -> tuple[Queueing, Any]:
    config = twin_of_reading("hz")
    twin = TwinBench(config, 5)
    source = Queueing(twin, late or {})
    rig = dataclasses.replace(rig_of(twin, config), source=source)
    return source, guard(rig, Safety(SafetySettings(**settings)))


def test_outputs_left_out_in_a_row_trip_a_bench_of_the_wall_clock(tmp_path: Path) -> None:
    config = twin_of_reading("hz")
    twin = TwinBench(config, 5)
    source = Queueing(twin, dict.fromkeys(range(30, 35), 1))
    rig = dataclasses.replace(rig_of(twin, config), source=source)
    guarded = guard(rig, Safety(SafetySettings(real_time=True)), clock=lambda: 0.0)
    with SessionWriter(tmp_path / "s.h5", [ExperimentPlan("x", "test", 6, {})],
                       rig.description.block_samples, {}) as session:  # fmt: skip
        camera_recorder = CameraRecorder(rig.camera, session, tmp_path, "none")
        guarded.safety.arm(guarded.safety.request())
        with (
            pytest.raises(SafetyError, match="outputs of 5 blocks in a row came too late"),
            Runner(guarded, session, camera_recorder, 2000.0, 0.02, SilentProgress()) as runner,
        ):
            runner.play("x", np.full(80, 0.5), 100.0, 0.25)
        assert len(session.experiment("x").drive_v) == 35
    assert twin.output_v == 0.0


def test_a_whole_drive_is_queued_and_late_outputs_are_recorded(tmp_path: Path) -> None:
    source, rig = bench({30: 1, 31: 1, 70: 1})
    drive_v = np.minimum(0.02 * np.arange(80), 1.0)
    samples = rig.description.block_samples
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("x", "y")]
    with SessionWriter(tmp_path / "s.h5", plans, samples, {}) as session:
        camera_recorder = CameraRecorder(rig.camera, session, tmp_path, "none")
        rig.safety.arm(rig.safety.request())
        with Runner(rig, session, camera_recorder, 2000.0, 0.02, SilentProgress()) as runner:
            runner.play("x", drive_v, 100.0, 0.25)
            runner.release("y", 0.5, 0.1, 0.3, 100.0, 0.25)
        events = [what for _, what in session.events()]
        recorded = session.experiment("x").drive_v
    np.testing.assert_array_equal(source.preloaded[0], drive_v)
    np.testing.assert_array_equal(source.preloaded[1], np.full(40, 0.5))
    assert events.count("1 outputs came too late and were skipped") == 3
    # What stood is what is recorded, so that no fit takes a drive that never was.
    stood_v = drive_v.copy()
    stood_v[[30, 31]] = drive_v[29]
    np.testing.assert_array_equal(recorded, stood_v)


def test_after_outputs_were_left_out_the_rise_is_held_against_what_stands() -> None:
    source, rig = bench({3: 1, 4: 1, 5: 1}, rate_limit_v_per_s=4.0)
    rig.safety.arm(rig.safety.request())
    rig.begin()
    with pytest.raises(LimitError, match="rise of the drive"):
        for k in range(8):
            rig.source.write(0.03 * k)
            rig.acquisition.read()
    assert source.writes == 4  # 0.12 V would be twice the rise that is allowed
    rig.safe()


def test_nothing_is_queued_unless_armed_and_within_the_limits() -> None:
    source, rig = bench(rate_limit_v_per_s=10.0)
    with pytest.raises(SafetyError, match="Arm the bench before"):
        rig.preload(np.full(5, 0.1))
    rig.safety.arm(rig.safety.request())
    for drive_v in (np.full(5, 3.0), np.array([0.0, 0.5])):
        with pytest.raises(LimitError, match=r"outside|allowed"):
            rig.preload(drive_v)
    assert source.preloaded == []
    rig.preload(np.full(5, 0.05))
    assert len(source.preloaded) == 1
    rig.safe()


def test_a_rig_that_cannot_queue_gets_nothing() -> None:
    config = twin_of_reading("hz")
    rig = guard(rig_of(TwinBench(config, 5), config))
    rig.preload(np.full(5, 9.0))
    assert rig.missed_outputs == 0


def test_what_waits_in_the_device_may_come_so_much_later() -> None:
    now = [0.0]
    deadlines = Deadlines(0.02, 3, 100, lambda: now[0])

    def tick(block: int, late_s: float) -> str:
        now[0] = 0.01 * block
        deadlines.arrived(0.01 * block)
        now[0] += late_s
        return deadlines.answered()

    deadlines.start(0.05)
    assert [tick(k, 0.069) for k in range(5)] == [""] * 5
    assert deadlines.ticks.missed == 0
    deadlines.start()
    assert "3 deadlines missed" in [tick(k, 0.03) for k in range(5, 8)][-1]


def test_a_drive_that_ends_while_changing_is_no_fault(
    tmp_path: Path,
) -> None:
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    # Three outputs wait. When the camera stops, the stream is let go and the last one stands.
    drive_v = np.concatenate([np.full(40, 1.8), [1.7, 1.4, 0.9, 0.1]])
    with (
        ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served,
        RealBench(
            BenchConfig.model_validate(tomllib.loads(served.rig_file(ahead_blocks=3))), Gate()
        ) as b,
    ):
        patient = SafetySettings(real_time=True, missed_limit=10**6, late_limit=10**6)
        rig = guard(b.rig, Safety(patient))
        rig.safety.arm(rig.safety.request())
        samples = rig.description.block_samples
        plans = [ExperimentPlan("x", "test", 6, {})]
        with SessionWriter(tmp_path / "s.h5", plans, samples, {}) as session:
            camera_recorder = CameraRecorder(rig.camera, session, tmp_path, "none")
            with Runner(rig, session, camera_recorder, 2000.0, 0.02, SilentProgress()) as runner:
                runner.play("x", drive_v, 100.0, 0.25)
                runner.settle(0.0, 0.2)
        assert rig.safety.reason == ""
        assert abs(served.hub.output_v) < 50.0
