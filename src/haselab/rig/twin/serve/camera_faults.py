"""Faults of the served twin's camera, its link and its exposure line, for tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.rig import Frames

__all__ = ["CameraFaults", "CameraLink", "SentFrames"]

_NANOSECONDS_HZ = 1e9
_READOUT_S = 1e-3  # from the end of an exposure to the frame's arrival
_SEED = 11


@dataclass(frozen=True)
class CameraFaults:
    """Faults of the camera; none by default.

    Args:
        lost_share: fraction of the frames that are lost at random.
        real_rate_hz: highest rate that it reaches; None: any.
        stamps_in_ticks: ticks per second of its time stamps, instead of nanoseconds; None:
            nanoseconds; 0: no time stamps.
        late_s: extra delay of the frames, in s.
        exposure_line_dead: its line shows no edges.
        exposure_line_inverted: the edge that should begin an exposure ends it.
    Raises:
        InputError: A value is out of range.
    """

    lost_share: float = 0.0
    real_rate_hz: float | None = None
    stamps_in_ticks: float | None = None
    late_s: float = 0.0
    exposure_line_dead: bool = False
    exposure_line_inverted: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.lost_share < 1.0:
            raise InputError(f"lost_share is {self.lost_share:g}, but must be in [0, 1).")
        if self.real_rate_hz is not None and not self.real_rate_hz > 0.0:
            raise InputError(f"real_rate_hz = {self.real_rate_hz:g} is not above 0.")
        if self.stamps_in_ticks is not None and not self.stamps_in_ticks >= 0.0:
            raise InputError(f"stamps_in_ticks = {self.stamps_in_ticks:g} is below 0.")
        if not self.late_s >= 0.0:
            raise InputError(f"late_s = {self.late_s:g} is below 0.")


@dataclass(frozen=True)
class SentFrames:
    """Frames that have arrived, in order.

    Args:
        images: shape `(n, height, width)`.
        time_s: middle of each exposure on the inputs' clock, in s.
        number: as the camera counts; a gap is a lost frame.
        ticks: of the camera's clock at the beginning of each exposure.
        arrival_s: on the inputs' clock, in s.
    """

    images: NDArray[np.uint8]
    time_s: NDArray[np.float64]
    number: NDArray[np.int64]
    ticks: NDArray[np.int64]
    arrival_s: NDArray[np.float64]


class CameraLink:
    """The link from the camera's sensor to the computer.

    Args:
        faults: of it.
    """

    def __init__(self, faults: CameraFaults) -> None:
        self._faults = faults
        self._random = np.random.default_rng(_SEED)
        self.start(0.0)

    def start(self, exposure_s: float) -> None:
        """Forget the frames that were under way, and count from 1 again.

        Args:
            exposure_s: of the frames to come.
        """
        self._exposure_s = exposure_s
        self._count = 0
        self._waiting: list[Frames] = []

    def real_rate_hz(self, wanted_hz: float) -> float:
        """The rate that the camera takes frames at."""
        most_hz = self._faults.real_rate_hz
        return wanted_hz if most_hz is None else min(wanted_hz, most_hz)

    def send(self, frames: Frames | None, now_s: float) -> SentFrames | None:
        """Frames that have arrived by now.

        Args:
            frames: that were exposed since the last call.
            now_s: on the inputs' clock.
        Returns:
            None: no frame has arrived.
        """
        if frames is not None:
            self._waiting.append(frames)
        if not self._waiting:
            return None
        images = np.concatenate([part.images for part in self._waiting])
        time_s = np.concatenate([part.time_s for part in self._waiting])
        arrival_s = time_s + 0.5 * self._exposure_s + _READOUT_S + self._faults.late_s
        here = int(np.searchsorted(arrival_s, now_s, side="right")) if self._faults.late_s else None
        due = slice(None, here)
        rest = Frames(images[here:], time_s[here:]) if here is not None else None
        self._waiting = [rest] if rest is not None and len(rest.time_s) else []
        return self._numbered(images[due], time_s[due], arrival_s[due])

    def _numbered(
        self,
        images: NDArray[np.uint8],
        time_s: NDArray[np.float64],
        arrival_s: NDArray[np.float64],
    ) -> SentFrames | None:
        number = self._count + 1 + np.arange(len(time_s))
        self._count += len(time_s)
        kept = self._random.random(len(time_s)) >= self._faults.lost_share
        if not kept.any():
            return None
        tick_hz = self._faults.stamps_in_ticks
        begun_s = time_s[kept] - 0.5 * self._exposure_s + 1.0  # it was switched on a second before
        ticks = np.round(begun_s * (_NANOSECONDS_HZ if tick_hz is None else tick_hz))
        return SentFrames(
            images[kept], time_s[kept], number[kept], ticks.astype(np.int64), arrival_s[kept]
        )
