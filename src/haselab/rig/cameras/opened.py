"""An opened camera with the properties of its frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from haselab.rig.cameras.timed import TimedCamera
from haselab.rig.protocols import Camera

__all__ = ["OpenedCamera", "opened_timed"]


@dataclass(frozen=True)
class OpenedCamera:
    """An opened camera and functions that report on its frames.

    Args:
        camera: takes the frames.
        identity: its own identification.
        close: closes it; never raises.
        dropped: number of frames lost since the last start.
        uncertainty_s: uncertainty of a frame's time (half width), in s.
        remarks: possible problems with the frames, one line each.
        lag_s: delay from an exposure's middle to its estimate from the frame, in s; NaN: unknown.
        rate_hz: measured frames per second; 0: unknown.
    """

    camera: Camera
    identity: str
    close: Callable[[], None]
    dropped: Callable[[], int] = lambda: 0
    uncertainty_s: Callable[[], float] = lambda: 0.0
    remarks: Callable[[], tuple[str, ...]] = lambda: ()
    lag_s: Callable[[], float] = lambda: math.nan
    rate_hz: Callable[[], float] = lambda: 0.0


def opened_timed(timed: TimedCamera) -> OpenedCamera:
    """Wrap a camera that the computer times as an `OpenedCamera`.

    Args:
        timed: around the driver.
    """
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
