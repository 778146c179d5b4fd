"""Vision Research `.cine`: uncompressed grey frames, the bit depth as the camera states it."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from haselab.store.video.reader import MOST_PIXELS, Frame, VideoReader, broken

__all__ = ["CineReader"]

_FILE_HEADER = struct.Struct("<2sHHHiIiIIII8x")
_BITMAP_HEADER = struct.Struct("<IiiHHIIiiII")
_SETUP_LENGTH, _SETUP_RATE, _SETUP_FILTER, _SETUP_DEPTH = 142, 768, 808, 896
_BLOCK = struct.Struct("<IHH")
_IMAGE_TIMES = 1002
_CONVERT = "Convert it to uncompressed grey with the camera maker's program."


@dataclass(frozen=True)
class _Layout:
    """Where things are in one file."""

    count: int
    width: int
    height: int
    bits: int
    setup: int
    offsets: int
    rate_hz: float
    depth: int


def _unpack(file: BinaryIO, at: int, form: struct.Struct, path: Path) -> tuple[Any, ...]:
    size = os.fstat(file.fileno()).st_size
    if not 0 <= at <= size - form.size:
        raise broken(
            f"The .cine file has {size} bytes, its header names bytes {at} to {at + form.size}",
            "It is truncated or damaged. Copy it again.",
            path,
        )
    file.seek(at)
    return form.unpack(file.read(form.size))


def _layout(file: BinaryIO, path: Path) -> _Layout:
    head = _unpack(file, 0, _FILE_HEADER, path)
    if head[0] != b"CI":
        raise broken(
            f"The file begins with {head[0]!r}, but a .cine file begins with b'CI'",
            "Check the file.",
            path,
        )
    compression, count, bitmap, setup, offsets = head[2], head[7], head[8], head[9], head[10]
    _, width, height, _, bits, packing, *_ = _unpack(file, bitmap, _BITMAP_HEADER, path)
    word = struct.Struct("<I")
    rate, mosaic, depth = (
        _unpack(file, setup + at, word, path)[0]
        for at in (_SETUP_RATE, _SETUP_FILTER, _SETUP_DEPTH)
    )
    if compression or packing or bits not in (8, 16) or mosaic:
        raise broken(
            f"The .cine file has compression {compression}, packing {packing}, {bits} bits a "
            f"pixel and colour filter {mosaic}; supported are 0, 0, 8 or 16, and 0",
            _CONVERT,
            path,
        )
    if min(width, abs(height), count) < 1 or width * abs(height) > MOST_PIXELS:
        raise broken(
            f"The header states {count} frames of {width} x {height} px; supported is at least "
            f"one, of up to {MOST_PIXELS} pixels",
            "Copy the file again.",
            path,
        )
    size = path.stat().st_size
    if offsets + 8 * count > size:
        raise broken(
            f"The .cine file ends at byte {size}, but its header extends to byte "
            f"{offsets + 8 * count}",
            "It is truncated. Copy it again.",
            path,
        )
    depth = depth if 0 < depth <= bits else bits
    return _Layout(count, width, height, bits, setup, offsets, float(rate), depth)


class CineReader(VideoReader):
    """Frames of a `.cine` file, values as stored; rows are turned so that y points down.

    The rate is that of the time stamps, which knows of frames left out when the file was saved.

    Args:
        path: of the file.

    Raises:
        InputError: not a cine file, truncated, compressed, packed or colour.

    Source: Vision Research, Cine File Format (AN00100).
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        try:
            layout = _layout(self._file, path)
            super().__init__(
                path, rate_hz=layout.rate_hz or None, lossy=False, bit_depth=layout.depth
            )
            self._layout = layout
            pointers = struct.Struct(f"<{layout.count}q")
            self._offsets = _unpack(self._file, layout.offsets, pointers, path)
            self._times_s = self._read_times()
            if self._times_s[-1] > 0.0:
                self.rate_hz = (layout.count - 1) / self._times_s[-1]
        except BaseException:
            self._file.close()
            raise

    @property
    def frame_count(self) -> int:
        """Number of frames in the file."""
        return self._layout.count

    def _read_times(self) -> list[float]:
        """Time stamps from the first frame, in s; from the rate when the file has none."""
        layout = self._layout
        at = (
            layout.setup
            + _unpack(self._file, layout.setup + _SETUP_LENGTH, struct.Struct("<H"), self.path)[0]
        )
        while at + _BLOCK.size <= layout.offsets:
            size, kind, _ = _unpack(self._file, at, _BLOCK, self.path)
            if kind == _IMAGE_TIMES and size == _BLOCK.size + 8 * layout.count:
                form = struct.Struct(f"<{layout.count}Q")
                stamps = _unpack(self._file, at + _BLOCK.size, form, self.path)
                return [(stamp - stamps[0]) / 2**32 for stamp in stamps]
            if size < _BLOCK.size:
                break
            at += size
        return [self.time_s(index) for index in range(layout.count)]

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s from the first frame, and the frame."""
        return map(self._at, range(self._layout.count))

    def _at(self, index: int) -> tuple[float, Frame]:
        layout, offset = self._layout, self._offsets[index]
        pixels = layout.width * abs(layout.height)
        kind = np.dtype("<u2" if layout.bits == 16 else "u1")
        annotation = _unpack(self._file, offset, struct.Struct("<I"), self.path)[0]
        self._file.seek(offset + annotation)
        raw = self._file.read(pixels * kind.itemsize)
        if len(raw) < pixels * kind.itemsize:
            raise broken(
                f"The .cine file ends within frame {index} of {layout.count}",
                "It is truncated. Copy it again.",
                self.path,
            )
        image = np.frombuffer(raw, kind).reshape(abs(layout.height), layout.width)
        if layout.height > 0:  # a bitmap of positive height is stored from the bottom up
            image = image[::-1]
        return self._times_s[index], np.ascontiguousarray(image)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
