"""A V4L2 camera on Linux, through FFmpeg's input v4l2 (PyAV).

PyAV is already required for videos. linuxpy would report the driver's frame numbers, but it is
licensed under the GPL; so missing frames are found by gaps in the kernel's time stamps.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.cameras.config import V4l2Config
from haselab.rig.cameras.opened import OpenedCamera, opened_timed
from haselab.rig.cameras.source import Shot
from haselab.rig.cameras.timed import TimedCamera
from haselab.rig.drivers import quietly
from haselab.rig.instruments.instrument import CameraContext, CameraInstrument

__all__ = ["V4l2Instrument", "V4l2Source", "check_v4l2", "open_device"]

_FASTEST_HZ = 1000.0
_RATE_SHARE = 0.01
_JOIN_S = 1.0  # longer than a frame period
_BYTES = {
    "gray": 1.0,
    "yuyv422": 2.0,
    "uyvy422": 2.0,
    "nv12": 1.5,
    "yuv420p": 1.5,
}  # bytes per pixel
_PACKED = {"yuyv422": 0, "uyvy422": 1}  # offset of luma in each pair of bytes
_STEPS = 5
_SANE_S = 60.0  # largest plausible error of a frame's time
_TICK_S = 1e-6  # resolution of the kernel's times
_EXPOSURE_STEPS_HZ = 1e4  # V4L2_CID_EXPOSURE_ABSOLUTE counts 100 us


def check_v4l2() -> None:
    """Check that PyAV's FFmpeg has the input v4l2.

    Raises:
        DeviceError: It does not.
    """
    try:
        av.ContainerFormat("v4l2", "r")
    except ValueError:
        raise DeviceError(
            "A V4L2 camera needs Linux and an FFmpeg with the input v4l2, which the installed PyAV "
            "lacks. Run: pip install --force-reinstall av"
        ) from None


def open_device(config: V4l2Config, rate_hz: float) -> Any:
    """Open the device and start its stream.

    Args:
        config: section `camera` of the rig file.
        rate_hz: of the frames.
    Returns:
        PyAV's container; its packets are frames with the kernel's monotonic time in microseconds.
    Raises:
        DeviceError: The device does not exist, or refuses the configuration.
    """
    options = {
        "framerate": str(Fraction(rate_hz).limit_denominator(1000)),
        "input_format": config.format,
        "timestamps": "default",  # the kernel's own
    }
    if config.width_px is not None and config.height_px is not None:
        options["video_size"] = f"{config.width_px}x{config.height_px}"
    try:
        return av.open(config.device, format="v4l2", options=options)
    except (av.FFmpegError, OSError, ValueError) as error:
        words = getattr(error, "strerror", None) or str(error)
        raise DeviceError(
            f"The camera does not open ({words}) with {config.format}, "
            f"{options.get('video_size', 'its own size')}, {rate_hz:g} Hz. Choose a mode that "
            f"v4l2-ctl --list-formats-ext lists. {config.device}"
        ) from None


class V4l2Source:
    """One V4L2 device; implements `FrameSource`.

    A thread waits for the frames, since the driver buffers only a few. The time of a frame is the
    kernel's time at the arrival of its first packet.

    Args:
        config: section `camera` of the rig file.
        opener: opens the device.
    Raises:
        DeviceError: The device does not exist, or access is denied.
        InputError: The camera is not the one that the rig file names.
    """

    def __init__(self, config: V4l2Config, opener: Any = open_device) -> None:
        self._config = config
        self._opener = opener
        self._reader: _Reader | None = None
        self._lost = 0
        self.identity = self._identify()

    def _identify(self) -> str:
        device = Path(self._config.device)
        if not device.exists():
            raise DeviceError(
                "The camera does not exist. Plug it in, or change camera.device; ls "
                f"/sys/class/video4linux lists the devices. {device}"
            )
        if not os.access(device, os.R_OK | os.W_OK):
            raise DeviceError(
                "Your user has no permission to use the camera. Join its group with: sudo usermod "
                f"-aG video $USER, then log in again. {device}"
            )
        reported = Path("/sys/class/video4linux", device.resolve().name, "name")
        name = reported.read_text(encoding="utf-8").strip() if reported.is_file() else "V4L2 camera"
        if self._config.name is not None and name != self._config.name:
            raise InputError(
                f"The camera's name is {name!r}, but the rig file names {self._config.name!r}. "
                f"Connect that camera, or change camera.name. {device}"
            )
        return f"{name} at {device}"

    @property
    def dropped(self) -> int:
        """See `FrameSource`: periods without a frame, and frames that were not taken in time."""
        return self._lost if self._reader is None else self._reader.lost

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `RemarkingCamera`: none."""
        return ()

    def why_slow(self, rate_hz: float) -> str:
        """See `KnowsCauses`; the driver just confirms the requested rate (VIDIOC_S_PARM)."""
        return (
            "In dim light a webcam exposes for longer than a frame period. Run: v4l2-ctl -d "
            f"{self._config.device} -c auto_exposure=1 -c exposure_time_absolute="
            f"{max(1, int(_EXPOSURE_STEPS_HZ / rate_hz / 2))} -c exposure_dynamic_framerate=0"
        )

    def why_lost(self) -> str:
        """See `KnowsCauses`."""
        reader = self._reader
        if reader is None or not reader.slow:
            return ""
        return f"The camera is slower than the requested rate. {self.why_slow(reader.hz)}"

    @property
    def jitter_s(self) -> float:
        """See `FrameSource`; the kernel stamps a frame when it begins to arrive."""
        return _TICK_S

    def start(self, rate_hz: float) -> None:
        """See `FrameSource`."""
        self.stop()
        if not 0.0 < rate_hz <= _FASTEST_HZ:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but it must be above 0 and at most "
                f"{_FASTEST_HZ:g} Hz. Change the frame rate. {self._config.device}"
            )
        container = self._opener(self._config, rate_hz)
        try:
            self._check(container.streams.video[0], rate_hz)
        except BaseException:
            container.close()
            raise
        room = int(self._config.buffer_s * rate_hz) + 2
        self._reader = _Reader(container, 1.0 / rate_hz, room, self._config)

    def _check(self, stream: Any, rate_hz: float) -> None:
        config, codec = self._config, stream.codec_context
        got_hz = float(stream.average_rate or 0.0)
        if abs(got_hz / rate_hz - 1.0) > _RATE_SHARE:
            raise LimitError(
                f"The camera set a frame rate of {got_hz:g} Hz instead of {rate_hz:g} Hz. Request "
                f"that rate, or change the size or the format. {config.device}"
            )
        got = codec.pix_fmt if codec.name == "rawvideo" else codec.name
        if got != config.format:
            raise LimitError(
                f"The camera set the format {got!r} instead of {config.format!r}. Change "
                f"camera.format. {config.device}"
            )

    def take(self) -> list[Shot]:
        """See `FrameSource`."""
        return [] if self._reader is None else self._reader.take()

    def stop(self) -> None:
        """See `FrameSource`. Never raises."""
        reader, self._reader = self._reader, None
        if reader is not None:
            self._lost = reader.lost
            reader.stop()

    def close(self) -> None:
        """See `FrameSource`. Never raises."""
        self.stop()


class _Reader:
    """Waits for frames in a thread, which closes the device when it ends."""

    def __init__(self, container: Any, period_s: float, room: int, config: V4l2Config) -> None:
        self._container = container
        self._period_s = period_s
        self._room = room
        self._config = config
        self._shots: deque[Shot] = deque()
        self._error: Exception | None = None
        self._ends = threading.Event()
        self._last_s: float | None = None
        self._steps: deque[int] = deque(maxlen=_STEPS)
        self.lost = 0
        self._thread = threading.Thread(target=self._run, name="v4l2 camera", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            for packet in self._container.demux(video=0):
                if self._ends.is_set():
                    break
                if packet.size:
                    self._keep(packet)
        except Exception as error:  # `take` raises it in the caller's thread
            self._error = error
        finally:
            quietly(self._container.close)

    def _keep(self, packet: Any) -> None:
        host_s = _monotonic(float(packet.pts * packet.time_base))
        if self._last_s is not None:
            steps = round((host_s - self._last_s) / self._period_s)
            self._steps.append(steps)
            self.lost += max(steps - 1, 0)
        self._last_s = host_s
        if len(self._shots) >= self._room:
            self.lost += 1
            return
        self._shots.append(Shot(self._luma(packet), host_s))

    def _luma(self, packet: Any) -> NDArray[np.uint8]:
        """Extract the grey levels that the camera sent."""
        codec = packet.stream.codec_context
        if codec.name == "rawvideo":
            image = _raw_luma(packet, self._config.format, codec.width, codec.height)
        else:
            frame = packet.decode()[0]
            plane = frame.planes[0]
            rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
            image = rows[: frame.height, : frame.width].copy()
        wanted = (self._config.height_px or len(image), self._config.width_px or image.shape[1])
        if image.shape != wanted:
            raise DeviceError(
                f"The camera sends images of {image.shape[1]} x {image.shape[0]} px, but the rig "
                f"file sets {wanted[1]} x {wanted[0]}. Change camera.width_px and height_px. "
                f"{self._config.device}"
            )
        return image

    @property
    def hz(self) -> float:
        return 1.0 / self._period_s

    @property
    def slow(self) -> bool:
        """Whether no two of the last frames are one period apart."""
        return len(self._steps) > 1 and min(self._steps) > 1

    def take(self) -> list[Shot]:
        shots = [self._shots.popleft() for _ in range(len(self._shots))]
        if not shots and not self._thread.is_alive() and not self._ends.is_set():
            if isinstance(self._error, DeviceError):
                raise self._error
            words = getattr(self._error, "strerror", None) or self._error or "no more frames"
            raise DeviceError(
                f"The camera no longer responds ({words}). Check its cable. {self._config.device}"
            )
        return shots

    def stop(self) -> None:
        self._ends.set()
        # A stalled driver may block the thread until the next frame, or until it is unplugged.
        self._thread.join(_JOIN_S + self._period_s)


def _monotonic(measured_s: float) -> float:
    """Convert a driver's time, which is monotonic or the time of day, to `time.monotonic`."""
    day_s = time.time()
    now_s = time.monotonic()
    if abs(measured_s - now_s) < _SANE_S:
        return measured_s
    if abs(measured_s - day_s) < _SANE_S:
        return measured_s - day_s + now_s
    raise DeviceError(
        f"The camera's driver reports {measured_s:g} s as the time of a frame, which is not on "
        "this computer's clock. Update the driver."
    )


def _raw_luma(packet: Any, form: str, width: int, height: int) -> NDArray[np.uint8]:
    """Luma of an uncompressed frame, which is first or in every other byte."""
    values = np.frombuffer(packet, np.uint8)
    wanted = int(_BYTES[form] * width * height)
    if values.size != wanted:
        raise DeviceError(
            f"The camera sends frames of {values.size} bytes, but {form} of {width} x {height} px "
            f"has {wanted}. Set camera.width_px and height_px to a size that the camera has."
        )
    first = _PACKED.get(form)
    step = 1 if first is None else 2
    rows = values[: step * width * height].reshape(height, step * width)
    return rows[:, (first or 0) :: step].copy()


class V4l2Instrument(CameraInstrument[V4l2Config]):
    """`kind = "v4l2"`."""

    kind = "v4l2"
    config = V4l2Config
    library = "V4L2"
    purpose = "webcams"

    def check_driver(self) -> list[str]:
        """See `Instrument`."""
        check_v4l2()
        return ["v4l2"]

    def open(self, config: V4l2Config, context: CameraContext) -> OpenedCamera:
        """See `CameraInstrument`."""
        source, exposures = V4l2Source(config), context.exposures
        return opened_timed(TimedCamera(source, context.clock, config.timing, exposures=exposures))
