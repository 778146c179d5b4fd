"""The camera of a rig file, opened by its driver."""

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
        exposures: where its exposure signal is recorded; None: it is not.
        line: settings of that signal in the rig file.
    Returns:
        The camera.
    Raises:
        DeviceError: the camera or its driver is missing.
        InputError: another camera than the rig file names, or no such recording.
        LimitError: a setting beyond what the camera can do.
    """
    with reported_faults(config):
        return camera_of(config).open(config, CameraContext(clock, exposures, line))
