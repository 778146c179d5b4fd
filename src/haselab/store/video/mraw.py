"""Photron `.mraw`: raw frames beside a `.cihx` or `.cih` header."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from haselab.store.text_file import check_regular
from haselab.store.video.reader import MOST_PIXELS, Frame, VideoReader, broken

__all__ = ["MrawReader"]

_LONGEST_HEADER = 1 << 24
_FASTEST_HZ = 1e9
_SAVE_AGAIN = "Save the recording again from the camera maker's program as grey MRAW."


@dataclass(frozen=True)
class _Header:
    """The part of a header that the frames need."""

    count: int
    width: int
    height: int
    bits: int
    depth: int
    rate_hz: float
    format: str


def _bytes(path: Path) -> bytes:
    if check_regular(path) > _LONGEST_HEADER:
        raise broken("The header is too long to be one", "Copy it again.", path)
    return path.read_bytes()


def _read_cihx(path: Path) -> _Header:
    match = re.search(rb"<cih>.*</cih>", _bytes(path), re.DOTALL)
    if match is None:
        raise broken(
            "The header contains no <cih> section", "It is truncated. Copy it again.", path
        )
    root = ElementTree.fromstring(match.group().decode("utf-8", errors="replace"))
    depth = int(root.findtext("imageDataInfo/effectiveBit/depth", "0"))
    return _Header(
        count=int(root.findtext("frameInfo/totalFrame", "")),
        width=int(root.findtext("imageDataInfo/resolution/width", "")),
        height=int(root.findtext("imageDataInfo/resolution/height", "")),
        bits=int(root.findtext("imageDataInfo/colorInfo/bit", "")),
        depth=depth,
        rate_hz=float(root.findtext("recordInfo/recordRate", "0")),
        format=root.findtext("imageFileInfo/fileFormat", ""),
    )


def _read_cih(path: Path) -> _Header:
    fields = {}
    for line in _bytes(path).decode("utf-8", errors="replace").splitlines():
        name, separator, value = line.partition(" : ")
        if separator:
            fields[name.strip()] = value.strip()
    return _Header(
        count=int(fields["Total Frame"]),
        width=int(fields["Image Width"]),
        height=int(fields["Image Height"]),
        bits=int(fields["Color Bit"]),
        depth=int(fields.get("EffectiveBit Depth", "0")),
        rate_hz=float(fields.get("Record Rate(fps)", "0")),
        format=fields.get("File Format", ""),
    )


def _read_header(path: Path) -> _Header:
    for suffix, read in ((".cihx", _read_cihx), (".cih", _read_cih)):
        header = path.with_suffix(suffix)
        if header.is_file():
            try:
                return read(header)
            except (ElementTree.ParseError, KeyError, ValueError) as error:
                if isinstance(error, ValueError) and type(error) is not ValueError:
                    raise
                raise broken(
                    f"The header lacks a number or is damaged ({error})",
                    "Copy it again from the camera's computer.",
                    header,
                ) from None
    raise broken(
        f"There is no header {path.stem}.cihx or {path.stem}.cih beside the frames",
        "Copy it into the same folder.",
        path,
    )


class MrawReader(VideoReader):
    """Frames of an `.mraw` file: 8 bit, 16 bit, or 12 bit packed two pixels in three bytes.

    Args:
        path: of the `.mraw` file; its header is beside it.

    Raises:
        InputError: the header is missing or damaged, or the frames are colour; in `timed`, after
            the last whole frame, that the file is shorter than its header says.

    Source: file layout as published with pyMRAW.
    """

    def __init__(self, path: Path) -> None:
        header = _read_header(path)
        if header.bits not in (8, 12, 16) or header.format.lower() != "mraw":
            raise broken(
                f"The recording is {header.format!r} with {header.bits} bits per pixel; supported "
                "is 'Mraw' with 8, 12 or 16",
                _SAVE_AGAIN,
                path,
            )
        pixels = header.width * header.height
        if min(header.width, header.height, header.count) < 1 or pixels > MOST_PIXELS:
            raise broken(
                f"The header states {header.count} frames of {header.width} x {header.height} px; "
                f"supported is at least one, of up to {MOST_PIXELS} pixels",
                "Copy it again from the camera's computer.",
                path,
            )
        if not 0.0 <= header.rate_hz <= _FASTEST_HZ:
            raise broken(
                f"The header states {header.rate_hz:g} frames per second", _SAVE_AGAIN, path
            )
        depth = header.depth if 0 < header.depth <= header.bits else header.bits
        super().__init__(path, rate_hz=header.rate_hz or None, lossy=False, bit_depth=depth)
        self._header = header
        self._frame_bytes = header.width * header.height * header.bits // 8

    @property
    def frame_count(self) -> int:
        """Number of frames by the header."""
        return self._header.count

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s from the first frame, and the frame."""
        return self._from(0)

    def _at(self, index: int) -> tuple[float, Frame]:
        return next(self._from(index))

    def _from(self, first: int) -> Iterator[tuple[float, Frame]]:
        shape = (self._header.height, self._header.width)
        with self.path.open("rb") as file:
            file.seek(first * self._frame_bytes)
            for index in range(first, self._header.count):
                raw = file.read(self._frame_bytes)
                if len(raw) < self._frame_bytes:
                    raise self._truncated()
                yield self.time_s(index), _unpack_frame(raw, self._header.bits).reshape(shape)

    def _truncated(self) -> Exception:
        header, got = self._header, self.path.stat().st_size
        return broken(
            f"The file has {got} bytes, {header.count} frames of {header.width} x {header.height} "
            f"px at {header.bits} bits need {header.count * self._frame_bytes}",
            "It is truncated. Copy it again.",
            self.path,
        )


def _unpack_frame(raw: bytes, bits: int) -> Frame:
    if bits == 8:
        return np.frombuffer(raw, np.uint8)
    if bits == 16:
        return np.frombuffer(raw, np.dtype("<u2")).astype(np.uint16, copy=False)
    high, middle, low = np.frombuffer(raw, np.uint8).reshape(-1, 3).T.astype(np.uint16, order="C")
    pixels = np.empty(2 * high.size, np.uint16)
    np.left_shift(high, 4, out=high)
    np.bitwise_or(high, middle >> 4, out=pixels[0::2])
    np.bitwise_and(middle, 0x0F, out=middle)
    np.left_shift(middle, 8, out=middle)
    np.bitwise_or(middle, low, out=pixels[1::2])
    return pixels
