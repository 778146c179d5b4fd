"""The camera of a rig file, opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from haselab.rig import Camera
from haselab.rig.cameras.aravis import AravisSource
from haselab.rig.cameras.aravis_library import AravisLibrary
from haselab.rig.cameras.config import (
    AravisConfig,
    CameraConfig,
    FolderConfig,
    TwinCameraConfig,
    V4l2Config,
)
from haselab.rig.cameras.folder import FolderCamera
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.cameras.source import BlockClock, FrameSource
from haselab.rig.cameras.timed import TimedCamera, Timing
from haselab.rig.cameras.v4l2 import V4l2Source, check_v4l2
from haselab.rig.twin.hands import TwinHands

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
    """

    camera: Camera
    identity: str
    close: Callable[[], None]
    dropped: Callable[[], int] = lambda: 0
    uncertainty_s: Callable[[], float] = lambda: 0.0


def open_camera(
    config: CameraConfig, clock: BlockClock, exposures: ExposureLog | None = None
) -> OpenedCamera:
    """Open a camera; it takes no frames yet.

    Args:
        config: section `camera` of the rig file.
        clock: the acquisition's.
        exposures: where its exposure signal is recorded; None: it is not.
    Returns:
        The camera.
    Raises:
        DeviceError: the camera or its driver is missing.
        InputError: another camera than the rig file names, or no such recording.
        LimitError: a setting beyond what the camera can do.
    """
    if isinstance(config, TwinCameraConfig):
        hands = TwinHands(config.address)
        return OpenedCamera(hands, f"twin at {config.address}", hands.close)
    camera: FolderCamera | TimedCamera
    if isinstance(config, FolderConfig):
        camera = FolderCamera(config, clock)
    else:
        camera = TimedCamera(_source(config), clock, _timing(config), exposures=exposures)
    return OpenedCamera(
        camera,
        camera.identity,
        camera.close,
        lambda: camera.dropped,
        lambda: camera.uncertainty_s,
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


def _source(config: AravisConfig | V4l2Config) -> FrameSource:
    if isinstance(config, AravisConfig):
        return AravisSource(config)
    return V4l2Source(config)


def _timing(config: AravisConfig | V4l2Config) -> Timing:
    return Timing(config.timeout_s, config.latency_s, config.buffer_s, config.most_dropped)
