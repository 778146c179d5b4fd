"""Features of a GenICam camera for which Aravis has no function, by their standard names.

Names are those of the Standard Features Naming Convention (SFNC) of the EMVA, or the vendors' own
if they differ; a feature that a camera does not have is None.
"""

from __future__ import annotations

from typing import Any

from haselab.base import DeviceError, LimitError
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.data_rate import LinkLoad

__all__ = ["AravisFeatures"]

# The frame rate that a camera will really reach, by vendors: Basler ace U and Hikrobot; FLIR and
# Lucid; Basler ace 2 and boost; Basler ace GigE.
_RESULTING = (
    "ResultingFrameRate",
    "AcquisitionResultingFrameRate",
    "BslResultingAcquisitionFrameRate",
    "ResultingFrameRateAbs",
)
_LIMIT = "DeviceLinkThroughputLimit"
_LINK_HZ = 1e9  # assumed speed of an Ethernet link that the camera does not report
_BUSY = 0.8  # load of a link above which a burst or a second program causes lost frames
_LONG_SHARE = 0.98  # fraction of a period above which an exposure leaves no time to read out


class AravisFeatures:
    """Reads features of one camera and derives what limits its frame rate.

    Args:
        library: Aravis.
        camera: Aravis' own.
    """

    def __init__(self, library: AravisLibrary, camera: Any) -> None:
        self._library = library
        self._camera = camera
        self.is_gige = bool(library.get("camera_is_gv_device", camera))

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._library.call(f"camera_{name}", self._camera, *arguments)

    def has(self, name: str) -> bool:
        """Whether the camera has this feature now."""
        try:
            return bool(self._call("is_feature_available", name.encode()))
        except DeviceError:
            return False

    def number(self, name: str) -> float | None:
        """Value of a float or integer feature."""
        if not self.has(name):
            return None
        for kind in ("get_float", "get_integer"):
            try:
                return float(self._call(kind, name.encode()))
            except DeviceError:
                continue
        return None

    def text(self, name: str) -> str | None:
        """Value of an enumeration feature."""
        if not self.has(name):
            return None
        try:
            return (self._call("get_string", name.encode()) or b"").decode(errors="replace")
        except DeviceError:
            return None

    # ---- frame rate ----------------------------------------------------------------------------

    def resulting_hz(self) -> float | None:
        """Frame rate that the camera predicts for its settings; None if it does not report one.

        `AcquisitionFrameRate` is only a request: the exposure, the sensor's readout or the link may
        allow less, and the camera does not change the feature then (Basler's manual, "Acquisition
        Frame Rate": use "Resulting Acquisition Frame Rate" for the actual one).
        """
        for name in _RESULTING:
            value = self.number(name)
            if value is not None and value > 0.0:
                return value
        return None

    def link_limit_byte_s(self) -> float | None:
        """Most bytes per second that the camera sends; None: not limited by the camera."""
        if self.text(f"{_LIMIT}Mode") == "Off":
            return None
        return self.number(_LIMIT)

    def why_slow(self, rate_hz: float, exposure_s: float, payload_bytes: int) -> str:
        """What to change to reach this frame rate."""
        if exposure_s * rate_hz > _LONG_SHARE:
            return (
                f"The exposure of {1e3 * exposure_s:.3g} ms is longer than a frame period of "
                f"{1e3 / rate_hz:.3g} ms. Shorten camera.exposure_s."
            )
        limit = self.link_limit_byte_s()
        needed = payload_bytes * rate_hz
        if limit is not None and needed > limit:
            return (
                f"The frames need {needed / 1e6:.4g} MB/s, but {_LIMIT} is {limit / 1e6:.4g} MB/s. "
                f"Raise it (arv-tool-0.8 control {_LIMIT}={needed * 1.1:.0f}), or lower "
                "camera.height_px."
            )
        return (
            "Shorten camera.exposure_s, lower camera.height_px, or use larger packets "
            "(camera.packet_bytes)."
        )

    # ---- network -------------------------------------------------------------------------------

    def set_packets(self, packet_bytes: int | None) -> str:
        """Set the packet size to the given one, or to the largest that the network accepts.

        Returns:
            A remark, or an empty text.
        Raises:
            DeviceError: The camera refuses the size.
        """
        if not self.is_gige:
            return ""
        if packet_bytes is not None:
            self._call("gv_set_packet_size", packet_bytes)
            return ""
        try:
            self._call("gv_auto_packet_size")
        except DeviceError as error:
            return f"The largest packet size was not found ({error}) Set camera.packet_bytes."
        return ""

    def load(self, payload_bytes: int, rate_hz: float) -> LinkLoad | None:
        """Network load of the frames; None if the camera is not on a network."""
        if not self.is_gige:
            return None
        megabit = self.number("GevLinkSpeed")
        byte_s = self.number("DeviceLinkSpeed")
        link = 1e6 * megabit if megabit else 8.0 * byte_s if byte_s else _LINK_HZ
        packet = int(self._call("gv_get_packet_size")) or 1500
        return LinkLoad(payload_bytes, rate_hz, packet, link)

    def check_load(self, payload_bytes: int, rate_hz: float) -> str:
        """Check that the network can carry the frames.

        Returns:
            A remark if they take most of it, else an empty text.
        Raises:
            LimitError: They exceed the network's capacity.
        """
        load = self.load(payload_bytes, rate_hz)
        if load is None or load.share < _BUSY:
            return ""
        reported = (
            f"{rate_hz:g} frames/s of {payload_bytes} bytes take {100.0 * load.share:.0f} % of a "
            f"link of {load.link_bit_s / 1e6:g} Mbit/s with packets of {load.packet_bytes} bytes"
        )
        if load.share > 1.0:
            raise LimitError(
                f"{reported}. Lower the frame rate to {load.most_hz:.4g} Hz or less, or lower "
                "camera.height_px."
            )
        return (
            f"{reported}. Connect the camera directly to its own network port, and raise the "
            "port's MTU to 8192 or more."
        )

    # ---- exposure line -------------------------------------------------------------------------

    def put_exposure_on(self, line: str, inverted: bool | None) -> None:
        """Put the camera's exposure on one of its output lines.

        Args:
            line: its name in `LineSelector`.
            inverted: LineInverter; None: unchanged.
        Raises:
            DeviceError: The camera has no such line, or not that signal.
        """
        try:
            self._call("set_string", b"LineSelector", line.encode())
            if self.text("LineMode") not in (None, "Output"):
                self._call("set_string", b"LineMode", b"Output")
            self._call("set_string", b"LineSource", b"ExposureActive")
            if inverted is not None:
                self._call("set_boolean", b"LineInverter", int(inverted))
        except DeviceError as error:
            raise DeviceError(
                f"exposure.line = {line!r} cannot output the exposure signal: {error} Change "
                "exposure.line (arv-tool-0.8 features lists LineSelector and LineSource), or "
                "remove it and set the line with the vendor's program."
            ) from None
        reported = self.text("LineSource")
        if reported != "ExposureActive":
            raise DeviceError(
                f"exposure.line = {line!r} has LineSource = {reported} instead of ExposureActive. "
                "Choose another line."
            )
