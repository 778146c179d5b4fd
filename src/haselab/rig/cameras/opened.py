"""A camera of a rig file, opened, with what is known of its frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from haselab.rig.cameras.timed import TimedCamera
from haselab.rig.protocols import Camera

__all__ = ["OpenedCamera", "opened_timed"]


@dataclass(frozen=True)
class OpenedCamera:
    """A camera with what belongs to it.

    Args:
        camera: takes the frames.
        identity: what it reports to be.
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


def opened_timed(timed: TimedCamera) -> OpenedCamera:
    """A camera that is timed by the computer, as `OpenedCamera`.

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
