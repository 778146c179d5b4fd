"""The last camera frame, with the fiducials that are found in it."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

from haselab.base import ResultError
from haselab.runtime.observer import FIDUCIALS
from haselab.tracking import detect_fiducials
from haselab.tracking.options import Floats

__all__ = ["CameraPicture", "Picture"]

_SAME_S = 1.0  # longest time between two frames that are compared


class Picture(NamedTuple):
    """The last frame of the camera.

    Args:
        jpeg: the frame.
        age_s: since it was taken.
        fiducials: `size` of the frame in px, and `points` with the position `x, y` of each fiducial
            and its position in the first frame; no points if the fiducials are not found. As JSON.
    """

    jpeg: bytes
    age_s: float
    fiducials: str


class CameraPicture:
    """Reads the last frame and finds the fiducials in it, once for all pages.

    Args:
        path: of the JPEG file that the bench process writes.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._mutex = path, threading.Lock()
        self._taken_s, self._jpeg, self._found = 0.0, b"", ""
        self._first: Floats | None = None

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
                    self._find(taken_s - self._taken_s)
                    self._taken_s = taken_s
            except OSError:
                return None
            return Picture(self._jpeg, max(time.time() - taken_s, 0.0), self._found)

    def _find(self, later_s: float) -> None:
        """Find the fiducials; the first frame after a pause is the one to compare with."""
        with Image.open(self._path) as opened:
            frame = np.asarray(opened.convert("L"))
        if later_s > _SAME_S:
            self._first = None
        try:
            points = detect_fiducials(frame, FIDUCIALS)
        except ResultError:
            points = np.empty((0, 2))
        if self._first is None and len(points):
            self._first = points
        both = np.hstack([points, points if self._first is None else self._first[: len(points)]])
        self._found = json.dumps({"size": frame.shape[::-1], "points": both.round(2).tolist()})
