"""Do jobs in order in a background thread, so that a slow disk does not delay the recorder."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from haselab.base import DeviceError

__all__ = ["JobQueue", "QueueRule"]


@dataclass(frozen=True)
class QueueRule:
    """Limits for data that wait for the disk.

    Args:
        chunks: number of chunks of 0.1 s that may wait.
        patience_s: how long the recorder waits for room; 0 on a rig in real time, where a full
            queue is an error at once. The twin waits with its recorder.
        sync_s: interval at which the data are synchronised to the disk, in s: a power cut may lose
            this much.
        clock_s: any steady clock.
    """

    chunks: int = 20
    patience_s: float = 60.0
    sync_s: float = 1.0
    clock_s: Callable[[], float] = time.monotonic


class JobQueue:
    """A bounded queue and the thread that empties it.

    After a job has failed the others are dropped, until `put` or `drain` has raised the error.

    Args:
        rule: how many jobs may wait, and for how long.
        full: makes the error if there is no room in time.
    """

    def __init__(self, rule: QueueRule, full: Callable[[], DeviceError]) -> None:
        self._rule = rule
        self._full = full
        self._jobs: deque[tuple[Callable[[], None], bool]] = deque()
        self._changed = threading.Condition()
        self._busy = self._ending = False
        self._failure: BaseException | None = None
        self.most_waiting = 0
        self._thread = threading.Thread(target=self._run, name="session writer", daemon=True)
        self._thread.start()

    def put(self, job: Callable[[], None], *, always: bool = False) -> None:
        """Queue a job.

        Args:
            job: done after all that came before it.
            always: do it even after another job has failed.
        Raises:
            DeviceError: there is no room in time, or the queue was closed.
        """
        with self._changed:
            if self._ending:  # nobody would do the job, and who waits for it would wait forever
                raise DeviceError("The recording is closed, so nothing can be added to it.")
            if not always:
                self._raise_failure()
            if not (self._changed.wait_for(self._has_room, self._rule.patience_s) or always):
                raise self._full()
            if not always:
                self._raise_failure()
            self._jobs.append((job, always))
            self.most_waiting = max(self.most_waiting, len(self._jobs))
            self._changed.notify_all()

    def settle(self) -> None:
        """Wait until all jobs are done; an error is raised later."""
        with self._changed:
            self._changed.wait_for(lambda: not self._jobs and not self._busy)

    def drain(self) -> None:
        """Wait until all jobs are done; raise the error of a failed one."""
        self.settle()
        with self._changed:
            self._raise_failure()

    def close(self) -> None:
        """Do the waiting jobs and end the thread; raise an error. Safe to call twice."""
        with self._changed:
            self._ending = True
            self._changed.notify_all()
        self._thread.join()
        with self._changed:
            self._raise_failure()

    def _has_room(self) -> bool:
        return len(self._jobs) < self._rule.chunks

    def _raise_failure(self) -> None:
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._ending)
                if not self._jobs:
                    return
                job, always = self._jobs.popleft()
                self._busy = True
                skip = self._failure is not None and not always
                self._changed.notify_all()
            failure: BaseException | None = None
            try:
                if not skip:
                    job()
            except BaseException as error:
                failure = error
            with self._changed:
                self._busy = False
                self._failure = self._failure or failure
                self._changed.notify_all()
