"""Run an observer in its own thread, so that a real-time loop does not wait for images."""

from __future__ import annotations

import threading

from haselab.base import DeviceError
from haselab.runtime.observer import Observer, Seen

__all__ = ["ThreadedObserver"]

_LOOK_S = 0.02  # between two calls of the observer
_PATIENCE_S = 20.0  # a search of one image takes 1 s on a slow computer


class ThreadedObserver:
    """Calls an observer repeatedly in a thread, from start to end of an experiment.

    An error in the thread is raised by the next `look`, at the latest by `finish`. An observer that
    hangs is abandoned and reported.

    Args:
        observer: the observer; nothing else may call it.
        every_s: time between two calls, in s.
        patience_s: longest time for its last call, in s.
    """

    def __init__(
        self, observer: Observer, every_s: float = _LOOK_S, patience_s: float = _PATIENCE_S
    ) -> None:
        self._observer = observer
        self._every_s, self._patience_s = every_s, patience_s
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._seen: Seen | None = None
        self._failure: BaseException | None = None
        self._left = False  # whether it was abandoned because it hangs

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """See `Observer`."""
        self._stop()
        self._check_left()
        self._seen = self._failure = None
        self._observer.start(name, rate_hz, mass_kg, part, particles)
        self._end.clear()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def look(self) -> Seen | None:
        """See `Observer`; returns each result of the thread once, and does not wait."""
        with self._lock:
            self._raise_failure()
            seen, self._seen = self._seen, None
            return seen

    def finish(self) -> None:
        """See `Observer`."""
        if self._left:
            return  # already reported, and an observer that hangs is not called again
        self._stop()
        with self._lock:
            failure, self._failure = self._failure, None
        try:
            self._observer.finish()
        finally:
            if failure is not None:
                raise failure

    def _run(self) -> None:
        try:
            while not self._end.wait(self._every_s):
                seen = self._observer.look()
                with self._lock:
                    self._seen = seen or self._seen
        except BaseException as failure:
            with self._lock:
                self._failure = failure

    def _stop(self) -> None:
        self._end.set()
        thread, self._thread = self._thread, None
        if thread is None:
            return
        thread.join(self._patience_s)
        self._left = thread.is_alive()
        self._check_left()

    def _check_left(self) -> None:
        if self._left:
            raise DeviceError(
                f"The camera has not returned for {self._patience_s:g} s. Its frames of this "
                "experiment are lost. Check its cable and its driver."
            )

    def _raise_failure(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
