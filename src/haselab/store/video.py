"""Video in: whatever FFmpeg reads, image folders, TIFF stacks, `.cine`, `.mraw`."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
import tifffile
from numpy.typing import NDArray

from haselab.store.cine import CineReader
from haselab.store.mraw import MrawReader
from haselab.store.video_reader import Frame, VideoReader, broken

__all__ = ["VideoReader", "open_video"]

_LOSSLESS = frozenset(
    (
        *("rawvideo", "ffv1", "huffyuv", "ffvhuff", "utvideo", "magicyuv", "lagarith", "qtrle"),
        *("png", "apng", "bmp", "tiff", "pgm", "pgmyuv", "ppm", "pam", "sgi", "targa"),
        *("zlib", "zmbv", "v210", "v410", "r210"),
    )
)
_TIFF = (".tif", ".tiff")
_IMAGES = (".png", ".bmp", ".pgm", ".pnm", ".jpg", ".jpeg", *_TIFF)
_COPY_AGAIN = "It is truncated or damaged; copy it again."


def open_video(path: Path | str) -> VideoReader:
    """Opens a video, a folder of images (in name order), a TIFF stack, `.cine` or `.mraw`.

    Grey levels are as stored: plane 0 (luma) of YUV and grey video, in whichever range, limited
    or full, the file carries, never stretched. A constant stretch does not move a point. Colour
    coded as RGB is turned to luma (ITU-R BT.601 weights, full range).

    Args:
        path: of the file or folder.

    Returns:
        A reader; use it in a `with` statement.

    Raises:
        InputError: no such file, or it cannot be read.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "stack.tif"
        ...     tifffile.imwrite(path, np.zeros((3, 4, 5), np.uint8), photometric="minisblack")
        ...     with open_video(path) as video:
        ...         [frame.shape for frame in video]
        [(4, 5), (4, 5), (4, 5)]
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return _ImageFolder(path)
    if not path.is_file():
        raise broken("There is no such video file or folder of images", "Check the name.", path)
    if path.stat().st_size == 0:
        raise broken("The video file is empty", "Record or copy it again.", path)
    if suffix == ".cine":
        return CineReader(path)
    if suffix == ".mraw":
        return MrawReader(path)
    if suffix in _TIFF:
        return _TiffStack(path)
    return _Container(path)


def _read_times(path: Path) -> list[float]:
    """Times of a table with the columns `frame`, `time_s` alone; empty when there is none."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        rows = csv.reader(file)
        if next(rows, None) != ["frame", "time_s"]:
            return []
        try:
            return [float(row[1]) for row in rows]
        except (ValueError, IndexError):
            raise broken("The table of frame times is damaged", _COPY_AGAIN, path) from None


class _Container(VideoReader):
    """A file that FFmpeg reads; a table `frame,time_s` of its name gives the exact times."""

    def __init__(self, path: Path) -> None:
        with _opened(path) as container:
            stream = container.streams.video[0]
            codec = stream.codec_context
            rate = float(stream.average_rate) if stream.average_rate else None
            parts = codec.format.components if codec.format else ()
            depth = max((part.bits for part in parts), default=8)
            self._stated = stream.frames
            self._least = stream.frames or _frames_by_duration(container, rate)
            lossy = codec.name not in _LOSSLESS
        super().__init__(path, rate_hz=rate, lossy=lossy, bit_depth=depth)
        self._times_s = _read_times(path.with_suffix(".csv"))

    @cached_property
    def _packets(self) -> int:
        with _opened(self.path) as container:
            return sum(packet.size > 0 for packet in container.demux(video=0))

    @property
    def frame_count(self) -> int:
        """Number of frames that the container states, else that it holds."""
        return self._stated or self._packets

    def _time_s(self, index: int, picture: av.VideoFrame, first_s: float) -> float:
        """Time from the first frame: the table's, the nominal, or the stamp's where they differ.

        Containers round their stamps (Matroska to 1 ms); within that the nominal time is exact.
        """
        if index < len(self._times_s):
            return self._times_s[index] - self._times_s[0]
        nominal = self.time_s(index)
        if picture.time is None:
            return nominal
        stamp = picture.time - first_s
        step = float(picture.time_base or 0.0)
        return nominal if abs(stamp - nominal) <= step else stamp

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s from the first frame, and the frame."""
        count, first_s = 0, 0.0
        with _opened(self.path) as container:
            container.streams.video[0].thread_type = "AUTO"
            try:
                for picture in container.decode(video=0):
                    first_s = picture.time or 0.0 if count == 0 else first_s
                    yield self._time_s(count, picture, first_s), _luma(picture)
                    count += 1
            except av.error.FFmpegError as error:
                raise broken(
                    f"The video cannot be decoded after frame {count} ({error.strerror})",
                    _COPY_AGAIN,
                    self.path,
                ) from None
        if count == 0 or (count < self._least and self._packets < self._least):
            raise broken(
                f"The video holds {count} frames, by its header at least {max(self._least, 1)}",
                _COPY_AGAIN,
                self.path,
            )


def _frames_by_duration(container: av.container.InputContainer, rate: float | None) -> int:
    """Frames that the stated duration asks for, less 2 % and one for uneven time stamps."""
    if rate is None or not container.duration or len(container.streams) > 1:
        return 0
    return int(0.98 * rate * container.duration / av.time_base - 1.0)


def _opened(path: Path) -> av.container.InputContainer:
    try:
        container = av.open(str(path))
    except av.error.FFmpegError as error:
        raise broken(
            f"FFmpeg cannot open the video ({error.strerror})",
            "Take a format that FFmpeg reads, a folder of images, a TIFF stack, .cine or .mraw, "
            "and check that the copy is complete.",
            path,
        ) from None
    if not container.streams.video:
        container.close()
        raise broken("The file holds no video stream", "Check the file.", path)
    return container


def _luma(picture: av.VideoFrame) -> Frame:
    """Plane 0 without padding; colour that has no luma plane is converted."""
    form = picture.format
    first = form.components[0]
    packed = form.name in ("yuyv422", "uyvy422", "yvyu422", "ya8", "ya16le", "ya16be")
    if packed or form.is_rgb or form.has_palette or form.is_bit_stream or not first.is_luma:
        return picture.to_ndarray(format="gray").astype(np.uint8, copy=False)
    plane = picture.planes[0]
    wide = first.bits > 8
    kind = np.dtype("u1" if not wide else (">u2" if form.is_big_endian else "<u2"))
    rows = np.frombuffer(memoryview(plane), kind).reshape(-1, plane.line_size // kind.itemsize)
    pixels = rows[: picture.height, : picture.width]
    return pixels.astype(np.uint16) if wide else pixels.astype(np.uint8)


def _grey(image: NDArray[Any], path: Path) -> Frame:
    """A TIFF page as a frame."""
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise broken(
            f"The image is {image.dtype} of shape {image.shape}; read are uint8 and uint16 of "
            "shape (H, W)",
            "Save it as 8 or 16 bit grey.",
            path,
        )
    return np.ascontiguousarray(image)


class _TiffStack(VideoReader):
    """The pages of one TIFF file."""

    def __init__(self, path: Path) -> None:
        self._handle = path.open("rb")
        try:
            self._file = tifffile.TiffFile(self._handle, name=path.name)
            page = self._file.pages.first
        except (tifffile.TiffFileError, IndexError, ValueError) as error:
            self._handle.close()
            raise broken(f"The TIFF file cannot be read ({error})", _COPY_AGAIN, path) from None
        lossy = page.compression in (6, 7, 33003, 33004, 33005, 34712, 50001)
        super().__init__(path, rate_hz=None, lossy=lossy, bit_depth=int(page.bitspersample))

    @property
    def frame_count(self) -> int:
        """Number of pages."""
        return len(self._file.pages)

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """NaN (a TIFF file has no rate), and the page."""
        for index in range(self.frame_count):
            try:
                image = self._file.pages[index].asarray()
            except (tifffile.TiffFileError, ValueError, RuntimeError) as error:
                raise broken(
                    f"Page {index} of {self.frame_count} cannot be read ({error})",
                    _COPY_AGAIN,
                    self.path,
                ) from None
            yield self.time_s(index), _grey(image, self.path)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._handle.close()


class _ImageFolder(VideoReader):
    """The images of a folder in name order; `times.csv` (`frame,time_s`) is read if present."""

    def __init__(self, path: Path) -> None:
        self._files = sorted(f for f in path.iterdir() if f.suffix.lower() in _IMAGES)
        if not self._files:
            raise broken(
                f"The folder holds no image ({', '.join(_IMAGES)})", "Check the folder.", path
            )
        with open_video(self._files[0]) as first:
            lossy, depth = first.lossy, first.bit_depth
        super().__init__(path, rate_hz=None, lossy=lossy, bit_depth=depth)
        self._times_s = _read_times(path / "times.csv")

    @property
    def frame_count(self) -> int:
        """Number of images."""
        return len(self._files)

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s by `times.csv`, NaN without it, and the image."""
        for index, file in enumerate(self._files):
            known = index < len(self._times_s)
            now = self._times_s[index] - self._times_s[0] if known else self.time_s(index)
            with open_video(file) as image:
                yield now, next(iter(image))
