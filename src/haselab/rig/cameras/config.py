"""Section `camera` of RIG.toml: the cameras that come with this package."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from haselab.rig.cameras.timed import Timing
from haselab.rig.instruments.sections import CameraConfig

__all__ = ["AravisConfig", "FolderConfig", "TwinCameraConfig", "V4l2Config"]


class _Stamped(CameraConfig):
    """A camera with a clock of its own."""

    stamps: Literal["camera", "arrival"] = Field(
        "camera", description="whose clock times the frames; arrival: the camera's is no use"
    )
    tick_hz: float | None = Field(
        None, gt=0, le=1e12, description="of the camera's time stamps; left out: nanoseconds"
    )


class TwinCameraConfig(_Stamped):
    """The camera of a served twin."""

    kind: Literal["twin"]
    address: str = Field(min_length=1, description="host:port of the twin")
    timed: bool = Field(
        False, description="frames come late and are timed as those of a real camera are"
    )
    exposure_s: float | None = Field(
        None, gt=0, le=10, description="with timed; left out: as in the twin's own file"
    )

    @property
    def is_timed_by_exposures(self) -> bool:
        """See `CameraConfig`."""
        return self.timed


class _Streamed(CameraConfig):
    """What a camera that keeps its own time needs."""

    width_px: int | None = Field(None, ge=16, le=65536, description="left out: as the camera is")
    height_px: int | None = Field(None, ge=16, le=65536)
    timeout_s: float = Field(2.0, gt=0, le=60, description="without a frame: the camera stalls")
    buffer_s: float = Field(2.0, gt=0, le=20, description="frames kept for a program that is late")
    latency_s: float | None = Field(
        None,
        ge=0,
        le=1,
        description="from the end of an exposure (v4l2: its middle) to arrival; None: not measured",
    )
    most_dropped: float = Field(0.1, ge=0, le=1, description="share of lost frames that is allowed")

    @property
    def is_timed_by_exposures(self) -> bool:
        """See `CameraConfig`."""
        return True

    @property
    def timing(self) -> Timing:
        """What is known of its frames' times."""
        return Timing(self.timeout_s, self.latency_s, self.buffer_s, self.most_dropped)


class AravisConfig(_Streamed, _Stamped):
    """GenICam over GigE Vision or USB3 Vision, through the library Aravis."""

    sets_exposure: ClassVar[bool] = True
    kind: Literal["aravis"]
    name: str | None = Field(
        None, min_length=1, description="as arv-tool prints it; None: the first"
    )
    serial_number: str | None = Field(None, description="another camera is refused")
    x_px: int = Field(0, ge=0, description="where the picture begins on the sensor")
    y_px: int = Field(0, ge=0)
    exposure_s: float | None = Field(None, gt=0, le=10, description="left out: as the camera is")
    gain: float | None = Field(None, description="in the camera's own unit")
    trigger: str | None = Field(None, description="input that starts each exposure, as Line1")
    packet_bytes: int | None = Field(
        None, ge=576, le=16384, description="GigE Vision; left out: the largest that gets through"
    )


class V4l2Config(_Streamed):
    """A webcam or another camera of Linux's V4L2, through FFmpeg."""

    kind: Literal["v4l2"]
    device: str = Field("/dev/video0", min_length=1)
    name: str | None = Field(None, description="what the driver calls it; another one is refused")
    format: Literal["gray", "yuyv422", "uyvy422", "nv12", "yuv420p", "mjpeg"] = "yuyv422"

    @model_validator(mode="after")
    def _size(self) -> Self:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("width_px and height_px belong together")
        return self


class FolderConfig(CameraConfig):
    """A folder of images, or a video file, as a camera: its frames come with the blocks."""

    kind: Literal["folder"]
    path: str = Field(min_length=1, description="of the folder or the file")
    repeat: bool = Field(False, description="begin again after the last frame")
