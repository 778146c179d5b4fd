"""Estimate a frame's time on the computer's clock from its time stamp and its arrival."""

from __future__ import annotations

from collections import deque

import numpy as np

from haselab.base import DeviceError
from haselab.rig.cameras.clocks import ClockOffset, SlowOffset
from haselab.rig.cameras.frame_rate import FrameRateMeter

__all__ = ["StampedClock"]

_NANOSECONDS_HZ = 1e9
_FEW, _MANY = 8, 64  # frames from which the rate of the stamps is determined
_SURE_S = 0.5  # duration of frames before stamps are rejected
_REGULAR = 0.2  # largest relative scatter of the arrival intervals for that
_SAME_CLOCK = (0.8, 1.25)  # ratio of the intervals that jitter of the arrivals cannot exceed


class StampedClock:
    """Times of frames on `time.monotonic`'s clock.

    The camera's stamps remove the scatter of the arrival times. The stamps are checked: they must
    rise, at the rate of the computer's clock. Stamps that are 0 or equal to the arrivals mean that
    the camera has no clock; then only the arrivals are used.

    Args:
        tick_hz: of the stamps' clock; None: they are nanoseconds.
        use_stamps: False: use only the arrivals.
    """

    def __init__(self, tick_hz: float | None = None, *, use_stamps: bool = True) -> None:
        self._tick_hz = tick_hz or _NANOSECONDS_HZ
        self._use_stamps = use_stamps
        self._arrival, self._slow = ClockOffset(), SlowOffset()
        self._arrivals = FrameRateMeter()
        self._pairs: deque[tuple[float, float]] = deque(maxlen=_MANY)
        self._first = (0.0, 0.0)
        self._base_s = 0.0
        self._trusted = False
        self._last_s: float | None = None
        self.stamped = False

    @property
    def jitter_s(self) -> float:
        """Scatter of a frame's time, in s."""
        return self._arrival.spread_s if self.stamped else self._arrivals.scatter_s

    @property
    def has_no_clock(self) -> bool:
        """Whether frames have arrived without a time stamp of the camera."""
        return self._use_stamps and self._arrivals.known and not self.stamped

    def host_s(self, ticks: int, arrived_s: float, *, same: bool = False) -> tuple[float, float]:
        """Compute the time of one frame.

        Args:
            ticks: of its stamp.
            arrived_s: arrival of its first packet, in s.
            same: whether the stamp is the arrival time itself.
        Returns:
            Its arrival on the computer's clock with the scatter removed, and its time on the
            steadier of both clocks, to measure a rate; in s.
        Raises:
            DeviceError: The stamps do not rise, or do not fit the rig file.
        """
        self._arrivals.add(arrived_s)
        if ticks <= 0 or same or not self._use_stamps:
            return arrived_s, arrived_s
        stamp_s = ticks / self._tick_hz
        if self._last_s is not None and stamp_s <= self._last_s:
            raise DeviceError(
                f"its time stamps do not rise: {stamp_s:g} s follows {self._last_s:g} s. Restart "
                'the camera, or set camera.stamps = "arrival" to use its frames\' '
                "arrival."
            )
        if not self.stamped:
            self._first = stamp_s, arrived_s
        self._last_s, self.stamped = stamp_s, True
        self._pairs.append((stamp_s, arrived_s))
        self._arrival.add(stamp_s, arrived_s)
        wanted_s = self._arrival.at(stamp_s)
        if not self._trusted:
            # Use the arrivals until the stamps are known to be seconds, then change over smoothly.
            wanted_s = arrived_s - stamp_s
            self._trusted = self._keeps_time()
            if not self._trusted:
                return arrived_s, arrived_s
            self._base_s = wanted_s
        return stamp_s + self._slow.step(stamp_s, wanted_s), stamp_s + self._base_s

    def _keeps_time(self) -> bool:
        """Check that the stamps are seconds, by the medians of the intervals.

        Lost frames do not change the medians. Frames that arrive together after a stall of the
        computer do, but they do not change the total time in the same ratio.

        Returns:
            False if it is not known yet.
        Raises:
            DeviceError: They are not.
        """
        if len(self._pairs) < _FEW:
            return False
        steps_s = np.diff(np.array(self._pairs), axis=0)
        stamps_s, arrivals_s = np.median(steps_s, axis=0)
        if np.median(np.abs(steps_s[:, 1] - arrivals_s)) > _REGULAR * arrivals_s:
            return False
        ratio = float(stamps_s / arrivals_s)
        if _SAME_CLOCK[0] < ratio < _SAME_CLOCK[1]:
            return True
        (first_s, came_s), (last_s, went_s) = self._first, self._pairs[-1]
        if went_s - came_s < _SURE_S:
            return False
        whole = (last_s - first_s) / (went_s - came_s)
        if _SAME_CLOCK[0] < whole / ratio < _SAME_CLOCK[1]:
            raise DeviceError(
                f"its time stamps run at {ratio:.3g} of the computer's clock, so they are ticks of "
                f"about {self._tick_hz * ratio:.4g} Hz. Set camera.tick_hz to that "
                "(GevTimestampTickFrequency, or the camera's manual, has the exact number), or "
                'camera.stamps = "arrival".'
            )
        return False
