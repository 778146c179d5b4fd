"""The observer's thread: what it sees, what it raises, and that the loop never waits for it."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from haselab.base import DeviceError
from haselab.runtime.observer import Seen
from haselab.runtime.threaded_observer import ThreadedObserver

WAIT_S = 300.0  # for another thread, on a busy computer


class Scripted:
    """An observer whose looks the test lets through one at a time."""

    def __init__(self) -> None:
        self.calls: list[object] = []
        self.asked, self.go = threading.Semaphore(0), threading.Semaphore(0)
        self.answers: Iterator[Seen | Exception | None] = iter(())

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        self.calls.append((name, rate_hz, mass_kg, part, particles))

    def look(self) -> Seen | None:
        self.asked.release()
        assert self.go.acquire(timeout=WAIT_S)
        answer = next(self.answers, None)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def let_through(self) -> None:
        """One look is answered, and the next one has begun: its result has been taken over."""
        assert self.asked.acquire(timeout=WAIT_S)
        self.go.release()
        assert self.asked.acquire(timeout=WAIT_S)
        self.asked.release()

    def finish(self) -> None:
        self.calls.append("finish")


def ended(side: ThreadedObserver, scripted: Scripted) -> None:
    for _ in range(100):
        scripted.go.release()
    side.finish()


def test_the_last_result_is_returned_once_and_without_waiting():
    plain = Scripted()
    side = ThreadedObserver(plain, every_s=1e-3)
    plain.answers = iter([Seen(1.0, 5.0), None, Seen(2.0, 6.0), Seen(3.0, 7.0)])
    side.start("x", 50.0, 0.1, "-1", "p")
    assert side.look() is None  # though the observer hangs in its look
    plain.let_through()
    assert side.look() == Seen(1.0, 5.0)
    assert side.look() is None
    for _ in range(3):
        plain.let_through()
    assert side.look() == Seen(3.0, 7.0)
    ended(side, plain)
    assert plain.calls == [("x", 50.0, 0.1, "-1", "p"), "finish"]


def test_what_goes_wrong_in_the_thread_is_raised_by_the_next_look_once():
    plain = Scripted()
    side = ThreadedObserver(plain, every_s=1e-3)
    plain.answers = iter([DeviceError("the camera is gone")])
    side.start("x", 50.0, 0.1)
    plain.go.release()
    assert side._thread is not None
    side._thread.join(WAIT_S)
    with pytest.raises(DeviceError, match="the camera is gone"):
        side.look()
    side.finish()
    assert plain.calls[-1] == "finish"


def test_what_no_look_has_raised_is_raised_at_the_end_after_the_camera_has_stopped():
    plain = Scripted()
    side = ThreadedObserver(plain, every_s=1e-3)
    plain.answers = iter([DeviceError("the camera is gone")])
    side.start("x", 50.0, 0.1)
    plain.go.release()
    assert side._thread is not None
    side._thread.join(WAIT_S)
    with pytest.raises(DeviceError, match="the camera is gone"):
        side.finish()
    assert plain.calls[-1] == "finish"


def test_no_thread_is_left_and_each_experiment_starts_anew():
    threads = []
    plain = Scripted()
    side = ThreadedObserver(plain, every_s=1e-3)
    for k in range(3):
        plain.answers = iter([Seen(float(k), 1.0)])
        side.start(f"{k}", 50.0, 0.1)
        threads.append(side._thread)
        assert side.look() is None  # what the last experiment saw is not this one's
        ended(side, plain)
        plain.asked, plain.go = threading.Semaphore(0), threading.Semaphore(0)
    assert not any(thread.is_alive() for thread in threads)
    assert plain.calls.count("finish") == 3


def test_an_observer_that_hangs_is_abandoned_and_reported():
    plain = Scripted()
    side = ThreadedObserver(plain, every_s=1e-3, patience_s=0.05)
    side.start("x", 50.0, 0.1)
    assert plain.asked.acquire(timeout=WAIT_S)  # it hangs in its look from here on
    with pytest.raises(DeviceError, match=r"camera has not returned for 0\.05 s"):
        side.finish()
    side.finish()  # reported once, and no way out waits for it again
    assert "finish" not in plain.calls  # whoever hangs is not asked from two sides
    with pytest.raises(DeviceError, match="has not returned"):
        side.start("y", 50.0, 0.1)
    plain.go.release()
