"""Videos of still images: TIFF stacks and folders."""

from __future__ import annotations

import logging
import math
import re
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np
import tifffile
from numpy.typing import NDArray

from haselab.base import InputError, described
from haselab.store.video.container import ContainerReader, read_times
from haselab.store.video.reader import (
    COLOUR_RULE,
    MOST_PIXELS,
    Frame,
    VideoReader,
    alike,
    broken,
    luma_of_colour,
)

__all__ = ["IMAGES", "TIFF", "FolderReader", "TiffReader", "image_numbers", "natural_order"]

TIFF = (".tif", ".tiff")
IMAGES = (".png", ".bmp", ".pgm", ".pnm", ".ppm", ".jpg", ".jpeg", *TIFF)
_READERS = 2
_MOST_GAPS = 100  # recorded frames for each image that is left; beyond, names hold no count
_COPY_AGAIN = "It is truncated or damaged. Copy it again."
_LOSSY_TIFF = (6, 7, 33003, 33004, 33005, 34712, 50001)


def _grey(image: NDArray[Any], path: Path) -> Frame:
    """A TIFF page as a frame."""
    colour = image.ndim == 3 and 3 in (image.shape[0], image.shape[2], image.shape[2] - 1)
    if image.dtype in (np.uint8, np.uint16) and colour:
        planar = image.shape[0] == 3 and image.shape[2] not in (3, 4)
        return luma_of_colour(np.moveaxis(image, 0, 2) if planar else image)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise broken(
            f"The image is {image.dtype} of shape {image.shape}; supported are uint8 and uint16 of "
            "shape (H, W) or (H, W, 3)",
            "Save it as 8 or 16 bit.",
            path,
        )
    return np.ascontiguousarray(image)


def _check_size(page: Any, path: Path) -> None:
    """Refuse a page whose header asks for more than any camera has."""
    pixels = math.prod(page.shape)
    if not 0 < pixels <= MOST_PIXELS:
        raise broken(
            f"The image has {page.shape} pixels; supported are 1 to {MOST_PIXELS}",
            _COPY_AGAIN,
            path,
        )


class _Complaints(logging.Handler):
    """What tifffile logs of a damaged file, instead of printing it."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the message, without the name of tifffile's object."""
        self.lines.append(record.getMessage().rpartition("> ")[2])

    def __enter__(self) -> Self:
        logging.getLogger("tifffile").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger("tifffile").removeHandler(self)


class _Run:
    """Frames one after the other in a file, uncompressed: read without asking for each page."""

    def __init__(self, series: tifffile.TiffPageSeries, byte_order: str) -> None:
        self.at = series.dataoffset or 0
        self.count, *shape = series.shape
        self.shape = tuple(shape)
        self.kind = np.dtype(byte_order + series.dtype.char)
        self.frame_bytes = math.prod(self.shape) * self.kind.itemsize


def _run(file: tifffile.TiffFile) -> _Run | None:
    """The frames as one run; `None` where they are not."""
    if len(file.series) != 1:
        return None
    series = file.series[0]
    plain = series.dataoffset is not None and len(series.shape) == 3
    plain = plain and series.keyframe.samplesperpixel == 1
    return _Run(series, file.byteorder) if plain and series.dtype in (np.uint8, np.uint16) else None


class TiffReader(VideoReader):
    """The pages of one TIFF file.

    Args:
        path: of the file.

    Raises:
        InputError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._handle = path.open("rb", buffering=0)
        try:  # the library raises anything about a damaged file
            self._file = tifffile.TiffFile(self._handle, name=path.name)
            page = self._file.pages.first
            with _Complaints() as complaints:
                self._run = _run(self._file)  # of some programs only the first page is described
                len(self._file.pages)  # looks for all of them
            compression = tifffile.COMPRESSION(page.compression).name.lower()
            _check_size(page, path)
        except InputError:
            self._handle.close()
            raise
        except Exception as error:
            self._handle.close()
            why = described(error)
            raise broken(f"The TIFF file cannot be read ({why})", _COPY_AGAIN, path) from None
        self._complaints = complaints.lines if self._run is None else []
        bits = page.bitspersample
        super().__init__(
            path,
            rate_hz=None,
            lossy=page.compression in _LOSSY_TIFF,
            bit_depth=int(max(bits) if isinstance(bits, tuple) else bits),
            codec=f"tiff {compression}",
            levels="grey as stored" if page.samplesperpixel == 1 else COLOUR_RULE,
        )

    @property
    def frame_count(self) -> int:
        """Number of pages."""
        return len(self._file.pages) if self._run is None else self._run.count

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """NaN (a TIFF file has no rate), and the page."""
        return alike(
            ((self.time_s(index), frame) for index, frame in enumerate(self._from(0))), self.path
        )

    def _at(self, index: int) -> tuple[float, Frame]:
        return self.time_s(index), next(self._from(index))

    def _from(self, first: int) -> Iterator[Frame]:
        return self._pages(first) if self._run is None else self._read_run(self._run, first)

    def _read_run(self, run: _Run, first: int) -> Iterator[Frame]:
        with self.path.open("rb", buffering=0) as file:
            file.seek(run.at + first * run.frame_bytes)
            for index in range(first, run.count):
                image = np.empty(run.shape, run.kind)
                got = _fill(file, image)
                if got < image.nbytes:
                    raise self._short(index, "the file ends there")
                yield image if run.kind.isnative else image.astype(run.kind.newbyteorder("="))

    def _pages(self, first: int) -> Iterator[Frame]:
        for index in range(first, self.frame_count):
            try:
                page = self._file.pages[index]
                _check_size(page.keyframe, self.path)
                image = page.asarray()
            except InputError:
                raise
            except Exception as error:  # as in __init__
                why = described(error)
                raise self._short(index, why) from None
            yield _grey(image, self.path)
        if self._complaints:
            raise broken(
                f"The stack breaks off after page {self.frame_count - 1} ({self._complaints[0]})",
                _COPY_AGAIN,
                self.path,
            )

    def _short(self, index: int, why: str) -> Exception:
        return broken(
            f"Page {index} of {self.frame_count} cannot be read ({why})", _COPY_AGAIN, self.path
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._handle.close()


def _fill(file: Any, image: NDArray[Any]) -> int:
    """Bytes read into an image, all of them but at the file's end."""
    view, got = image.reshape(-1).view(np.uint8).data, 0
    while got < len(view) and (part := file.readinto(view[got:])):
        got += part
    return got


def natural_order(name: str) -> tuple[tuple[str, int, str], ...]:
    """A key that sorts numbers inside names by value: `img_2` before `img_10`.

    Example:
        >>> sorted(["img_10", "img_2", "img_1"], key=natural_order)
        ['img_1', 'img_2', 'img_10']
    """
    parts = re.split(r"(\d+)", name)
    numbers = [(int(digits), digits) for digits in parts[1::2]] + [(-1, "")]
    return tuple((text, *number) for text, number in zip(parts[::2], numbers, strict=True))


def image_numbers(names: Sequence[str]) -> list[int]:
    """Places of numbered images in their recording, from 0; gaps are images that are missing.

    The number is the digits in which the names differ. Where the names differ in more than one
    number, or in anything else, the images are taken as consecutive. Numbers that advance by the
    same step everywhere (every fifth image was kept) leave no gap.

    Args:
        names: in natural order.

    Example:
        >>> image_numbers(["a_0007", "a_0008", "a_0010"])
        [0, 1, 3]
    """
    consecutive = list(range(len(names)))
    parts = [re.split(r"(\d+)", name) for name in names]
    if len({tuple(part[::2]) for part in parts}) != 1:
        return consecutive
    fields = [[int(part[k]) for part in parts] for k in range(1, len(parts[0]), 2)]
    varying = [field for field in fields if len(set(field)) > 1]
    if len(varying) != 1:
        return consecutive
    steps = [after - before for before, after in pairwise(varying[0])]
    step = math.gcd(*steps)
    if min(steps) < 1 or sum(steps) // step >= _MOST_GAPS * len(names):
        return consecutive  # a date or a serial number, not a count
    return [(number - varying[0][0]) // step for number in varying[0]]


class FolderReader(VideoReader):
    """The images of a folder in natural name order; `times.csv` (`frame,time_s`) gives times.

    Numbers that are missing among the names are frames that are missing: later images keep their
    place in time.

    Args:
        path: of the folder.

    Raises:
        InputError: it holds no image, or the first cannot be read.
    """

    def __init__(self, path: Path) -> None:
        images = (f for f in path.iterdir() if f.suffix.lower() in IMAGES)
        self._files = sorted(images, key=lambda file: natural_order(file.name))
        if not self._files:
            raise broken(
                f"The folder contains no image ({', '.join(IMAGES)})", "Check the folder.", path
            )
        for file in self._files:
            if not file.is_file():  # reading a pipe would never end
                raise broken("An image is not a file", "Remove it from the folder.", file)
        with _still(self._files[0]) as first:
            super().__init__(
                path,
                rate_hz=None,
                lossy=first.lossy,
                bit_depth=first.bit_depth,
                codec=first.codec,
                levels=first.levels,
            )
        self._numbers = image_numbers([file.stem for file in self._files])
        self._times_s = read_times(path / "times.csv")

    @property
    def frame_count(self) -> int:
        """Number of images."""
        return len(self._files)

    def number(self, index: int) -> int:
        """Place of an image in the recording: later than `index` after missing images."""
        return self._numbers[index]

    @property
    def missing(self) -> tuple[int, ...]:
        """Places in the recording of the images whose numbers are missing among the names."""
        there = set(self._numbers)
        return tuple(k for k in range(self._numbers[-1]) if k not in there)

    def timed(self) -> Iterator[tuple[float, Frame]]:
        """Time in s by `times.csv`, NaN without it, and the image."""
        return alike(self._images(), self.path)

    def _at(self, index: int) -> tuple[float, Frame]:
        return self._stated_s(index), _read_still(self._files[index])

    def _stated_s(self, index: int) -> float:
        """Time of an image by the table: of all recorded frames, or of the images that are left."""
        whole = len(self._times_s) > self._numbers[-1]
        row = self._numbers[index] if whole else index
        known = row < len(self._times_s)
        return self._times_s[row] - self._times_s[0] if known else self.time_s(index)

    def _images(self) -> Iterator[tuple[float, Frame]]:
        waiting: deque[Future[Frame]] = deque()
        left = iter(self._files)
        with ThreadPoolExecutor(_READERS) as pool:  # compressed images are decoded beside another
            try:
                for index in range(len(self._files)):
                    more = islice(left, 2 * _READERS - len(waiting))
                    waiting.extend(pool.submit(_read_still, file) for file in more)
                    yield self._stated_s(index), waiting.popleft().result()
            finally:
                for job in waiting:
                    job.cancel()


def _still(path: Path) -> VideoReader:
    """One image as a video."""
    if path.stat().st_size == 0:
        raise broken("The image is empty", "Record or copy it again.", path)
    return TiffReader(path) if path.suffix.lower() in TIFF else ContainerReader(path)


def _read_still(path: Path) -> Frame:
    if path.suffix.lower() == ".pgm":
        plain = _read_pgm(path)
        if plain is not None:
            return plain
    with _still(path) as image:
        return next(iter(image))


def _read_pgm(path: Path) -> Frame | None:
    """A binary PGM file as most programs write it; `None` for any other."""
    raw = path.read_bytes()
    fields = raw[:64].split(maxsplit=4)
    if len(fields) < 5 or fields[0] != b"P5" or not all(f.isdigit() for f in fields[1:4]):
        return None
    width, height, top = map(int, fields[1:4])
    kind = np.dtype("u1" if top < 256 else ">u2")
    size = width * height * kind.itemsize
    head = len(raw) - size
    if head < 9 or len(raw[:head].split()) != 4:
        return None
    pixels = np.frombuffer(raw, kind, offset=head).reshape(height, width)
    return pixels if kind.itemsize == 1 else pixels.astype(np.uint16)
