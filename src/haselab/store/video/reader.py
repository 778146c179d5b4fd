"""The interface of video readers: grey frames one by one, with their times."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, InputError

__all__ = [
    "COLOUR_RULE",
    "MOST_PIXELS",
    "Frame",
    "VideoReader",
    "alike",
    "broken",
    "luma_of_colour",
]

Frame = NDArray[np.uint8] | NDArray[np.uint16]

MOST_PIXELS = 1 << 27  # of one frame, colours counted: more than any camera in use has
COLOUR_RULE = "colour as luma, 0.299 R + 0.587 G + 0.114 B"
_BT601 = (19595, 38470, 7471)  # sums to 2^16, so grey comes back as it was


def broken(what: str, todo: str, path: Path) -> InputError:
    """Make the error for a file that cannot be read."""
    return InputError(f"{what}. {todo} {path}")


def luma_of_colour(image: NDArray[Any]) -> Frame:
    """Full-range luma of R, G, B, rounded; where all three are equal it is their value.

    Args:
        image: 8 or 16 bit colour, an alpha channel is left out. Shape `(H, W, 3 or more)`.

    Returns:
        Grey levels of the same type. Shape `(H, W)`.

    Source: ITU-R BT.601.

    Example:
        >>> luma_of_colour(np.array([[[255, 0, 0], [7, 7, 7]]], np.uint8))
        array([[76,  7]], dtype=uint8)
    """
    total = np.full(image.shape[:2], 1 << 15, np.uint32)
    for channel, weight in enumerate(_BT601):
        total += image[:, :, channel] * np.uint32(weight)
    total >>= np.uint32(16)
    return total.astype(np.uint8) if image.dtype == np.uint8 else total.astype(np.uint16)


def alike(items: Iterator[tuple[float, Frame]], path: Path) -> Iterator[tuple[float, Frame]]:
    """Yield times and frames, and check that their size and depth do not change.

    Raises:
        InputError: a frame differs from the first; raised after the frames before it.
    """
    first: Frame | None = None
    for index, (time_s, frame) in enumerate(items):
        if first is None:
            first = frame
        if frame.shape != first.shape or frame.dtype != first.dtype:
            raise broken(
                f"Frame {index} has {_size(frame)}, frame 0 has {_size(first)}",
                "All frames of a video must be alike. Split the video there.",
                path,
            )
        yield time_s, frame


def _size(frame: Frame) -> str:
    return f"{frame.shape[1]} x {frame.shape[0]} px of {8 * frame.itemsize} bit"


class VideoReader(Closing, ABC):
    """Frames `(H, W)`, uint8 or uint16, in order; a few in memory at a time.

    Iterating starts at the first frame each time. Also a context manager. Frames are for reading
    only: some are views of the decoder's memory.

    Args:
        path: of the file or folder.
        rate_hz: frames per second of recorded time; `None`: unknown.
        lossy: whether compression has changed grey levels; `None`: unknown.
        bit_depth: significant bits of a pixel (the values are as stored, never rescaled).
        codec: name of the compression, as FFmpeg calls it.
        levels: description of the grey levels.
    """

    def __init__(
        self,
        path: Path,
        *,
        rate_hz: float | None,
        lossy: bool | None,
        bit_depth: int,
        codec: str = "rawvideo",
        levels: str = "grey as stored",
    ) -> None:
        self.path = path
        self.rate_hz = rate_hz
        self.lossy = lossy
        self.bit_depth = bit_depth
        self.codec = codec
        self.levels = levels

    @property
    @abstractmethod
    def frame_count(self) -> int:
        """Number of frames."""

    @property
    def frames_expected(self) -> int:
        """Approximate number of frames, without reading them; 0 if unknown."""
        return self.frame_count

    def number(self, index: int) -> int:
        """Index of a frame in the recording; the same as in the file if none is missing."""
        return index

    @property
    def missing(self) -> tuple[int, ...]:
        """Indices in the recording of frames that are missing in the file."""
        return ()

    @abstractmethod
    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s from the first frame (NaN when unknown), and the frame."""

    def __iter__(self) -> Iterator[Frame]:
        for _, frame in self.timed():
            yield frame

    def frame(self, index: int) -> tuple[float, Frame]:
        """One frame, without those before it where the format permits that.

        Args:
            index: of the frame in the file, from 0.

        Returns:
            Time in s from the first frame (NaN when unknown), and the frame.

        Raises:
            InputError: there is no such frame, or it cannot be read.
        """
        if not 0 <= index < self.frame_count:
            raise broken(
                f"Frame {index} does not exist: the video has {self.frame_count} frames, numbered "
                "from 0",
                "Use another one.",
                self.path,
            )
        return self._at(index)

    def _at(self, index: int) -> tuple[float, Frame]:
        """A frame that should exist; read after all before it."""
        for found in islice(self.timed(), index, None):
            return found
        raise broken(f"The video ends before frame {index}", "Copy it again.", self.path)

    def time_s(self, index: int) -> float:
        """Time of a frame at the constant rate, in s; NaN when the rate is not known."""
        return self.number(index) / self.rate_hz if self.rate_hz else float("nan")

    def close(self) -> None:
        """Close the file; does nothing for readers that keep none open between frames."""
        return
