"""Tracks drawn on frames while a clip is tracked: a video, or a contact sheet."""

from __future__ import annotations

from collections import deque
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.claim import not_written
from haselab.store.video.grey_range import grey_range
from haselab.tracking import FrameTracks
from haselab.tracking.options import Floats, Frame

__all__ = ["Overlay", "overlay_to"]

_MOST_VIDEO_FRAMES = 1500
_PLAY_HZ = 30
_TRAIL = 24
_FOUND, _TRAILED = (90, 220, 90), (40, 130, 230)


class Overlay(Protocol):
    """Draws while a clip is tracked."""

    def look(self, index: int, frame: Frame, found: FrameTracks) -> None:
        """One frame with its points."""

    def close(self) -> None:
        """Finish the file."""


def overlay_to(path: Path | None, frame_count: int) -> Overlay:
    """The overlay for a file's name: video for .mp4 and .mkv, a contact sheet for .png.

    Raises:
        InputError: another name.
    """
    if path is None:
        return _Nothing()
    if path.suffix.lower() == ".png":
        # DrawnFigure takes a third of a second to load, which most calls do not need.
        from haselab.cli.data.contact_sheet import ContactSheet

        return ContactSheet(path, frame_count)
    if path.suffix.lower() in (".mp4", ".mkv", ".mov"):
        return _Video(path, frame_count)
    raise InputError(
        f"--overlay ends in {path.suffix!r}. Use .mp4, .mkv or .mov for a video, or .png "
        f"for a contact sheet. {path}"
    )


class _Nothing:
    def look(self, index: int, frame: Frame, found: FrameTracks) -> None:
        """Ignore."""

    def close(self) -> None:
        """Ignore."""


class _Video:
    """H.264 for looking at: every frame, or every so many of a long clip, with short trails."""

    def __init__(self, path: Path, frame_count: int) -> None:
        self._path = path
        self._stride = -(-max(frame_count, 1) // _MOST_VIDEO_FRAMES)
        self._container: av.container.OutputContainer | None = None
        self._trail: deque[tuple[Floats, Floats]] = deque(maxlen=_TRAIL)
        self._levels = (0.0, 255.0)

    def _open(self, frame: Frame) -> None:
        self._levels = grey_range(frame)
        height, width = (size - size % 2 for size in frame.shape)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._path), "w")
        except OSError as error:
            raise not_written(self._path, error, "The overlay cannot be written") from None
        codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
        stream = self._container.add_stream(codec, rate=Fraction(_PLAY_HZ))
        assert isinstance(stream, av.VideoStream)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.options = {"crf": "20", "preset": "veryfast"} if codec == "libx264" else {}
        self._stream = stream

    def look(self, index: int, frame: Frame, found: FrameTracks) -> None:
        if index % self._stride:
            return
        if self._container is None:
            self._open(frame)
        low, high = self._levels
        grey = np.clip((frame - low) * (255.0 / (high - low)), 0, 255).astype(np.uint8)
        image = np.repeat(grey[:, :, None], 3, axis=2)
        for x, y in self._trail:
            _dot(image, x, y, 0, _TRAILED)
        _dot(image, found.x_px, found.y_px, 1, _FOUND)
        self._trail.append((found.x_px, found.y_px))
        height, width = self._stream.height, self._stream.width
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]))
        assert self._container is not None
        self._container.mux(self._stream.encode(picture))

    def close(self) -> None:
        if self._container is not None:
            self._container.mux(self._stream.encode())
            self._container.close()


def _dot(
    image: NDArray[np.uint8], x_px: Floats, y_px: Floats, reach: int, colour: tuple[int, int, int]
) -> None:
    """Squares of 2 reach + 1 px about the points that are there."""
    there = np.isfinite(x_px) & np.isfinite(y_px)
    x, y = np.rint(x_px[there]).astype(int), np.rint(y_px[there]).astype(int)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            row, column = y + dy, x + dx
            inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
            image[row[inside], column[inside]] = colour
