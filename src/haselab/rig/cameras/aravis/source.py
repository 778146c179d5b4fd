"""A GenICam camera (GigE Vision, USB3 Vision) through the library Aravis."""

from __future__ import annotations

import ctypes
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.cameras.aravis.features import AravisFeatures
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.config import AravisConfig
from haselab.rig.cameras.source import ExposureLine, Shot
from haselab.rig.cameras.stamps import StampedClock
from haselab.rig.drivers import quietly

__all__ = ["AravisSource"]

_OFF, _CONTINUOUS, _SUCCESS = 0, 0, 0  # of ArvAuto, ArvAcquisitionMode, ArvBufferStatus
_RATE_SHARE = 0.01  # largest relative difference from the requested frame rate
_EXPOSURE_SHARE = 0.05  # exposures are multiples of the camera's line time
_FEWEST_BUFFERS = 4
_MOST_BYTES = 2**30  # of all buffers
_SOCKET_AUTO = 1  # of ArvGvStreamSocketBuffer: as large as a frame
_ID_RANGE = 2**16  # range of the frame numbers of GigE Vision 1, which skip 0


class AravisSource:
    """One camera; implements `FrameSource`.

    Aravis' own thread receives the frames into buffers; `take` copies the complete ones. A frame's
    time is half an exposure before the arrival of its first packet, with the scatter removed by
    means of the camera's own clock.

    Args:
        config: section `camera` of the rig file.
        line: output line on which its exposures are recorded; None: they are not recorded.
    Raises:
        DeviceError: The library or the camera is missing, or the camera refuses the configuration.
        InputError: The camera is not the one that the rig file names.
        LimitError: A setting is outside the camera's limits.
    """

    def __init__(self, config: AravisConfig, line: ExposureLine | None = None) -> None:
        self._config = config
        self._line = line
        self._library = AravisLibrary()
        self._stream: Any = None
        self._lost = 0
        self._last_id: int | None = None
        self._before_s = 0.0
        self._exposure_s = 0.0
        # exposure in us and its automatic mode before opening
        self._found: tuple[float, str | None] | None = None
        self._payload = 0
        self._packets = (0, 0)  # missing and resent packets of the last stream
        self._counts = (0, 0)  # failures and underruns
        self._remarks: list[str] = []
        self._clock = self._new_clock()
        self._camera = self._open()
        self._features = AravisFeatures(self._library, self._camera)
        try:
            self._identify()
            self._set_up()
        except DeviceError as error:
            self.close()
            raise DeviceError(f"Camera {self._called}: {error}") from None
        except BaseException:
            self.close()
            raise

    def _new_clock(self) -> StampedClock:
        config = self._config
        return StampedClock(config.tick_hz, use_stamps=config.stamps == "camera")

    @property
    def _called(self) -> str:
        return self._config.name or "(first found)"

    def _open(self) -> Any:
        name = self._config.name
        if name is not None and name.startswith("Fake"):
            self._library.get("enable_interface", b"Fake")
        reason = "none is connected"
        try:
            camera = self._library.call("camera_new", name.encode() if name is not None else None)
        except DeviceError as error:
            camera, reason = None, str(error)
        if not camera:
            missing = "No camera found" if name is None else f"Camera {name} is not found"
            raise DeviceError(
                f"{missing}: {reason.rstrip('.')}. Check its cable and its address, or change "
                "camera.name; arv-tool-0.8 (aravis-tools-cli) lists the cameras."
            )
        return camera

    def _identify(self) -> None:
        vendor, model, serial = (
            (self._library.call(f"camera_get_{what}", self._camera) or b"").decode(errors="replace")
            for what in ("vendor_name", "model_name", "device_serial_number")
        )
        wanted = self._config.serial_number
        if wanted is not None and wanted != serial:
            raise InputError(
                f"Camera {self._called} has the serial number {serial}, but the rig file names "
                f"{wanted}. Connect that camera, or change camera.serial_number."
            )
        self.identity = f"{vendor} {model}, serial number {serial}"

    # ---- settings ------------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._library.call(f"camera_{name}", self._camera, *arguments)

    def _set_up(self) -> None:
        config = self._config
        self._call("set_acquisition_mode", _CONTINUOUS)
        self._call("set_pixel_format_from_string", b"Mono8")
        self._set_region()
        if config.exposure_s is not None:
            self._set_exposure(config.exposure_s)
        if config.gain is not None:
            self._check("gain", config.gain, "", 1.0, "get_gain_bounds")
            if self._call("is_gain_auto_available"):
                self._call("set_gain_auto", _OFF)
            self._call("set_gain", config.gain)
        self._call("clear_triggers")
        if config.trigger is not None:
            self._call("set_trigger", config.trigger.encode())
            mode = (self._call("get_string", b"TriggerMode") or b"").decode(errors="replace")
            if mode != "On":
                raise DeviceError(f"TriggerMode is {mode} after it was set to On (camera.trigger).")
        if self._line is not None and self._line.line is not None:
            self._features.put_exposure_on(self._line.line, self._line.inverted)

    def _set_region(self) -> None:
        config = self._config
        x, y, width, height = self._library.integers("camera_get_region", self._camera, 4)
        wanted = (config.x_px, config.y_px, config.width_px or width, config.height_px or height)
        if wanted == (x, y, width, height):
            return
        self._call("set_region", *wanted)
        got = tuple(self._library.integers("camera_get_region", self._camera, 4))
        if got != wanted:
            across, down = self._library.integers("camera_get_sensor_size", self._camera, 2)
            raise LimitError(
                f"Camera {self._called} does not accept the region (x, y, width, height) = "
                f"{wanted} px and set {got}; its sensor has {across} x {down} px. Change "
                "camera.x_px, y_px, width_px and height_px."
            )

    def _set_exposure(self, exposure_s: float) -> None:
        self._check("exposure", exposure_s, " s", 1e-6, "get_exposure_time_bounds")
        self._found = (self._call("get_exposure_time"), self._features.text("ExposureAuto"))
        if self._call("is_exposure_auto_available"):
            self._call("set_exposure_time_auto", _OFF)
        self._call("set_exposure_time", 1e6 * exposure_s)
        got_s = 1e-6 * self._call("get_exposure_time")
        if abs(got_s / exposure_s - 1.0) > _EXPOSURE_SHARE:
            raise DeviceError(f"the exposure is {got_s:g} s, but {exposure_s:g} s was requested.")

    def _restore_exposure(self) -> None:
        """Restore the exposure from before opening, which another rig file may rely on.

        Raises:
            DeviceError: The camera does not reply.
        """
        if self._found is None:
            return
        (time_us, automatic), self._found = self._found, None
        if self._call("get_exposure_time") != time_us:
            self._call("set_exposure_time", time_us)
        if automatic not in (None, "", "Off"):
            self._call("set_string", b"ExposureAuto", automatic.encode())

    def _check(self, what: str, value: float, unit: str, scale: float, bounds: str) -> None:
        low, high = (scale * end for end in self._library.bounds(f"camera_{bounds}", self._camera))
        if not low <= value <= high:
            raise LimitError(
                f"{what.capitalize()} = {value:g}{unit} is outside [{low:g}, {high:g}]{unit} of "
                f"camera {self._called}. Change camera.{what}."
            )

    # ---- FrameSource ---------------------------------------------------------------------------

    @property
    def dropped(self) -> int:
        """See `FrameSource`: gaps in the frame numbers, or Aravis' count if it is larger."""
        self._read_statistics()
        return max(self._lost, sum(self._counts))

    def _read_statistics(self) -> None:
        if self._stream is None:
            return
        reported = [ctypes.c_uint64() for _ in range(3)]
        self._library.get("stream_get_statistics", self._stream, *reported)
        self._counts = reported[1].value, reported[2].value
        if self._features.is_gige:
            resent, missing = ctypes.c_uint64(), ctypes.c_uint64()
            self._library.get("gv_stream_get_statistics", self._stream, resent, missing)
            self._packets = missing.value, resent.value

    @property
    def jitter_s(self) -> float:
        """See `FrameSource`: scatter of the arrival times relative to the camera's clock."""
        return self._clock.jitter_s

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `RemarkingCamera`."""
        found = list(self._remarks)
        if self._clock.has_no_clock:
            found.append(
                f"Camera {self._called} sends no time stamps, so its frames are timed by their "
                "arrival, which scatters. Use the exposure line (section exposure)."
            )
        missing, resent = self._packets
        if resent and not missing:
            found.append(
                f"{resent} packets were resent and none is missing: the link is almost full."
            )
        return tuple(found)

    def why_slow(self, rate_hz: float) -> str:
        """See `KnowsCauses`."""
        if self._config.trigger is not None:
            return (
                f"Its trigger at {self._config.trigger} sets the rate. Change that signal's rate."
            )
        return self._features.why_slow(rate_hz, self._exposure_s, self._payload)

    def why_lost(self) -> str:
        """See `KnowsCauses`."""
        self._read_statistics()
        missing, resent = self._packets
        failures, underruns = self._counts
        if missing:
            return (
                f"{missing} packets were lost and {resent} were resent. Connect the camera "
                "directly, raise the port's MTU, and raise net.core.rmem_max (haselab doctor)."
            )
        if underruns > failures:
            return f"{underruns} frames found no free buffer. Raise camera.buffer_s."
        if failures:
            return f"{failures} frames were incomplete. Check the cable, or lower the frame rate."
        return ""

    def start(self, rate_hz: float) -> None:
        """See `FrameSource`."""
        self.stop()
        self._remarks = []
        if self._config.trigger is None:
            self._set_rate(rate_hz)
        elif not 0.0 < rate_hz < math.inf:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but it must be above 0. Give the trigger's "
                "rate."
            )
        self._read_exposure()
        self._prepare_link(rate_hz)
        self._clock = self._new_clock()
        self._last_id, self._lost = None, 0
        self._packets, self._counts = (0, 0), (0, 0)
        self._start_stream(rate_hz)

    def _read_exposure(self) -> None:
        self._exposure_s = 1e-6 * self._call("get_exposure_time")
        self._before_s = 0.5 * self._exposure_s
        line = self._line
        if line is None or abs(self._exposure_s - line.duration_s) <= (
            _EXPOSURE_SHARE * line.duration_s
        ):
            return
        raise LimitError(
            f"exposure.duration_s is {line.duration_s:g} s, but camera {self._called} exposes "
            f"for {self._exposure_s:g} s. Set camera.exposure_s, and remove exposure.duration_s."
        )

    def _prepare_link(self, rate_hz: float) -> None:
        self._payload = int(self._call("get_payload"))
        for reported in (
            self._features.set_packets(self._config.packet_bytes),
            self._features.check_load(self._payload, rate_hz),
        ):
            if reported:
                self._remarks.append(reported)

    def _set_rate(self, rate_hz: float) -> None:
        low_hz, high_hz = self._library.bounds("camera_get_frame_rate_bounds", self._camera)
        if not low_hz <= rate_hz <= high_hz:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, but camera {self._called} allows {low_hz:g} to "
                f"{high_hz:g} Hz. Change the frame rate, the exposure or the image size."
            )
        self._call("set_frame_rate", rate_hz)
        got_hz = self._call("get_frame_rate")
        if abs(got_hz / rate_hz - 1.0) > _RATE_SHARE:
            raise LimitError(
                f"Camera {self._called} set a frame rate of {got_hz:g} Hz instead of {rate_hz:g} "
                "Hz. Request that rate, or shorten camera.exposure_s."
            )
        real_hz = self._features.resulting_hz()
        if real_hz is not None and real_hz < (1.0 - _RATE_SHARE) * rate_hz:
            self._read_exposure()
            self._payload = int(self._call("get_payload"))
            raise LimitError(
                f"The frame rate is set to {rate_hz:g} Hz, but camera {self._called} reaches only "
                f"{real_hz:.4g} Hz with these settings. {self.why_slow(rate_hz)}"
            )

    def _start_stream(self, rate_hz: float) -> None:
        payload = self._payload
        self._stream = self._call("create_stream", None, None)
        if not self._stream:
            raise DeviceError(
                f"Camera {self._called} opens no stream. Close other programs that use it."
            )
        if self._features.is_gige:  # larger than the system's default, up to net.core.rmem_max
            self._library.set_enum(
                self._stream, "socket-buffer", "gv_stream_socket_buffer_get_type", _SOCKET_AUTO
            )
        wanted = math.ceil(self._config.buffer_s * rate_hz) + _FEWEST_BUFFERS
        for _ in range(max(_FEWEST_BUFFERS, min(wanted, _MOST_BYTES // payload))):
            buffer = self._library.get("buffer_new_allocate", payload)
            self._library.get("stream_push_buffer", self._stream, buffer)
        try:
            self._call("start_acquisition")
        except DeviceError as error:
            self.stop()
            raise DeviceError(f"Camera {self._called} does not start: {error}") from None

    def take(self) -> list[Shot]:
        """See `FrameSource`."""
        shots: list[Shot] = []
        if self._stream is None:
            return shots
        # Aravis stamps by the time of day. Read it first, so that a delay makes frames seem late,
        # which `ClockOffset` expects, and never early.
        day_s = time.time()
        to_host_s = time.monotonic() - day_s
        while buffer := self._library.get("stream_try_pop_buffer", self._stream):
            try:
                shot = self._shot(buffer, to_host_s)
            finally:
                self._library.get("stream_push_buffer", self._stream, buffer)
            if shot is not None:
                shots.append(shot)
        return shots

    def _shot(self, buffer: Any, to_host_s: float) -> Shot | None:
        if self._library.get("buffer_get_status", buffer) != _SUCCESS:
            return None  # counted as lost by Aravis and by the gap in the frame numbers
        self._count(self._library.get("buffer_get_frame_id", buffer))
        day_ns = self._library.get("buffer_get_system_timestamp", buffer)
        stamp_ns = self._library.get("buffer_get_timestamp", buffer)
        arrived_s = 1e-9 * day_ns + to_host_s
        try:
            host_s, steady_s = self._clock.host_s(stamp_ns, arrived_s, same=stamp_ns == day_ns)
        except DeviceError as error:
            raise DeviceError(f"Camera {self._called}: {error}") from None
        return Shot(self._image(buffer), host_s - self._before_s, steady_s)

    def _count(self, number: int) -> None:
        if self._last_id is not None:
            gap = number - self._last_id
            if gap < 0:
                gap = gap % _ID_RANGE - 1
            self._lost += max(gap - 1, 0)
        self._last_id = number

    def _image(self, buffer: Any) -> NDArray[np.uint8]:
        width = self._library.get("buffer_get_image_width", buffer)
        height = self._library.get("buffer_get_image_height", buffer)
        size = ctypes.c_size_t()
        data = self._library.get("buffer_get_image_data", buffer, size)
        if not data or size.value < width * height:
            raise DeviceError(
                f"Camera {self._called} sent {size.value} bytes for an image of {width} x {height} "
                "px, which is not 8 bit. Set its pixel format to Mono8."
            )
        pixels = (ctypes.c_uint8 * (width * height)).from_address(data)
        return np.frombuffer(pixels, dtype=np.uint8).reshape(height, width).copy()

    def stop(self) -> None:
        """See `FrameSource`. Never raises."""
        if self._stream is None:
            return
        quietly(lambda: self._call("stop_acquisition"))
        self._read_statistics()
        stream, self._stream = self._stream, None
        self._library.release(stream)

    def close(self) -> None:
        """See `FrameSource`; restores the exposure from before opening. Never raises."""
        self.stop()
        quietly(self._restore_exposure)
        if self._camera is not None:
            camera, self._camera = self._camera, None
            self._library.release(camera)
