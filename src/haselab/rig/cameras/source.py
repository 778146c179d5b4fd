"""Protocols of a camera driver, whose images are timed on the computer's clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BlockClock",
    "ExplainsLosses",
    "ExposureLine",
    "FrameSource",
    "KnownCamera",
    "ReportsRemarks",
    "Shot",
]

BlockClock = Callable[[], tuple[float, float]]
"""End of the acquisition's last block on its own clock, and when it was seen on the clock of
`time.monotonic`; both in s."""


@dataclass(frozen=True)
class Shot:
    """One image.

    Args:
        image: grey levels, shape `(height, width)`; owned by the caller.
        host_s: middle of the exposure as the driver estimates it, on `time.monotonic`'s clock.
        steady_s: its time on the steadiest available clock, for the frame rate; NaN: `host_s`.
    """

    image: NDArray[np.uint8]
    host_s: float
    steady_s: float = math.nan


@dataclass(frozen=True)
class ExposureLine:
    """The camera's output line that signals its exposures.

    Args:
        duration_s: duration of an exposure that the acquisition assumes.
        line: its name in the camera; None: it was set by hand.
        inverted: LineInverter; None: unchanged.
    """

    duration_s: float
    line: str | None = None
    inverted: bool | None = None


@runtime_checkable
class KnownCamera(Protocol):
    """A camera that reports its identity, its lost frames and its timing uncertainty."""

    @property
    def identity(self) -> str:
        """Identification of the camera; empty if there is none."""

    @property
    def dropped(self) -> int:
        """Number of frames lost since the last start."""

    @property
    def uncertainty_s(self) -> float:
        """Uncertainty of a frame's time (half width), in s."""


@runtime_checkable
class ReportsRemarks(Protocol):
    """A camera that reports possible problems with its frames."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Problems found since the last start and what to do, one line each."""


@runtime_checkable
class ExplainsLosses(Protocol):
    """A driver that can explain late or lost frames."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `ReportsRemarks`."""

    def why_slow(self, rate_hz: float) -> str:
        """What to change to reach this frame rate, in sentences."""

    def why_lost(self) -> str:
        """Where frames were lost and what to change, in sentences; empty: unknown."""


class FrameSource(Protocol):
    """A camera driver. Only one thread calls it at a time."""

    @property
    def identity(self) -> str:
        """Identification of the camera."""

    @property
    def dropped(self) -> int:
        """Number of images that were taken but lost, since the last start."""

    @property
    def jitter_s(self) -> float:
        """Scatter of `Shot.host_s` from image to image, in s."""

    def start(self, rate_hz: float) -> None:
        """Start taking images.

        Raises:
            LimitError: The camera does not have this rate.
            DeviceError: The camera does not start.
        """

    def take(self) -> list[Shot]:
        """Return the images that have arrived since the last call, without waiting.

        Raises:
            DeviceError: The camera no longer responds.
        """

    def stop(self) -> None:
        """Stop taking images. Never raises."""

    def close(self) -> None:
        """Close the camera. Never raises."""
