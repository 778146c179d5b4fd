"""Time a driver's images on the acquisition's clock."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from haselab.base import DeviceError
from haselab.rig import Frames
from haselab.rig.cameras.clocks import ClockOffset, SlowOffset
from haselab.rig.cameras.frame_rate import FrameRateMeter
from haselab.rig.cameras.pairing import ExposureLog, FramePairing
from haselab.rig.cameras.source import BlockClock, ExplainsLosses, FrameSource, Shot

__all__ = ["TimedCamera", "Timing"]

_HANG_S = 5.0  # longest wait for another thread in the driver
_RATE_SHARE = 0.06  # largest relative difference of measured and requested frame rate
_FEW = 50  # frames needed for a meaningful fraction of lost ones


@dataclass(frozen=True)
class Timing:
    """Timing settings of a camera.

    Args:
        timeout_s: longest time without a frame.
        latency_s: error of `Shot.host_s`; None if it was not measured.
        buffer_s: how long frames may wait for the block that they belong to.
        most_dropped: fraction of lost frames above which `take` raises.
    """

    timeout_s: float = 2.0
    latency_s: float | None = None
    buffer_s: float = 2.0
    most_dropped: float = 0.1


class TimedCamera:
    """A camera whose frames the computer times; implements `haselab.rig.Camera`.

    A block is seen when it has ended, a frame when it has arrived; the ones with the least delay
    give the offset of the clocks. Frames are returned when the block of their time has been read.
    Any thread may call it.

    Args:
        source: the driver.
        clock: the acquisition's.
        timing: timing settings of the camera.
        now: the clock of `Shot.host_s`.
        exposures: log of the camera's exposure signal; if given, it times the frames.
    """

    def __init__(
        self,
        source: FrameSource,
        clock: BlockClock,
        timing: Timing,
        now: Callable[[], float] = time.monotonic,
        exposures: ExposureLog | None = None,
    ) -> None:
        self._source = source
        self._clock = clock
        self._timing = timing
        self._now = now
        self._exposures = exposures
        self._pairing: FramePairing | None = None
        self._lock = threading.RLock()
        self._host = ClockOffset()  # from acquisition to computer
        self._slow = SlowOffset()
        self._waiting: deque[Shot] = deque()
        self._rate_hz = 0.0  # 0: stopped
        self._period_s = 0.0  # at the last start
        self._block_s = -np.inf  # end of the last block that was seen
        self._last_s = 0.0  # time of the last frame on the acquisition's clock
        self._silent_s = 0.0  # time in which frames were requested but none arrived
        self._asked_s = 0.0  # time of the last request
        self._count = 0
        self._meter = FrameRateMeter()

    @property
    def identity(self) -> str:
        """Identification of the camera."""
        return self._source.identity

    @property
    def dropped(self) -> int:
        """Number of frames lost since the last start."""
        with self._lock:
            return max(self._source.dropped, self._pairing.lost if self._pairing else 0)

    @property
    def rate_hz(self) -> float:
        """Frames per second, measured by the camera's own clock; 0 before enough have arrived."""
        with self._lock:
            return self._meter.rate_hz

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `RemarkingCamera`."""
        with self._lock:
            return self._source.remarks if isinstance(self._source, ExplainsLosses) else ()

    @property
    def lag_s(self) -> float:
        """Delay from an exposure's recorded middle to its estimate from the frame, in s.

        NaN without an exposure line, or before the first frame. See `starts_with_edge`.
        """
        with self._lock:
            return math.nan if self._pairing is None else self._pairing.lag_s

    @property
    def uncertainty_s(self) -> float:
        """Uncertainty of a frame's time (half width), in s.

        With an exposure signal it is that of its edges. Otherwise it is the scatter of both clocks'
        readings, plus one frame period if the latency was not measured, since a camera that keeps
        up delays frames by less than that.
        """
        if self._exposures is not None:
            return self._exposures.uncertainty_s
        scatter_s = self._host.spread_s + self._source.jitter_s
        return scatter_s + (self._period_s if self._timing.latency_s is None else 0.0)

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`.

        Raises:
            LimitError: The camera does not have this rate.
            DeviceError: The camera does not start.
        """
        with self._lock:
            self.stop()
            self._read_clock()
            if self._exposures is not None:
                self._pairing = FramePairing(self._exposures, 1.0 / max(rate_hz, 1e-9))
            self._source.start(rate_hz)
            self._rate_hz, self._period_s = rate_hz, 1.0 / rate_hz
            self._slow = SlowOffset()
            self._last_s = -np.inf
            self._silent_s, self._asked_s = 0.0, self._now()
            self._count = 0
            self._meter = FrameRateMeter()

    def stop(self) -> None:
        """See `haselab.rig.Camera`. Never raises; a driver that hangs is not stopped."""
        if self._lock.acquire(timeout=_HANG_S):
            try:
                self._rate_hz = 0.0
                self._waiting.clear()
                self._source.stop()
            finally:
                self._lock.release()

    def close(self) -> None:
        """Close the camera. Never raises; a driver that hangs is not closed."""
        if self._lock.acquire(timeout=_HANG_S):
            try:
                self.stop()
                self._source.close()
            finally:
                self._lock.release()

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`.

        Raises:
            DeviceError: The camera does not respond, or loses too many frames, or the blocks that
                its frames belong to are not read.
        """
        with self._lock:
            if self._rate_hz == 0.0:
                return None
            self._read_clock()
            shots = self._source.take()
            self._count += len(shots)
            self._waiting.extend(shots)
            self._measure(shots)
            self._check_silence(bool(shots))
            self._check_counts()
            return self._due()

    def _read_clock(self) -> None:
        block_s, seen_s = self._clock()
        if block_s > self._block_s:
            self._host.add(block_s, seen_s)
            self._block_s = block_s

    def _measure(self, shots: list[Shot]) -> None:
        for shot in shots:
            self._meter.add(shot.host_s if math.isnan(shot.steady_s) else shot.steady_s)
        got_hz = self._meter.rate_hz
        if got_hz == 0.0 or abs(got_hz / self._rate_hz - 1.0) <= _RATE_SHARE:
            return
        advice = "Shorten the exposure, or request another rate."
        if isinstance(self._source, ExplainsLosses):
            advice = self._source.why_slow(self._rate_hz)
        raise DeviceError(
            f"Camera {self.identity}: frames arrive at {got_hz:.4g} Hz instead of the requested "
            f"{self._rate_hz:g} Hz. {advice}"
        )

    def _check_silence(self, came: bool) -> None:
        """Raise if no frame has come for too long; a pause of the program counts only a quarter."""
        limit_s = max(self._timing.timeout_s, 3.0 / self._rate_hz)
        now_s = self._now()
        self._silent_s += min(now_s - self._asked_s, 0.25 * limit_s)
        self._asked_s = now_s
        if came:
            self._silent_s = 0.0
        if self._silent_s > limit_s:
            raise DeviceError(
                f"Camera {self.identity}: no frame for {self._silent_s:.3g} s. Check its cable and "
                "its trigger, or raise camera.timeout_s."
            )

    def _check_counts(self) -> None:
        timing = self._timing
        lost, all_ = self.dropped, self._count + self.dropped
        if lost > timing.most_dropped * max(all_, _FEW):
            why = self._source.why_lost() if isinstance(self._source, ExplainsLosses) else ""
            advice = why or (
                "Lower the frame rate or the image size, or raise camera.most_dropped."
            )
            raise DeviceError(
                f"Camera {self.identity}: {lost} of {all_} frames are lost (limit: a fraction of "
                f"{timing.most_dropped:g}). {advice}"
            )
        if len(self._waiting) > timing.buffer_s * self._rate_hz + _FEW:
            raise DeviceError(
                f"Camera {self.identity}: {len(self._waiting)} frames are waiting for blocks that "
                "have not been read. Read the acquisition while the camera is on, or raise "
                "camera.buffer_s."
            )

    def _due(self) -> Frames | None:
        """Collect the frames of the blocks that have been read."""
        images, times_s = [], []
        while self._waiting:
            time_s = self._time(self._waiting[0])
            if time_s is None:
                break
            if time_s <= self._last_s:
                raise DeviceError(
                    f"Camera {self.identity}: a frame is {self._last_s - time_s:.3g} s earlier "
                    "than the frame before it. Set the camera's clock, or restart the camera."
                )
            self._last_s = time_s
            images.append(self._waiting.popleft().image)
            times_s.append(time_s)
        return Frames(np.stack(images), np.array(times_s)) if images else None

    def _time(self, shot: Shot) -> float | None:
        """Time on the acquisition's clock; None if that has not advanced so far."""
        host_s = shot.host_s - (self._timing.latency_s or 0.0)
        time_s = host_s + self._slow.step(host_s, -self._host.at(self._block_s))
        if self._pairing is not None:
            return self._pairing.match(time_s)
        return time_s if time_s <= self._block_s else None
