"""A folder of images or a video file as a camera; its frames follow the blocks' time."""

from __future__ import annotations

import math
import threading
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.cameras.config import FolderConfig
from haselab.rig.cameras.opened import OpenedCamera
from haselab.rig.cameras.source import BlockClock
from haselab.rig.drivers import quietly
from haselab.rig.instruments.instrument import CameraContext, CameraInstrument
from haselab.rig.protocols import Frames
from haselab.store.video.opening import open_video

__all__ = ["FolderCamera", "FolderInstrument"]

_FASTEST_HZ = 1e6
_RATE_SHARE = 0.01  # largest relative difference of a video's own rate from the requested one


class FolderCamera:
    """Plays images from the disk; implements `haselab.rig.Camera`.

    Frame `k` of a recording is exposed `k` periods after the start, on the acquisition's clock; it
    is returned when that time has passed. Each start begins with the first frame.

    Args:
        config: section `camera` of the rig file.
        clock: the acquisition's.
    Raises:
        InputError: The folder or file does not exist, cannot be read, or has no 8-bit images.
    """

    def __init__(self, config: FolderConfig, clock: BlockClock) -> None:
        self._repeat = config.repeat
        self._clock = clock
        self._path = Path(config.path)
        self._reader = open_video(self._path)
        try:
            first = next(iter(self._reader), None)
            if first is None or first.dtype != np.uint8:
                what = "no frames" if first is None else "16-bit frames"
                raise InputError(
                    f"The recording has {what}, but a camera needs 8-bit frames. Set camera.path "
                    f"to another recording. {self._path}"
                )
        except BaseException:
            self._reader.close()
            raise
        height, width = first.shape
        self.identity = f"{self._path.name}, {width} x {height} px"
        self._frames: Generator[NDArray[np.uint8], None, None] | None = None
        self._lock = threading.RLock()
        self._rate_hz = 0.0
        self._start_s = 0.0
        self._given = 0

    @property
    def dropped(self) -> int:
        """Number of lost frames: none."""
        return 0

    @property
    def uncertainty_s(self) -> float:
        """Uncertainty of a frame's time: none."""
        return 0.0

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`.

        Raises:
            LimitError: The rate is outside the limits, or not the recording's own.
        """
        if not 0.0 < rate_hz <= _FASTEST_HZ:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but it must be above 0 and at most "
                f"{_FASTEST_HZ:g} Hz. Change the frame rate. {self._path}"
            )
        own_hz = self._reader.rate_hz
        if own_hz is not None and abs(rate_hz / own_hz - 1.0) > _RATE_SHARE:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but the recording has {own_hz:g} Hz. Request "
                f"that rate. {self._path}"
            )
        with self._lock:
            self.stop()
            self._frames = self._play()
            self._rate_hz, self._start_s, self._given = rate_hz, self._clock()[0], 0

    def _play(self) -> Generator[NDArray[np.uint8], None, None]:
        while True:
            for frame in self._reader:
                yield np.array(frame, dtype=np.uint8)
            if not self._repeat:
                return

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`.

        Raises:
            DeviceError: The recording has ended.
            InputError: A frame cannot be read.
        """
        with self._lock:
            return None if self._frames is None else self._due(self._frames)

    def _due(self, frames: Iterator[NDArray[np.uint8]]) -> Frames | None:
        now_s = self._clock()[0]
        most = math.floor((now_s - self._start_s) * self._rate_hz) + 2 - self._given
        time_s = self._start_s + (self._given + np.arange(max(most, 0))) / self._rate_hz
        time_s = time_s[time_s <= now_s]
        if time_s.size == 0:
            return None
        images = [image for _, image in zip(range(time_s.size), frames, strict=False)]
        if not images:
            raise DeviceError(
                f"The recording ended after {self._given} frames. Play less, or set "
                f"camera.repeat = true. {self._path}"
            )
        self._given += len(images)
        return Frames(np.stack(images), time_s[: len(images)])

    def stop(self) -> None:
        """See `haselab.rig.Camera`. Never raises."""
        with self._lock:
            frames, self._frames = self._frames, None
            if frames is not None:
                quietly(frames.close)

    def close(self) -> None:
        """Close the file. Never raises."""
        self.stop()
        quietly(self._reader.close)


class FolderInstrument(CameraInstrument[FolderConfig]):
    """`kind = "folder"`."""

    kind = "folder"
    config = FolderConfig

    def open(self, config: FolderConfig, context: CameraContext) -> OpenedCamera:
        """See `CameraInstrument`."""
        camera = FolderCamera(config, context.clock)
        return OpenedCamera(
            camera,
            camera.identity,
            camera.close,
            lambda: camera.dropped,
            lambda: camera.uncertainty_s,
        )
