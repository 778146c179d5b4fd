"""Driver of the served twin's camera: late, numbered frames with time stamps."""

from __future__ import annotations

from collections.abc import Callable

from haselab.base import DeviceError
from haselab.rig.cameras.config import TwinCameraConfig
from haselab.rig.cameras.opened import OpenedCamera, opened_timed
from haselab.rig.cameras.source import BlockClock, Shot
from haselab.rig.cameras.stamps import StampedClock
from haselab.rig.cameras.timed import TimedCamera, Timing
from haselab.rig.drivers import quietly
from haselab.rig.instruments.instrument import CameraContext, CameraInstrument
from haselab.rig.twin.client import SentFrame, TwinClient

__all__ = ["TwinCameraInstrument", "TwinSource"]


class TwinSource:
    """The camera of a served twin on the acquisition's clock; implements `FrameSource`.

    Args:
        config: section `camera` of the rig file.
    Raises:
        DeviceError: The twin does not reply.
    """

    def __init__(self, config: TwinCameraConfig) -> None:
        self._config = config
        self._client = TwinClient(config.address)
        self.identity = f"twin at {config.address}"
        self._restart()

    def _restart(self) -> None:
        config = self._config
        self._clock = StampedClock(config.tick_hz, use_stamps=config.stamps == "camera")
        self._lost = 0
        self._last = 0

    @property
    def dropped(self) -> int:
        """See `FrameSource`: gaps in the frame numbers."""
        return self._lost

    @property
    def jitter_s(self) -> float:
        """See `FrameSource`."""
        return self._clock.jitter_s

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `RemarkingCamera`."""
        if not self._clock.has_no_clock:
            return ()
        return ("The camera sends no time stamps, so its frames are timed by their arrival.",)

    def why_slow(self, rate_hz: float) -> str:
        """See `KnowsCauses`."""
        return "Shorten camera.exposure_s, or lower camera.height_px."

    def why_lost(self) -> str:
        """See `KnowsCauses`."""
        return f"{self._lost} frames were lost. Check the network (haselab doctor)."

    def start(self, rate_hz: float) -> None:
        """See `FrameSource`."""
        self._client.start(rate_hz, self._config.exposure_s or 0.0)
        self._restart()

    def take(self) -> list[Shot]:
        """See `FrameSource`."""
        return [self._shot(frame) for frame in self._client.take_sent()]

    def _shot(self, frame: SentFrame) -> Shot:
        self._lost += frame.number - self._last - 1
        self._last = frame.number
        try:
            host_s, steady_s = self._clock.host_s(frame.ticks, frame.arrival_s)
        except DeviceError as error:
            raise DeviceError(f"Camera {self.identity}: {error}") from None
        return Shot(frame.image, host_s - 0.5 * frame.exposure_s, steady_s)

    def stop(self) -> None:
        """See `FrameSource`. Never raises."""
        quietly(self._client.stop)

    def close(self) -> None:
        """See `FrameSource`. Never raises."""
        self._client.close()


class TwinCameraInstrument(CameraInstrument[TwinCameraConfig]):
    """`kind = "twin"`."""

    kind = "twin"
    config = TwinCameraConfig

    def open(self, config: TwinCameraConfig, context: CameraContext) -> OpenedCamera:
        """See `CameraInstrument`."""
        if not config.timed:
            client = TwinClient(config.address)
            return OpenedCamera(client, f"twin at {config.address}", client.close)
        # The twin's times are on the acquisition's clock, which acts as the computer's clock here.
        now, exposures = _end_of_block(context.clock), context.exposures
        source = TwinSource(config)
        timed = TimedCamera(source, lambda: (now(), now()), Timing(), now=now, exposures=exposures)
        return opened_timed(timed)


def _end_of_block(clock: BlockClock) -> Callable[[], float]:
    return lambda: clock()[0]
