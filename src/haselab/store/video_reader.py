"""What every video reader offers: grey frames one by one, with their times."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["Frame", "VideoReader", "broken"]

Frame = NDArray[np.uint8] | NDArray[np.uint16]


def broken(what: str, todo: str, path: Path) -> InputError:
    """The error of a file that cannot be read."""
    return InputError(f"{what}. {todo} {path}")


class VideoReader(ABC):
    """Frames `(H, W)`, uint8 or uint16, in order; one in memory at a time.

    Iterating starts at the first frame each time. Also a context manager.

    Args:
        path: of the file or folder.
        rate_hz: frames per second of recorded time, `None` when the file does not say.
        lossy: whether compression may have changed grey levels.
        bit_depth: significant bits of a pixel (the values are as stored, never rescaled).
    """

    def __init__(self, path: Path, *, rate_hz: float | None, lossy: bool, bit_depth: int) -> None:
        self.path = path
        self.rate_hz = rate_hz
        self.lossy = lossy
        self.bit_depth = bit_depth

    @property
    @abstractmethod
    def frame_count(self) -> int:
        """Number of frames."""

    @abstractmethod
    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s from the first frame (NaN when unknown), and the frame."""

    def __iter__(self) -> Iterator[Frame]:
        for _, frame in self.timed():
            yield frame

    def time_s(self, index: int) -> float:
        """Time of a frame at the constant rate, in s; NaN when the rate is not known."""
        return index / self.rate_hz if self.rate_hz else float("nan")

    def close(self) -> None:
        """Give the file back; a no-op for readers that hold none open between frames."""
        return

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
