"""Play the study that a page has armed the bench for, and end it when it must end."""

from __future__ import annotations

import math
import threading
import time

from haselab.base import HaselabError, described
from haselab.panel.page_leases import PageLeases
from haselab.panel.pages.study_job import StudyJob
from haselab.panel.study_player import PictureFile, StudyPlayer
from haselab.safety.guarded import GuardedRig
from haselab.store.claim import not_written

__all__ = ["CHECK", "ArmedStudy"]

CHECK = "Check the instruments, then arm the bench again."
_CATCH_UP_S, _WATCH_S = 0.2, 0.1
_RECENT_S = 0.5  # since a thread last used the processor: longer, and it waits
_COMPUTES_S = 0.5  # without a block: the study computes and does not check whether it must end


class _Busy:
    """Whether the thread that makes this object computes, by its processor time."""

    def __init__(self) -> None:
        known = hasattr(time, "pthread_getcpuclockid")  # not on macOS
        self._clock = time.pthread_getcpuclockid(threading.get_ident()) if known else None
        self._used_s, self._seen_s = 0.0, -math.inf

    def look(self) -> bool:
        """Look again, several times in `_RECENT_S`; from one thread while the other one lives."""
        if self._clock is None:
            return False
        now_s, used_s = time.monotonic(), time.clock_gettime(self._clock)
        if used_s > self._used_s + 1e-3:  # a thread that only waits uses less
            self._used_s, self._seen_s = used_s, now_s
        return now_s < self._seen_s + _RECENT_S


class ArmedStudy:
    """The studies of a panel, one after the other.

    Args:
        rig: the bench behind its safety chain.
        leases: of the pages.
        player: plays a study.
    """

    def __init__(self, rig: GuardedRig, leases: PageLeases, player: StudyPlayer) -> None:
        self._rig, self._leases, self.player = rig, leases, player
        self._page = ""  # that has armed the bench
        self._end = ""  # why the study must end; empty: it may go on
        self._busy: _Busy | None = None  # of the thread that plays
        self._block_s = 0.0  # when the last block was read
        self.job: StudyJob | None = None  # that is due or played
        self.recorded = ""  # folder of the last study that was played to its end

    def computes(self) -> bool:
        """Whether the thread that plays a study has just used the processor."""
        busy = self._busy
        return busy is not None and busy.look()

    def begin(self, page: str, job: StudyJob) -> None:
        """The bench was armed for a study.

        Args:
            page: that armed it.
            job: the study.
        """
        self._page, self._end, self.job = page, "", job

    def end(self, reason: str) -> None:
        """End the study; the bench goes to 0 V and the recording is kept.

        Args:
            reason: one sentence; the first one is kept.
        """
        self._end = self._end or reason

    def passed(self) -> None:
        """A block was read.

        Raises:
            StudyEndedError: the study must end.
        """
        self._block_s = time.monotonic()
        if self.job is not None and self._rig.safety.live:
            self.player.require_wanted()

    def play(self, job: StudyJob, picture: PictureFile | None) -> str:
        """Play the study. Meanwhile, pages can confirm a step, disarm, leave and renew leases.

        Args:
            job: the study.
            picture: takes the last frame; None: no pictures.
        Returns:
            Why it has ended. After a fault of a disk or a driver the bench has tripped.
        """
        folder, over, self._busy = job.options.folder, threading.Event(), _Busy()
        threading.Thread(target=self._watch, args=(over,), daemon=True).start()
        try:
            self.player.play(job, self._rig, self.why_not, picture)
            self.recorded = folder.name
        except HaselabError as error:
            is_kept = (folder / "session.h5").is_file()  # unless somebody has deleted it
            kept = f" The data recorded so far are in {folder}." if is_kept else ""
            return f"{error}{kept}"
        except OSError as error:
            return self._tripped(str(not_written(folder, error, "The recording cannot be written")))
        except Exception as error:  # of a driver, for example if STOP interrupts its call
            return self._tripped(f"A driver or an experiment failed: {described(error)}. {CHECK}")
        finally:
            over.set()
            self._busy = None
            self._rig.safety.record_with(lambda what: None)  # the recording is closed
        return f"The study has ended. Its recording is in {folder}."

    def _tripped(self, reason: str) -> str:
        self._rig.safety.trip(reason)
        return reason

    def _watch(self, over: threading.Event) -> None:
        """Trip the bench if the study must end while it computes: the last output is still on."""
        while not over.wait(_WATCH_S):
            idle = time.monotonic() > self._block_s + _COMPUTES_S
            if idle and self._rig.safety.live and (reason := self.why_not()):
                self._rig.safety.trip(reason)

    def why_not(self) -> str:
        """Say why the study must end; empty while it may go on."""
        if not self._end and self._leases.is_lost(self._page):
            time.sleep(_CATCH_UP_S)  # a long calculation may have kept the messages waiting
        if not self._end and self._leases.is_lost(self._page):
            return (
                f"No message for {self._leases.lease_s:g} s from the page that started the study."
            )
        return self._end
