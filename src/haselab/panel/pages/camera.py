"""The last camera frame, with the fiducials that are found in it."""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from haselab.base import InputError, ResultError
from haselab.runtime.observer import FIDUCIALS
from haselab.safety.interlock import lease_clock_s
from haselab.tracking import PointTracker, TrackOptions, TrackState, detect_fiducials
from haselab.tracking.options import Floats, Frame

__all__ = ["CameraPicture", "Picture"]

_PAUSE_S = 5.0  # longest time between two frames that are compared
_SEARCH_S = 2.0  # between two searches, each of which takes longer than a frame
_OPTIONS = TrackOptions(subset_px=21, search_px=40, sloped_light=True)


class Picture(NamedTuple):
    """The last frame of the camera.

    Args:
        jpeg: the frame.
        age_s: since it was taken; infinite if this is not known.
        fiducials: `size` of the frame in px, and `points` with the position `x, y` of each fiducial
            and its position in the first frame, without those that are lost. As JSON.
    """

    jpeg: bytes
    age_s: float
    fiducials: str


class CameraPicture:
    """Reads the last frame and tracks the fiducials in it, once for all pages.

    Args:
        path: of the JPEG file that the bench process writes, see `PictureFile`.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._mutex = path, threading.Lock()
        self._taken_s, self._jpeg, self._found = 0.0, b"", ""
        self._searched_s = -math.inf
        self._tracker: PointTracker | None = None
        self._state: TrackState | None = None
        self._first: Floats = np.empty((0, 2))

    def read(self) -> Picture | None:
        """Read the frame; may be called from several threads.

        Returns:
            The picture; None before the first one.
        """
        with self._mutex:
            try:
                taken_s = self._path.stat().st_mtime
                if taken_s != self._taken_s:
                    self._jpeg = self._path.read_bytes()
                    self._follow(taken_s - self._taken_s)
                    self._taken_s = taken_s
            except OSError:
                return None
            age_s = lease_clock_s() - taken_s
            return Picture(self._jpeg, age_s if age_s >= 0.0 else math.inf, self._found)

    def _follow(self, later_s: float) -> None:
        """Track the fiducials; the first frame after a pause is the one to compare with."""
        with Image.open(self._path) as opened:
            frame = np.asarray(opened.convert("L"))
        if later_s > _PAUSE_S:
            self._tracker, self._searched_s = None, -math.inf
        points, valid = np.empty((0, 2)), np.zeros(0, bool)
        if self._tracker is not None and self._state is not None:
            self._state, found = self._tracker.step(self._state, frame)
            points, valid = np.stack([found.x_px, found.y_px], axis=1), found.valid
        if not (len(valid) and valid.all()) and time.monotonic() > self._searched_s + _SEARCH_S:
            with contextlib.suppress(ResultError):  # not all of them are in view
                points = detect_fiducials(frame, FIDUCIALS)
                valid = np.ones(len(points), bool)
                self._place(frame, points)
            self._searched_s = time.monotonic()
        both = np.empty((0, 4))
        if self._tracker is not None and len(points):
            both = np.hstack([points, self._first])[valid]
        self._found = json.dumps({"size": frame.shape[::-1], "points": both.round(2).tolist()})

    def _place(self, frame: Frame, points: Floats) -> None:
        """Track from these positions on; the first ones are those to compare with."""
        if self._tracker is None or self._state is None:
            try:
                tracker = PointTracker(points, _OPTIONS)
                self._state = tracker.init([frame])
            except InputError:  # too close to the edge
                return
            self._tracker, self._first = tracker, points
        else:
            self._state = self._tracker.placed(self._state, points)
