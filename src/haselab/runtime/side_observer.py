"""An observer in a thread of its own: on a rig in real time the loop does not wait for pictures."""

from __future__ import annotations

import threading

from haselab.base import DeviceError
from haselab.runtime.observer import Observer, Seen

__all__ = ["SideObserver"]

_LOOK_S = 0.02  # between two looks
_PATIENCE_S = 20.0  # the search for the points in a picture takes one on a slow computer


class SideObserver:
    """Lets an observer look all the time between the start and the end of an experiment.

    What goes wrong in the thread is raised by the next look, at the latest by `finish`. An observer
    that hangs is left behind, and told.

    Args:
        observer: that looks; nobody else may ask it to.
        every_s: between two looks, in s.
        patience_s: that its last look may take, in s.
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
        self._left = False  # it hangs

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
        """See `Observer`: what the thread saw last, unless that was told before. Does not wait."""
        with self._lock:
            self._tell()
            seen, self._seen = self._seen, None
            return seen

    def finish(self) -> None:
        """See `Observer`."""
        if self._left:
            return  # it was told, and whoever hangs is not asked again
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
                f"The camera has not let go for {self._patience_s:g} s. Its frames of this "
                "experiment are lost; check cable and driver."
            )

    def _tell(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
