"""Open the camera of a rig file."""

from __future__ import annotations

from haselab.rig.cameras.opened import OpenedCamera
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.cameras.source import BlockClock, ExposureLine
from haselab.rig.instruments.instrument import CameraContext
from haselab.rig.instruments.registry import camera_of, reported_faults
from haselab.rig.instruments.sections import CameraConfig

__all__ = ["OpenedCamera", "open_camera"]


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
        exposures: log of its exposure signal; None if that is not recorded.
        line: settings of that signal in the rig file.
    Returns:
        The camera.
    Raises:
        DeviceError: The camera or its driver is missing.
        InputError: The camera is not the one that the rig file names, or the recording is missing.
        LimitError: A setting is outside the camera's limits.
    """
    with reported_faults(config):
        return camera_of(config).open(config, CameraContext(clock, exposures, line))
