"""Plays a study on the bench of the panel, and asks the page for what a person must do."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from haselab.base import HaselabError
from haselab.panel.pages.study_job import PageOperator, StudyJob
from haselab.rig import Camera
from haselab.rig.cameras.source import KnownCamera
from haselab.rig.protocols import Frames
from haselab.safety.guarded import GuardedRig
from haselab.safety.interlock import lease_clock_s
from haselab.study.run import run_study

__all__ = ["FilmedCamera", "PictureFile", "StudyEndedError", "StudyPlayer"]

_POLL_S = 0.1
_PICTURE_S = 0.2


class StudyEndedError(HaselabError):
    """Somebody ended a study: no fault, so the bench is not tripped."""


class PictureFile:
    """A JPEG file of the last frame, which a reader never sees half-written.

    A thread writes it, so that a picture never delays an output. Frames that arrive meanwhile are
    dropped. If the disk is full, the page keeps the previous picture. The time of the file is that
    of `lease_clock_s`.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._writer = path, ThreadPoolExecutor(1, "picture")
        self._last: Future[None] | None = None
        Image.preinit()  # otherwise the first picture loads the formats

    def save(self, frames: Frames) -> None:
        """Save the last of some frames, at least one."""
        if self._last is None or self._last.done():
            image = frames.image(len(frames.time_s) - 1)
            self._last = self._writer.submit(self._save, image, lease_clock_s())

    def _save(self, image: NDArray[np.uint8], taken_s: float) -> None:
        new = self._path.with_suffix(".new")
        with contextlib.suppress(OSError):
            Image.fromarray(image).save(new, "JPEG", quality=80)
            os.utime(new, (taken_s, taken_s))  # not the wall clock, which can be set
            new.replace(self._path)


class FilmedCamera:
    """A camera whose last frame is also kept as a JPEG file, five times a second at most.

    Args:
        camera: that takes the frames.
        picture: takes the last frame.
    """

    def __init__(self, camera: Camera, picture: PictureFile) -> None:
        self._camera, self._picture, self._next_s = camera, picture, 0.0

    @property
    def uncertainty_s(self) -> float:
        """See `haselab.rig.KnownCamera`; 0 if the camera does not know it."""
        return self._camera.uncertainty_s if isinstance(self._camera, KnownCamera) else 0.0

    @property
    def dropped(self) -> int:
        """See `haselab.rig.KnownCamera`; 0 if the camera does not know it."""
        return self._camera.dropped if isinstance(self._camera, KnownCamera) else 0

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`."""
        self._camera.start(rate_hz)

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`."""
        frames = self._camera.take()
        if frames is not None and len(frames.time_s) and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _PICTURE_S
            self._picture.save(frames)
        return frames

    def stop(self) -> None:
        """See `haselab.rig.Camera`."""
        self._camera.stop()


class StudyPlayer:
    """Plays one study after the other; it is the progress listener of each."""

    def __init__(self) -> None:
        self.note: Callable[[str], None] = lambda what: None  # takes the start of an experiment
        self._total = self._passed = 0.0
        self._confirmed = threading.Event()
        self._why_not: Callable[[], str] = lambda: ""
        self.task, self.prompt, self.step = "", "", 0
        self.operator = PageOperator(self._show, self._wait)

    @property
    def done(self) -> float:
        """Share of the study's time that has passed, 0 to 1."""
        return min(self._passed / self._total, 1.0) if self._total else 0.0

    def play(self, job: StudyJob, rig: GuardedRig, why_not: Callable[[], str],
             picture: PictureFile | None) -> None:  # fmt: skip
        """Play a study on an armed bench; the bench ends at 0 V.

        Args:
            job: the study.
            rig: the armed bench.
            why_not: says why the study must end; empty while it may go on. It is asked for each
                block.
            picture: takes the last frame; None: no pictures.
        Raises:
            HaselabError: see `run_study`; the recorded data are kept.
        """
        self._why_not, self._passed, self._total = why_not, 0.0, 0.0
        played = replace(rig)
        if picture is not None:
            played.camera = FilmedCamera(rig.camera, picture)
        try:
            job.begin()
            run_study(job.study, played, job.options, self).require_complete()
        finally:
            self.task = self.prompt = ""
            self._why_not = lambda: ""

    def require_wanted(self) -> None:
        """End the study if it must end.

        Raises:
            StudyEndedError: with the reason.
        """
        if reason := self._why_not():
            raise StudyEndedError(reason)

    def confirm(self) -> None:
        """Confirm the step that the prompt asks for."""
        self._confirmed.set()

    def _show(self, prompt: str) -> None:
        self._confirmed.clear()
        self.step += 1
        self.prompt = prompt

    def _wait(self) -> bool:
        while not self._confirmed.wait(_POLL_S):
            if self._why_not():
                return False
        self.prompt = ""
        return True

    # ---- Progress ------------------------------------------------------------------------------

    def start(self, total: float) -> None:
        """See `Progress`."""
        self._total = total

    def advance(self, amount: float, what: str) -> None:
        """See `Progress`."""
        self._passed += amount
        if what != self.task:
            self.task = what
            self.note(what)
        self.require_wanted()

    def stop(self) -> None:
        """See `Progress`."""
