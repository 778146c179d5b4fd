"""An observer in a thread of its own: on a rig in real time the loop does not wait for pictures."""

from __future__ import annotations

import threading

from haselab.runtime.observer import Observer, Seen

__all__ = ["SideObserver"]

_LOOK_S = 0.02  # between two looks


class SideObserver:
    """Lets an observer look all the time between the start and the end of an experiment.

    What goes wrong in the thread is raised by the next look, at the latest by `finish`.

    Args:
        observer: that looks; nobody else may ask it to.
        every_s: between two looks, in s.
    """

    def __init__(self, observer: Observer, every_s: float = _LOOK_S) -> None:
        self._observer = observer
        self._every_s = every_s
        self._lock = threading.Lock()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._seen: Seen | None = None
        self._failure: BaseException | None = None

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """See `Observer`."""
        self._stop()
        self._seen = self._failure = None
        self._observer.start(name, rate_hz, mass_kg, part, particles)
        self._end.clear()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)
        self._thread.start()

    def look(self) -> Seen | None:
        """See `Observer`: what the thread saw last, unless that was told before. Does not wait."""
        with self._lock:
            self._tell()
            seen, self._seen = self._seen, None
            return seen

    def finish(self) -> None:
        """See `Observer`."""
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
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _tell(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
