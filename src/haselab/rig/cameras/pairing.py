"""Assign recorded exposures to frames that the computer timed."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError

__all__ = [
    "ExposureLog",
    "ExposureTrial",
    "FramePairing",
    "starts_with_edge",
]

_EARLY_SHARE = 0.25  # fraction of a period by which a frame may seem to precede its exposure
_FOLLOW = 0.1  # fraction of a deviation by which the lag is updated


class ExposureLog:
    """Exposures that the acquisition has recorded, for a camera to read.

    Args:
        uncertainty_s: uncertainty of the middle of an exposure (half width), in s.
    """

    def __init__(self, uncertainty_s: float) -> None:
        self.uncertainty_s = uncertainty_s
        self.middle_s: deque[float] = deque()
        self.settled_s = -np.inf

    def add(self, middle_s: NDArray[np.float64], settled_s: float) -> None:
        """Add exposures.

        Args:
            middle_s: their middles on the acquisition's clock, rising. Shape `(exposures,)`.
            settled_s: time before which no further exposure will be added, in s.
        """
        self.middle_s.extend(middle_s.tolist())
        self.settled_s = settled_s

    def forget(self) -> None:
        """Discard earlier exposures, because the camera starts."""
        self.middle_s.clear()


class FramePairing:
    """Assigns each frame its exposure.

    The first frame belongs to the last exposure before it: a camera that keeps up delays frames by
    less than a period. From then on a frame belongs to the exposure nearest to its own time minus
    that lag; a skipped exposure is a lost frame.

    Args:
        log: of the exposures.
        period_s: of the frames.
    """

    def __init__(self, log: ExposureLog, period_s: float) -> None:
        self._log = log
        self._period_s = period_s
        self._lag_s: float | None = None
        self.lost = 0
        self.matched = 0
        log.forget()

    @property
    def lag_s(self) -> float:
        """Mean delay from an exposure's middle to its estimate from the frame, in s; or NaN."""
        return math.nan if self._lag_s is None else self._lag_s

    def match(self, frame_s: float) -> float | None:
        """Return the middle of a frame's exposure.

        Args:
            frame_s: time of the frame by the computer's clock, in s; rising.
        Returns:
            The time in s, or None if the exposure may not have been recorded yet.
        Raises:
            DeviceError: A frame has no exposure.
        """
        if self._lag_s is None:
            low_s, high_s = frame_s - (1.0 - _EARLY_SHARE) * self._period_s, frame_s
            high_s += _EARLY_SHARE * self._period_s
        else:
            low_s = frame_s - self._lag_s - 0.5 * self._period_s
            high_s = low_s + self._period_s
        if self._log.settled_s < high_s:
            return None
        queue = self._log.middle_s
        candidates = [m for m in queue if low_s <= m < high_s]
        if not candidates:
            raise DeviceError(
                f"A frame at {frame_s:.3f} s has no exposure in the recorded signal between "
                f"{low_s:.3f} and {high_s:.3f} s. Check the wire of the exposure signal and its "
                "levels, and the frame rate."
            )
        wanted_s = high_s if self._lag_s is None else frame_s - self._lag_s
        found_s = min(candidates, key=lambda m: abs(m - wanted_s))
        passed = 0
        while queue[0] < found_s:
            queue.popleft()
            passed += 1
        queue.popleft()
        if self._lag_s is None:
            self._lag_s = frame_s - found_s
        else:
            self.lost += passed
            self._lag_s += _FOLLOW * (frame_s - found_s - self._lag_s)
        self.matched += 1
        return found_s


@dataclass(frozen=True)
class ExposureTrial:
    """A measurement with one exposure time, for `starts_with_edge`.

    Args:
        exposure_s: exposure time of the camera and of section `exposure`, in s.
        lag_s: delay from the exposures' middles to their estimates from the frames, in s.
    """

    exposure_s: float
    lag_s: float


def starts_with_edge(
    short: ExposureTrial, long: ExposureTrial, uncertainty_s: float
) -> bool | None:
    r"""Whether the recorded edge begins an exposure, from two exposure times.

    A frame arrives a fixed time after the end of its exposure. If the beginning is recorded, the
    lag $\lambda$ does not depend on the exposure time $e$; if the end is recorded, each exposure
    seems to be $e$ later than it was, so $\lambda_2 - \lambda_1 = -(e_2 - e_1)$. A delay common to
    blocks and frames cancels in the difference.

    Args:
        short: frames with a short exposure.
        long: frames with a longer one.
        uncertainty_s: of each lag, in s.
    Returns:
        True: it begins with the edge; False: it ends; None: the exposures differ too little.
    Example:
        >>> starts_with_edge(ExposureTrial(1e-3, 4e-3), ExposureTrial(6e-3, -1e-3), 5e-4)
        False
    """
    longer_s = long.exposure_s - short.exposure_s
    if not longer_s > 4.0 * uncertainty_s:
        return None
    return long.lag_s - short.lag_s > -0.5 * longer_s
