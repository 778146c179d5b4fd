"""A call into code of another package that does not return is interrupted."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from haselab.base import InputError, SafetyError, SilentProgress
from haselab.base.exits import TooLongError, no_exit
from haselab.control import Saturation
from haselab.controllers import ControllerKind, ControllerSetting, Measurement
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.call_limit import CallLimit
from haselab.runtime.loop import LoopSettings, RunningController
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings

pytestmark = pytest.mark.skipif(
    not hasattr(signal, "setitimer"), reason="the timer that interrupts calls is POSIX's"
)
LIMIT_S = 0.05
SETTING = ControllerSetting(0.01, -0.04, 0.1)
SEEN = Measurement(0.01, 1e-9, 1.0, 0.0)


def spin() -> None:
    while True:
        pass


def wait_for_a_lock() -> None:
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()


def retry() -> None:
    """Like code that repeats a request until an instrument answers."""
    for _ in range(2):
        try:
            time.sleep(3600.0)
        except BaseException:
            continue
    time.sleep(3600.0)


@pytest.mark.parametrize("hang", [spin, wait_for_a_lock, retry, lambda: time.sleep(3600.0)])
def test_a_call_that_hangs_is_interrupted(hang: Callable[[], None]) -> None:
    with pytest.raises(TooLongError, match=r"longer than 0\.05 s"), CallLimit(LIMIT_S), no_exit():
        hang()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


def test_a_call_that_returns_leaves_no_timer() -> None:
    with CallLimit(3600.0):
        left_s, _ = signal.getitimer(signal.ITIMER_REAL)
        assert left_s > 0.0
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_program_that_uses_the_timer_itself_keeps_it() -> None:
    def own(number: int, frame: object) -> None:
        del number, frame

    former = signal.signal(signal.SIGALRM, own)
    try:
        with CallLimit(LIMIT_S):
            assert signal.getsignal(signal.SIGALRM) is own
            assert signal.getitimer(signal.ITIMER_REAL)[0] == 0.0
    finally:
        signal.signal(signal.SIGALRM, former)


def test_another_thread_has_no_limit() -> None:
    found: list[float] = []

    def enter() -> None:
        with CallLimit(LIMIT_S):
            found.append(signal.getitimer(signal.ITIMER_REAL)[0])

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert found == [0.0]


class Hangs:
    """A controller that does not return from its third step, or from its start."""

    def __init__(self, where: str) -> None:
        self._where, self._steps = where, 0

    def start(self, setting: ControllerSetting) -> None:
        del setting
        if self._where == "start":
            time.sleep(3600.0)

    def step(self, reference: float, measurement: Measurement) -> float:
        del measurement
        self._steps += 1
        if self._steps == 3:
            time.sleep(3600.0)
        return reference


def hanging(where: str) -> ControllerKind:
    return ControllerKind("hangs", lambda: Hangs(where))


def test_a_controller_that_hangs_fails_with_its_name() -> None:
    with pytest.raises(InputError, match=r"'hangs' has not started within 0\.05 s"):
        RunningController(hanging("start").choose(), SETTING, LIMIT_S)
    running = RunningController(hanging("step").choose(), SETTING, None, LIMIT_S)
    assert [running.step(0.02, SEEN) for _ in range(2)] == [0.02, 0.02]
    with pytest.raises(SafetyError, match=r"'hangs' did not return from its step within 0\.05 s"):
        running.step(0.02, SEEN)


class OddNumber(float):
    """A number that cannot be converted."""

    def __float__(self) -> float:
        raise ValueError("not now")


@pytest.mark.parametrize(
    ("act", "reason"),
    [
        (lambda: OddNumber(0.01), "ValueError: not now"),
        (lambda: next(iter(())), "StopIteration"),
        (lambda: (_ for _ in ()).throw(GeneratorExit()), "GeneratorExit"),
    ],
)
def test_an_unusual_failure_of_a_step_is_the_controller_s(
    act: Callable[[], float], reason: str
) -> None:
    class Odd(Hangs):
        def step(self, reference: float, measurement: Measurement) -> float:
            del reference, measurement
            return act()

    running = RunningController(ControllerKind("odd", lambda: Odd("")).choose(), SETTING)
    with pytest.raises(SafetyError, match=rf"Controller 'odd' failed: {reason}"):
        running.step(0.02, SEEN)


class Events:
    """A session that keeps its events."""

    def __init__(self) -> None:
        self.what: list[str] = []

    def append_block(self, *given: object) -> None:
        """See `Recorder`."""

    def flush(self, name: str) -> None:
        """See `Recorder`."""

    def event(self, time_s: float, what: str) -> None:
        """See `Recorder`."""
        self.what.append(what)

    def condition(self, *given: object) -> None:
        """See `Recorder`."""


class NoCamera:
    """Takes no frames."""

    def start(self, *given: object, **named: object) -> None:
        """See `Observer`."""

    def look(self) -> None:
        """See `Observer`."""

    def finish(self) -> None:
        """See `Observer`."""


def test_on_a_rig_in_real_time_a_step_that_hangs_trips_the_bench() -> None:
    """Without a limit the guardians alone would act, and the program would not end."""
    slow_is_no_fault = 1_000_000  # the twin takes its own time
    safety = Safety(
        SafetySettings(
            real_time=True, lease_s=0.5, missed_limit=slow_is_no_fault, late_limit=slow_is_no_fault
        )
    )
    rig = guard(make_twin(twin_of_reading("hz"), 5), safety)
    events = Events()
    loop = LoopSettings(
        hanging("step").choose(), Saturation(-0.04, 0.1),
        VoltageMap(1.324, 3.124, -0.2805, -26.92), StrainMap(4.9e8, -0.27),
    )  # fmt: skip
    safety.arm(safety.request())
    reference = np.array([math.nan] * 3 + [0.02] * 20)
    with (
        pytest.raises(SafetyError, match=r"'hangs' did not return from its step within 0\.5 s"),
        Runner(rig, events, NoCamera(), 2000.0, 0.02, SilentProgress()) as runner,  # type: ignore[arg-type]
    ):
        runner.close_loop("x", reference, loop, 50.0, 0.25)
    assert events.what[-1] == "ended by SafetyError; output at 0 V"
