"""What a camera's driver gives: pictures on the computer's clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BlockClock",
    "ExposureLine",
    "FrameSource",
    "KnownCamera",
    "KnowsCauses",
    "RemarkingCamera",
    "Shot",
]

BlockClock = Callable[[], tuple[float, float]]
"""End of the acquisition's last block on its own clock, and when it was seen on `time.monotonic`'s;
both in s."""


@dataclass(frozen=True)
class Shot:
    """One picture.

    Args:
        image: grey levels, shape `(height, width)`; belongs to the taker.
        host_s: middle of the exposure as far as the driver knows it, on `time.monotonic`'s clock.
        steady_s: its time on the steadiest clock that there is, to measure the frame rate by; NaN:
            `host_s` is that.
    """

    image: NDArray[np.uint8]
    host_s: float
    steady_s: float = math.nan


@dataclass(frozen=True)
class ExposureLine:
    """The camera's output that says when it exposes.

    Args:
        duration_s: of an exposure, as the acquisition takes it for granted.
        line: its name in the camera; None: it was set by hand.
        inverted: None: as the camera is.
    """

    duration_s: float
    line: str | None = None
    inverted: bool | None = None


@runtime_checkable
class KnownCamera(Protocol):
    """A camera that says what it is, what it lost, and how well it knows the time."""

    @property
    def identity(self) -> str:
        """What it says it is; empty where there is none."""

    @property
    def dropped(self) -> int:
        """Frames that are lost, since the last start."""

    @property
    def uncertainty_s(self) -> float:
        """Half width of what a frame's time is known to, in s."""


@runtime_checkable
class RemarkingCamera(Protocol):
    """A camera that says what may go wrong with its frames."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """One line each: what was found since the last start, and what to do."""


@runtime_checkable
class KnowsCauses(Protocol):
    """A driver that knows why frames are late or lost."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `RemarkingCamera`."""

    def why_slow(self, rate_hz: float) -> str:
        """What to change so that frames come at this rate, in sentences."""

    def why_lost(self) -> str:
        """Where frames were lost and what to change, in sentences; empty: it does not know."""


class FrameSource(Protocol):
    """A driver. One thread at a time calls it."""

    @property
    def identity(self) -> str:
        """What the camera says it is."""

    @property
    def dropped(self) -> int:
        """Pictures that were taken and are lost, since the last start."""

    @property
    def jitter_s(self) -> float:
        """By how much `Shot.host_s` varies from one picture to another, in s."""

    def start(self, rate_hz: float) -> None:
        """Take pictures from now on.

        Raises:
            LimitError: no such rate.
            DeviceError: the camera does not start.
        """

    def take(self) -> list[Shot]:
        """The pictures that have come in since the last call; does not wait.

        Raises:
            DeviceError: the camera is gone.
        """

    def stop(self) -> None:
        """Take no more pictures. Never raises."""

    def close(self) -> None:
        """Let go of the camera. Never raises."""
