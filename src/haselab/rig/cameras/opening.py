"""The camera of a rig file, opened."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from haselab.rig import Camera
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.aravis.source import AravisSource
from haselab.rig.cameras.config import (
    AravisConfig,
    CameraConfig,
    FolderConfig,
    TwinCameraConfig,
    V4l2Config,
)
from haselab.rig.cameras.folder import FolderCamera
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.cameras.source import BlockClock, ExposureLine, FrameSource
from haselab.rig.cameras.timed import TimedCamera, Timing
from haselab.rig.cameras.twin_source import TwinSource
from haselab.rig.cameras.v4l2 import V4l2Source, check_v4l2
from haselab.rig.twin.client import TwinClient

__all__ = ["OpenedCamera", "check_driver", "open_camera"]


@dataclass(frozen=True)
class OpenedCamera:
    """A camera with what belongs to it.

    Args:
        camera: takes the frames.
        identity: what it says it is.
        close: lets go of it; never raises.
        dropped: frames lost since the last start.
        uncertainty_s: half width of what a frame's time is known to, in s.
        remarks: what may go wrong with the frames, one line each.
        lag_s: from an exposure's middle to its frame's estimated one, in s; NaN: not known.
        rate_hz: frames a second as measured; 0: not known.
    """

    camera: Camera
    identity: str
    close: Callable[[], None]
    dropped: Callable[[], int] = lambda: 0
    uncertainty_s: Callable[[], float] = lambda: 0.0
    remarks: Callable[[], tuple[str, ...]] = lambda: ()
    lag_s: Callable[[], float] = lambda: math.nan
    rate_hz: Callable[[], float] = lambda: 0.0


def open_camera(
    config: CameraConfig,
    clock: BlockClock,
    exposures: ExposureLog | None = None,
    line: ExposureLine | None = None,
) -> OpenedCamera:
    """Open a camera; it takes no frames yet.

    Args:
        config: section `camera` of the rig file.
        clock: the acquisition's.
        exposures: where its exposure signal is recorded; None: it is not.
        line: what the rig file says of that signal.
    Returns:
        The camera.
    Raises:
        DeviceError: the camera or its driver is missing.
        InputError: another camera than the rig file names, or no such recording.
        LimitError: a setting beyond what the camera can do.
    """
    if isinstance(config, TwinCameraConfig) and not config.timed:
        client = TwinClient(config.address)
        return OpenedCamera(client, f"twin at {config.address}", client.close)
    if isinstance(config, FolderConfig):
        camera = FolderCamera(config, clock)
        return OpenedCamera(
            camera,
            camera.identity,
            camera.close,
            lambda: camera.dropped,
            lambda: camera.uncertainty_s,
        )
    timed = _timed(config, clock, exposures, line)
    return OpenedCamera(
        timed,
        timed.identity,
        timed.close,
        lambda: timed.dropped,
        lambda: timed.uncertainty_s,
        lambda: timed.remarks,
        lambda: timed.lag_s,
        lambda: timed.rate_hz,
    )


def check_driver(config: CameraConfig | None) -> list[str]:
    """What a camera needs on this computer; the camera itself is left alone.

    Args:
        config: section `camera` of the rig file.
    Returns:
        Names of what is needed and there.
    Raises:
        DeviceError: it is missing.
    """
    if isinstance(config, AravisConfig):
        AravisLibrary()
        return ["aravis"]
    if isinstance(config, V4l2Config):
        check_v4l2()
        return ["v4l2"]
    return []


def _timed(
    config: AravisConfig | V4l2Config | TwinCameraConfig,
    clock: BlockClock,
    exposures: ExposureLog | None,
    line: ExposureLine | None,
) -> TimedCamera:
    if isinstance(config, TwinCameraConfig):
        # The twin's times are on the acquisition's clock: that one is the computer's here.
        now = _only_blocks(clock)
        return TimedCamera(
            TwinSource(config), lambda: (now(), now()), Timing(), now=now, exposures=exposures
        )
    timing = Timing(config.timeout_s, config.latency_s, config.buffer_s, config.most_dropped)
    return TimedCamera(_source(config, line), clock, timing, exposures=exposures)


def _source(config: AravisConfig | V4l2Config, line: ExposureLine | None) -> FrameSource:
    if isinstance(config, AravisConfig):
        return AravisSource(config, line)
    return V4l2Source(config)


def _only_blocks(clock: BlockClock) -> Callable[[], float]:
    return lambda: clock()[0]
