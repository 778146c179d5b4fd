"""Two steps to arm, one to trip; nothing is energised in between; every value is checked."""

from __future__ import annotations

import dataclasses
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError, LimitError, SafetyError, SilentProgress
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.runner import Runner
from haselab.safety import shutdown
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.interlock import Interlock
from haselab.safety.state_machine import Safety, SafetySettings, Stage
from haselab.store.session.writer import ExperimentPlan, SessionWriter


@pytest.fixture
def twin() -> TwinBench:
    return TwinBench(twin_of_reading("hz"), 4)


def guarded(twin: TwinBench, settings: SafetySettings | None = None) -> GuardedRig:
    return guard(rig_of(twin, twin_of_reading("hz")), Safety(settings or SafetySettings()))


def arm(rig: GuardedRig) -> None:
    rig.safety.arm(rig.safety.request())


def test_nothing_but_zero_goes_out_before_both_steps(twin: TwinBench) -> None:
    rig = guarded(twin)
    for stage in ("off", "requested"):
        if stage == "requested":
            permit = rig.safety.request()
        with pytest.raises(
            SafetyError, match=rf"The bench is {stage}\. Arm the bench before you apply"
        ):
            rig.source.write(0.1)
        with pytest.raises(SafetyError, match="Arm the bench before"):
            rig.generator.sine(2000.0, 0.02)
        rig.source.write(0.0)
        rig.acquisition.read()
        assert twin.output_v == pytest.approx(0.0, abs=1e-9)
    rig.safety.arm(permit)
    rig.source.write(0.1)
    rig.acquisition.read()
    assert twin.output_v == pytest.approx(500.0, rel=0.02)


def test_a_permit_arms_once_and_only_the_last_one_does(twin: TwinBench) -> None:
    safety = guarded(twin).safety
    first, second = safety.request(), safety.request()
    with pytest.raises(SafetyError, match=r"request 1 is no longer valid \(the last one is 2\)"):
        safety.arm(first)
    safety.arm(second)
    assert safety.stage is Stage.ARMED
    with pytest.raises(SafetyError, match="already armed"):
        safety.request()
    safety.end_run()
    with pytest.raises(SafetyError, match="Arming request 2 is no longer valid"):
        safety.arm(second)


def test_a_trip_latches_its_first_reason_until_a_new_arming(twin: TwinBench) -> None:
    rig = guarded(twin)
    arm(rig)
    rig.source.write(1.0)
    rig.acquisition.read()
    assert str(rig.safety.trip("Smoke.")) == "Smoke. All outputs were commanded to 0 V."
    assert twin.output_v == 0.0
    rig.safety.trip("Fire.")
    rig.safety.end_run()
    assert (rig.safety.stage, rig.safety.reason) == (Stage.TRIPPED, "Smoke.")
    with pytest.raises(SafetyError, match=r"The bench is tripped: Smoke\. No voltage is applied"):
        rig.source.write(0.5)
    request = rig.safety.request()
    assert request.reason.startswith("Smoke (on ")
    with pytest.raises(SafetyError, match=r"was revoked: Smoke \(on .*acknowledge this reason"):
        rig.safety.arm(request)
    with pytest.raises(SafetyError, match=r"Arm the bench|is tripped"):
        rig.source.write(0.5)
    rig.safety.arm(request, acknowledged=request.reason)
    rig.source.write(0.5)
    assert rig.safety.reason == ""


def test_a_runner_on_a_rig_that_was_not_armed_is_refused(twin: TwinBench, tmp_path: Path) -> None:
    rig = guarded(twin)
    with SessionWriter(tmp_path / "s.h5", [ExperimentPlan("x", "t", 6, {})], 2000, {}) as session:
        camera_recorder = CameraRecorder(rig.camera, session, tmp_path, "none")
        runner = Runner(rig, session, camera_recorder, 2000.0, 0.02, SilentProgress())
        with pytest.raises(SafetyError, match="The bench is off"), runner:
            raise AssertionError("must not be entered")
        arm(rig)
        with runner:
            runner.play("x", np.full(20, 0.4), 50.0, 0.25)
        with pytest.raises(SafetyError, match="The bench is off"), runner:
            raise AssertionError("one arming, one run")


def test_every_value_is_checked_where_it_goes_out(twin: TwinBench) -> None:
    rig = guarded(twin)
    arm(rig)
    for bad in (2.0001, -0.0001, float("nan"), float("inf")):
        with pytest.raises(LimitError, match="drive voltage"):
            rig.source.write(bad)
    rig.acquisition.read()
    assert twin.output_v == pytest.approx(0.0, abs=1e-9)


def test_a_rise_above_the_rate_is_refused_and_a_fall_to_zero_never(twin: TwinBench) -> None:
    # 10 V/s are 0.1 V in a block of 10 ms.
    rig = guarded(twin, SafetySettings(rate_limit_v_per_s=10.0))
    arm(rig)
    with pytest.raises(LimitError, match=r"rise of the drive = 11 V/s is outside \[-10, 10\]"):
        rig.source.write(0.11)
    for value in (0.1, 0.2, 0.3):
        rig.source.write(value)
        rig.acquisition.read()
    with pytest.raises(LimitError, match="rise of the drive"):
        rig.source.write(0.41)
    rig.source.write(0.0)
    rig.acquisition.read()
    assert twin.output_v == pytest.approx(0.0, abs=1.0)


def test_a_whole_drive_is_checked_before_its_first_value(twin: TwinBench) -> None:
    rig = guarded(twin, SafetySettings(rate_limit_v_per_s=10.0))
    rig.check_drive(np.arange(0.0, 2.0, 0.1))
    rig.check_drive(np.array([0.1, 0.2, 0.0, 0.1]))
    for bad in ([0.1, 0.2, 0.35], [0.2], [0.05, float("nan")], [0.1, 0.2, 2.1]):
        with pytest.raises(LimitError, match="is outside"):
            rig.check_drive(np.array(bad))


class Hanging:
    """A generator with a connection of its own whose `off` does not return."""

    def __init__(self) -> None:
        self.leave = threading.Event()

    def sine(self, frequency_hz: float, amplitude_v: float) -> None: ...

    def off(self) -> None:
        self.leave.wait(60.0)

    def is_off(self) -> bool:
        return True


def test_an_instrument_that_never_returns_is_abandoned_and_reported(
    twin: TwinBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutdown, "_LONGEST_S", 0.01)
    hanging = Hanging()
    plain = dataclasses.replace(rig_of(twin, twin_of_reading("hz")), generator=hanging)
    rig = guard(plain, Safety(SafetySettings()))
    arm(rig)
    rig.source.write(1.0)
    rig.acquisition.read()
    rig.safe()
    rig.acquisition.read()
    assert abs(twin.output_v) < 1.0
    assert "generator: off() has not returned within 0.01 s" in rig.read_back().text
    hanging.leave.set()


def test_zero_is_tried_again_and_the_others_too_when_a_driver_breaks_its_word(
    twin: TwinBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = guarded(twin)
    arm(rig)
    rig.generator.sine(2000.0, 0.02)
    rig.source.write(1.0)
    rig.acquisition.read()
    zero, calls = twin.zero, iter(range(10))

    def stubborn() -> None:
        if next(calls) == 0:
            raise OSError("busy")
        zero()

    monkeypatch.setattr(twin, "zero", stubborn)
    rig.safe()
    rig.acquisition.read()
    assert abs(twin.output_v) < 1.0


def test_an_output_that_stays_is_reported_and_recorded(twin: TwinBench, tmp_path: Path) -> None:
    config = twin_of_reading("hz")
    rig = rig_of(twin, config)
    events: list[str] = []
    with SessionWriter(tmp_path / "s.h5", [ExperimentPlan("x", "t", 6, {})], 2000, {}) as session:
        camera_recorder = CameraRecorder(rig.camera, session, tmp_path, "none")
        runner = Runner(rig, session, camera_recorder, 2000.0, 0.02, SilentProgress())
        reported = r"Output not at 0 V: 25\d\d V remain at the output.*by hand"
        with pytest.raises(SafetyError, match=reported), runner:
            runner.play("x", np.full(20, 0.5), 50.0, 0.25)
            twin.zero = lambda: None  # type: ignore[method-assign]
        events = [what for _, what in session.events()]
    assert any(what.startswith("trip: Output not at 0 V") for what in events)


@pytest.mark.parametrize(
    "bad",
    [
        {"current_limit_a": 0.0},
        {"lease_s": -1.0},
        {"missed_limit": 0},
        {"rate_limit_v_per_s": math.inf},
        {"current_limit_a": math.inf},
        {"follow": math.inf},
        {"permit_age_s": math.nan},
    ],
)
def test_limits_that_are_not_finite_and_positive_are_refused(bad: dict[str, float]) -> None:
    name = re.escape(next(iter(bad)))
    with pytest.raises(InputError, match=rf"safety\.{name} is .* finite and above 0"):
        SafetySettings(**bad)  # type: ignore[arg-type]


def test_a_reason_that_comes_while_arming_is_requested_is_not_acknowledged_unread(
    twin: TwinBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program makes the bench safe just after the reason was read."""
    rig = guarded(twin)
    interlock = rig.safety.gate.interlock
    read = type(interlock).reason.fget  # type: ignore[attr-defined]

    def reason(self: Interlock) -> str:
        found: str = read(self)
        monkeypatch.undo()
        self.revoke("Smoke.")
        return found

    monkeypatch.setattr(Interlock, "reason", property(reason))
    request = rig.safety.request()
    assert request.reason == ""
    with pytest.raises(SafetyError, match=r"after arming was requested: Smoke \(on "):
        rig.safety.arm(request)
    assert interlock.reason.startswith("Smoke (on ")


def test_a_trip_at_any_moment_of_arming_wins(
    twin: TwinBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """STOP comes from another thread, here while the second step of arming is carried out."""
    rig = guarded(twin)
    interlock, stops = rig.safety.gate.interlock, []
    acknowledge = interlock.acknowledge

    def interrupted(revision: int) -> None:
        stops.append(threading.Thread(target=rig.safety.trip, args=("STOP was pressed",)))
        stops[0].start()
        stops[0].join(0.1)  # it may come to its end here, or wait until the step is complete
        acknowledge(revision)

    monkeypatch.setattr(interlock, "acknowledge", interrupted)
    arm(rig)
    stops[0].join()
    assert rig.safety.stage is Stage.TRIPPED and not rig.safety.live
    assert rig.safety.reason == "STOP was pressed"
    with pytest.raises(SafetyError, match="STOP was pressed"):
        rig.source.write(0.5)
    rig.safety.end_run()
    with pytest.raises(SafetyError, match="Remove the cause"):
        arm(rig)


class Watching:
    """Guardians that have noticed nothing yet."""

    def lost(self) -> str:
        return ""

    def make_safe(self, reason: str) -> None:
        """See `Guardians`."""


def test_a_lease_that_has_ended_is_not_renewed(twin: TwinBench) -> None:
    """After the computer slept, the program may run before its guardians do."""
    rig = guarded(twin)
    rig.safety.guardians = Watching()  # type: ignore[assignment]
    arm(rig)
    rig.source.write(0.5)
    rig.safety.gate.interlock.lease(-3600.0)
    with pytest.raises(SafetyError, match=r"of this program ended 3[56]\d\d"):
        rig.source.write(0.6)
    rig.acquisition.read()
    assert abs(twin.output_v) < 50.0
    assert rig.safety.stage is Stage.TRIPPED and not rig.safety.live
