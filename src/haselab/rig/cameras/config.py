"""Section `camera` of RIG.toml: the cameras that come with this package."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from haselab.rig.cameras.timed import Timing
from haselab.rig.instruments.sections import CameraConfig

__all__ = ["AravisConfig", "FolderConfig", "TwinCameraConfig", "V4l2Config"]


class _Stamped(CameraConfig):
    """A camera with its own clock."""

    stamps: Literal["camera", "arrival"] = Field(
        "camera", description="clock that times the frames; arrival: ignore the camera's clock"
    )
    tick_hz: float | None = Field(
        None, gt=0, le=1e12, description="of the camera's time stamps; omit: nanoseconds"
    )


class TwinCameraConfig(_Stamped):
    """The camera of a served twin."""

    kind: Literal["twin"]
    address: str = Field(
        min_length=1, description="host:port of the twin", examples=["127.0.0.1:31763"]
    )
    timed: bool = Field(
        False, description="frames arrive late and are timed like those of a real camera"
    )
    exposure_s: float | None = Field(
        None, gt=0, le=10, description="only with timed; omit: as in the twin's file"
    )

    @property
    def is_timed_by_exposures(self) -> bool:
        """See `CameraConfig`."""
        return self.timed


class _Streamed(CameraConfig):
    """Settings of a camera whose frames the computer times."""

    width_px: int | None = Field(None, ge=16, le=65536, description="omit: unchanged")
    height_px: int | None = Field(None, ge=16, le=65536)
    timeout_s: float = Field(2.0, gt=0, le=60, description="longest time without a frame")
    buffer_s: float = Field(2.0, gt=0, le=20, description="duration of the buffered frames")
    latency_s: float | None = Field(
        None,
        ge=0,
        le=1,
        description="from the end of an exposure (v4l2: its middle) to arrival; omit: not measured",
    )
    most_dropped: float = Field(0.1, ge=0, le=1, description="largest fraction of lost frames")

    @property
    def is_timed_by_exposures(self) -> bool:
        """See `CameraConfig`."""
        return True

    @property
    def timing(self) -> Timing:
        """Timing settings of its frames."""
        return Timing(self.timeout_s, self.latency_s, self.buffer_s, self.most_dropped)


class AravisConfig(_Streamed, _Stamped):
    """GenICam camera over GigE Vision or USB3 Vision, through the library Aravis."""

    sets_exposure: ClassVar[bool] = True
    kind: Literal["aravis"]
    name: str | None = Field(
        None, min_length=1, description="as arv-tool-0.8 prints it; omit: the first one"
    )
    serial_number: str | None = Field(None, description="another camera is refused")
    x_px: int = Field(0, ge=0, description="first column of the image on the sensor")
    y_px: int = Field(0, ge=0)
    exposure_s: float | None = Field(None, gt=0, le=10, description="omit: unchanged")
    gain: float | None = Field(None, description="in the camera's own unit")
    trigger: str | None = Field(None, description="input that starts each exposure, such as Line1")
    packet_bytes: int | None = Field(
        None,
        ge=576,
        le=16384,
        description="GigE Vision; omit: the largest that the network accepts",
    )


class V4l2Config(_Streamed):
    """A webcam or another V4L2 camera on Linux, through FFmpeg."""

    kind: Literal["v4l2"]
    device: str = Field("/dev/video0", min_length=1)
    name: str | None = Field(None, description="the driver's name; another camera is refused")
    format: Literal["gray", "yuyv422", "uyvy422", "nv12", "yuv420p", "mjpeg"] = "yuyv422"

    @model_validator(mode="after")
    def _size(self) -> Self:
        if (self.width_px is None) != (self.height_px is None):
            raise ValueError("set both width_px and height_px, or neither")
        return self


class FolderConfig(CameraConfig):
    """A folder of images or a video file as a camera; its frames follow the blocks' time."""

    kind: Literal["folder"]
    path: str = Field(min_length=1, description="folder of images, or a video", examples=["frames"])
    repeat: bool = Field(False, description="start again after the last frame")
