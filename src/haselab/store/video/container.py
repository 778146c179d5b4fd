"""Videos that FFmpeg reads: the exact luma plane of each frame, and its time."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import av
import av.error
import numpy as np

from haselab.base import InputError
from haselab.store.text_file import read_text
from haselab.store.video.reader import (
    COLOUR_RULE,
    MOST_PIXELS,
    Frame,
    VideoReader,
    alike,
    broken,
    luma_of_colour,
)

__all__ = ["ContainerReader", "read_times"]

_LOSSLESS = frozenset(
    (
        *("rawvideo", "ffv1", "huffyuv", "ffvhuff", "utvideo", "magicyuv", "lagarith", "qtrle"),
        *("png", "apng", "bmp", "tiff", "pgm", "pgmyuv", "ppm", "pam", "sgi", "targa"),
        *("zlib", "zmbv", "v210", "v410", "r210", "bitpacked", "gif"),
    )
)
# with loss or without, and the stream does not say
_EITHER = frozenset(("jpeg2000", "jpegls", "vp9", "av1", "webp", "jpegxl", "dirac", "cfhd"))
_STORE_STAMPS = ("matroska,webm", "mov,mp4,m4a,3gp,3g2,mj2")
_X264_LOSSLESS = re.compile(rb"x264 - core.{0,2000}?(?<![a-z_])(qp|crf)=0(\.0+)?[\s\0]", re.DOTALL)
_COPY_AGAIN = "It is truncated or damaged. Copy it again."
# Luma among other things in plane 0: first item and stride, in items of a sample.
_PACKED = {"yuyv422": (0, 2), "yvyu422": (0, 2), "uyvy422": (1, 2)}
_PACKED |= dict.fromkeys(("ya8", "ya16le", "ya16be"), (0, 2))
_HIGH_BITS = ("p010", "p012", "p210", "p212", "p410", "p412")  # padded with zeros below


def read_times(path: Path) -> list[float]:
    """Times of a table with the columns `frame`, `time_s` alone; empty when there is none.

    Raises:
        InputError: a time is not a number.
    """
    if not path.is_file():
        return []
    rows = csv.reader(read_text(path).splitlines())
    try:
        if next(rows, None) != ["frame", "time_s"]:
            return []
        times_s = [float(row[1]) for row in rows]
    except (ValueError, IndexError, csv.Error):
        times_s = [math.nan]
    if not all(math.isfinite(time_s) for time_s in times_s):
        raise broken("The table of frame times is damaged", _COPY_AGAIN, path)
    return times_s


class ContainerReader(VideoReader):
    """A file that FFmpeg reads; a table `frame,time_s` of its name gives the exact times.

    Args:
        path: of the file.

    Raises:
        InputError: FFmpeg cannot open it, or it holds no video.
    """

    def __init__(self, path: Path) -> None:
        with _opened(path) as container:
            stream = container.streams.video[0]
            codec = stream.codec_context
            rate = float(stream.average_rate) if stream.average_rate else None
            form = codec.format
            depth = max((part.bits for part in form.components), default=8) if form else 8
            self._stated = stream.frames
            self._by_duration = _frames_by_duration(container, rate)
            alone = len(container.streams) == 1
            self._least = stream.frames or (int(0.98 * self._by_duration - 1.0) if alone else 0)
            super().__init__(
                path,
                rate_hz=rate,
                lossy=_loss(container),
                bit_depth=8 if form is not None and form.has_palette else min(depth, 16),
                codec=codec.name,
                levels=_levels(form, codec.color_range),
            )
        self._times_s = read_times(path.with_suffix(".csv"))

    @property
    def _stamps(self) -> tuple[int | None, ...]:
        """Time stamps of all frames, in the order of the file."""
        return _packet_stamps(self.path, self.path.stat().st_mtime_ns)

    @property
    def _packets(self) -> int:
        return len(self._stamps)

    @property
    def frame_count(self) -> int:
        """Number of frames that the container states, else that it holds."""
        return self._stated or self._packets

    @property
    def frames_expected(self) -> int:
        """As the container states, else by its duration and rate."""
        return self._stated or self._by_duration

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
        """Time in s from the first frame, and the frame; decoded by all cores."""
        return alike(self._decoded(), self.path)

    def _at(self, index: int) -> tuple[float, Frame]:
        """A frame by its time stamp, from the key frame before it; else after all before it."""
        stamps = sorted(stamp for stamp in self._stamps if stamp is not None)
        if index == 0 or len(set(stamps)) < self._packets:
            return super()._at(index)
        with _opened(self.path) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            try:
                container.seek(stamps[index], stream=stream)
                for picture in container.decode(video=0):
                    if picture.pts == stamps[index]:
                        first_s = float(stamps[0] * (picture.time_base or 0))
                        return self._time_s(index, picture, first_s), _luma(picture).copy()
                    if picture.pts is None or picture.pts > stamps[index]:
                        break
            except av.error.FFmpegError:  # reported where the frames before it are read
                pass
        return super()._at(index)

    def _decoded(self) -> Iterator[tuple[float, Frame]]:
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
                f"The video contains {count} frames, but its header states at least "
                f"{max(self._least, 1)}",
                _COPY_AGAIN,
                self.path,
            )


@lru_cache(maxsize=4)
def _packet_stamps(path: Path, modified_ns: int) -> tuple[int | None, ...]:
    """Time stamps of all packets with a frame, without decoding them.

    They are None where the container does not store them and the order of the frames is not that
    of the packets.
    """
    with _opened(path) as container:
        packets = [
            (packet.pts, packet.is_keyframe)
            for packet in container.demux(video=0)
            if packet.size > 0
        ]
        stored = container.format.name in _STORE_STAMPS or all(key for _, key in packets)
        return tuple(pts if stored else None for pts, _ in packets)


def _frames_by_duration(container: av.container.InputContainer, rate: float | None) -> int:
    """Frames that the stated duration asks for, at even time stamps."""
    if rate is None or not container.duration:
        return 0
    return round(rate * container.duration / av.time_base)


def _opened(path: Path) -> av.container.InputContainer:
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "unreadable text in its header"
        raise broken(
            f"FFmpeg cannot open the video ({reason})",
            "Use a format that FFmpeg reads, a folder of images, a TIFF stack, .cine or .mraw, "
            "and check that the copy is complete.",
            path,
        ) from None
    try:
        _check_stream(container, path)
    except InputError:
        container.close()
        raise
    return container


def _check_stream(container: av.container.InputContainer, path: Path) -> None:
    """Refuse what cannot be decoded, before memory is taken for it."""
    if not container.streams.video:
        raise broken("The file contains no video stream", "Check the file.", path)
    codec: av.VideoCodecContext | None = container.streams.video[0].codec_context
    if codec is None:
        raise broken(
            "FFmpeg has no decoder for the video",
            "Convert it to FFV1, raw video or a TIFF stack.",
            path,
        )
    if codec.width * codec.height > MOST_PIXELS:
        raise broken(
            f"The video states frames of {codec.width} x {codec.height} px; supported are up to "
            f"{MOST_PIXELS} pixels",
            _COPY_AGAIN,
            path,
        )


def _loss(container: av.container.InputContainer) -> bool | None:
    """By the codec; x264 writes into its first packet whether it works without loss."""
    codec = container.streams.video[0].codec_context
    if codec.name in _LOSSLESS:
        return False
    if codec.name in _EITHER:
        return None
    if codec.name != "h264" or "4:4:4" not in (codec.profile or ""):
        return True
    try:
        first = next((bytes(p) for p in container.demux(video=0) if p.size), b"")
    except av.error.FFmpegError:
        return None
    known = (codec.extradata or b"") + first
    return False if _X264_LOSSLESS.search(known) else None


def _is_colour(form: av.VideoFormat) -> bool:
    return bool(form.is_rgb or form.has_palette or not form.components[0].is_luma)


def _is_grey(form: av.VideoFormat) -> bool:
    return len(form.components) == 1 or form.name.startswith("ya")


def _levels(form: av.VideoFormat | None, color_range: int) -> str:
    """What a grey level is, in words; limited is what video of colour means where it is silent."""
    if form is None or _is_grey(form):
        return "grey as stored"
    if _is_colour(form):
        return COLOUR_RULE
    full = int(color_range) == 2 or form.name.startswith("yuvj")
    return f"luma as stored, {'full' if full else 'limited'} range"


def _plane(picture: av.VideoFrame, bits: int) -> Frame:
    """Rows of plane 0 with their padding, in the machine's byte order."""
    plane = picture.planes[0]
    memory = memoryview(plane)
    if bits <= 8:
        bytes_ = np.frombuffer(memory, np.uint8).reshape(-1, plane.line_size)
        return bytes_[: picture.height]
    order = ">u2" if picture.format.is_big_endian else "<u2"
    words = np.frombuffer(memory, np.dtype(order)).reshape(-1, plane.line_size // 2)
    return words[: picture.height].astype(np.uint16, copy=False)


def _luma(picture: av.VideoFrame) -> Frame:
    """Plane 0 as stored, without padding; what has no luma is converted by the stated rule."""
    form = picture.format
    if _is_colour(form):
        return _luma_of_colour(picture)
    first = form.components[0]
    width = picture.width
    if form.name in _PACKED:
        start, step = _PACKED[form.name]
        return _plane(picture, first.bits)[:, start : step * width : step].copy()
    shares = sum(part.plane == first.plane for part in form.components) > 1
    if shares or form.is_bit_stream or first.bits > 16:  # y210, mono, float
        if first.bits > 8:
            return np.asarray(picture.to_ndarray(format="gray16le"), np.uint16)
        return np.asarray(picture.to_ndarray(format="gray"), np.uint8)
    pixels = _plane(picture, first.bits)[:, :width]
    if form.name.startswith(_HIGH_BITS):
        return pixels.astype(np.uint16, copy=False) >> np.uint16(16 - first.bits)
    return pixels


def _luma_of_colour(picture: av.VideoFrame) -> Frame:
    deep = max(part.bits for part in picture.format.components) > 8
    return luma_of_colour(picture.to_ndarray(format="rgb48le" if deep else "rgb24"))
