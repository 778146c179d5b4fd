"""Before a person is sent to the clamp everything is off, and read back where the rig can be."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from haselab.base import SafetyError, SilentProgress
from haselab.rig import Rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Stage
from haselab.store.session.writer import ExperimentPlan, SessionWriter


class Person:
    """Notes what was energised when the prompt came."""

    def __init__(self, twin: TwinBench) -> None:
        self._twin = twin
        self.met: list[tuple[float, float]] = []

    def hang(self, mass_kg: float) -> None:
        self.met.append((self._twin._after_v, self._twin.native.carrier_v))
        self._twin.hang(mass_kg)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._twin, name)


class MeteredSource:
    """The twin's output with a meter that can be wrong."""

    def __init__(self, twin: TwinBench, shows_v: float | Exception | None) -> None:
        self._twin, self._shows_v = twin, shows_v

    def write(self, voltage_v: float) -> None:
        self._twin.write(voltage_v)

    def zero(self) -> None:
        self._twin.zero()

    def read_back(self) -> float:
        if isinstance(self._shows_v, Exception):
            raise self._shows_v
        return self._twin._after_v if self._shows_v is None else self._shows_v


def bench(shows_v: float | Exception | None = None) -> tuple[Rig, Person, TwinBench]:
    config = twin_of_reading("hz")
    twin = TwinBench(config, 2)
    person = Person(twin)
    rig = rig_of(twin, config)
    return dataclasses.replace(rig, stand=person, source=MeteredSource(twin, shows_v)), person, twin


def runner(rig: Rig, folder: Path, session: SessionWriter) -> Runner:
    camera_recorder = CameraRecorder(rig.camera, session, folder, "none")
    return Runner(rig, session, camera_recorder, 2000.0, 0.02, SilentProgress())


@pytest.mark.parametrize("drive_v", [0.0, 1.0])
def test_load_meets_no_drive_and_no_carrier_and_restores_the_carrier(
    tmp_path: Path, drive_v: float
) -> None:
    rig, person, twin = bench()
    plan = [ExperimentPlan("x", "test", 6, {})]
    with (
        SessionWriter(tmp_path / "s.h5", plan, 2000, {}) as session,
        runner(rig, tmp_path, session) as playing,
    ):
        playing.settle(drive_v, 0.1)
        assert twin.native.carrier_v == 0.02
        playing.load(0.25)
        assert person.met == [(0.0, 0.0)]
        assert twin.native.carrier_v == 0.02
        playing.hang("x", [0.1, 0.25], 0.1, 50.0)
        assert person.met == [(0.0, 0.0)] * 3


@pytest.mark.parametrize(
    ("shows_v", "reported"),
    [(0.5, r"2500 V"), (OSError("cable"), "OSError: cable")],
)
def test_nobody_is_sent_to_a_bench_that_is_not_confirmed_at_zero(
    shows_v: float | Exception, reported: str
) -> None:
    rig, person, _ = bench(shows_v)
    guarded = guard(rig)
    guarded.safety.arm(guarded.safety.request())
    with pytest.raises(SafetyError, match=rf"Do not touch.*mass is changed: .*{reported}"):
        guarded.stand.hang(0.25)
    assert person.met == []
    assert guarded.safety.stage is Stage.TRIPPED
