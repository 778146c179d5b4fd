"""Columns of NumPy's files: .npy (one array) and .npz (a zip archive of them)."""

from __future__ import annotations

import contextlib
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import (
    Archive,
    Member,
    MemberArchive,
    Read,
    Take,
    as_number_type,
    filled,
    number_type,
    plain_reader,
    take_each,
)

__all__ = ["NpyArchive", "NpzArchive"]

_LONGEST_HEADER = 1 << 20  # bytes; read at once, so it must not be what a damaged file says
_LOCAL_HEADER = struct.Struct("<26x2H")  # of a zip member: lengths of name and extra field


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether column by column (Fortran), and type; the stream is then at the values."""
    major, _ = np.lib.format.read_magic(stream)
    if major == 1:
        return np.lib.format.read_array_header_1_0(stream)
    length = int.from_bytes(stream.read(4), "little")
    if major > 3 or length > _LONGEST_HEADER:
        raise ValueError(f"header of version {major} and {length} bytes")
    stream.seek(-4, 1)
    return np.lib.format.read_array_header_2_0(stream)


class NpzArchive(MemberArchive):
    """Arrays of a .npz file; stored members are read straight from the file.

    The checksum of a deflated member is verified; that of a stored one is not, like that of any
    plain file.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        self._zip = self._open.enter_context(zipfile.ZipFile(file))
        entries = [entry for entry in self._zip.infolist() if entry.filename.endswith(".npy")]
        self.members = {entry.filename.removesuffix(".npy"): self._member(entry)
                        for entry in entries}  # fmt: skip

    def _member(self, entry: zipfile.ZipInfo) -> Member:
        with self._zip.open(entry) as stream:
            shape, _, dtype = _header(stream)
            skip = stream.tell()
        if entry.compress_type == zipfile.ZIP_STORED:
            return Member(shape, dtype, lambda: self._plain(entry, skip, dtype))
        return Member(shape, dtype, lambda: self._inflated(entry, skip, dtype), packed=True)

    def _plain(self, entry: zipfile.ZipInfo, skip: int, dtype: np.dtype[Any]) -> Read:
        stream = self.stream()
        stream.seek(entry.header_offset)
        name, extra = _LOCAL_HEADER.unpack(stream.read(_LOCAL_HEADER.size))
        place = entry.header_offset + _LOCAL_HEADER.size + name + extra + skip
        return plain_reader(stream, place, dtype)

    def _inflated(self, entry: zipfile.ZipInfo, skip: int, dtype: np.dtype[Any]) -> Read:
        stream = cast(zipfile.ZipExtFile, self._open.enter_context(self._zip.open(entry)))
        stream.read(skip)

        return lambda count: filled(stream, count, dtype)


class NpyArchive(Archive):
    """Columns of one array: its fields; or, without names, both of an `(n, 2)` or `(2, n)` array.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        with file.open("rb") as stream:
            shape, by_column, self._dtype = _header(stream)
            self._offset = stream.tell()
        self._shape = shape
        self._names = list(self._dtype.names or ())
        self._by_column = by_column == (len(shape) == 2 and shape[1] == 2)

    @property
    def names(self) -> Sequence[str]:
        """Names of the fields, if there are any."""
        return self._names

    def locate_all(self, names: Sequence[str]) -> list[str]:
        """Full names of columns that must be there; two of an array without names by position."""
        if self._names:
            return super().locate_all(names)
        if len(names) != 2 or len(self._shape) != 2 or 2 not in self._shape:
            raise InputError(
                f"The array has shape {self._shape} and no names for {', '.join(names)}. "
                f"Save it with names as .npz, or two columns with shape (n, 2): {self.file}"
            )
        return list(names)

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """None: an array does not state a rate."""
        del names
        return None

    def rows(self, names: Sequence[str]) -> int | None:
        """Length of the array."""
        types = [self._dtype[name] for name in names] if self._names else [self._dtype]
        if not all(dtype.kind in "fiub" and dtype.shape == () for dtype in types):
            raise InputError(
                f"The array has the type {self._dtype}, but must contain real numbers, or fields "
                f"with one real number each. Save it again: {self.file}"
            )
        if not self._names:
            return self._shape[0] * self._shape[1] // 2
        return int(np.prod(self._shape))

    def start(self, names: Sequence[str]) -> Take:
        """Begin to read at the first row."""
        if self._names:
            return self._fields(names)
        return self._channels() if self._by_column else self._pairs()

    def _fields(self, names: Sequence[str]) -> Take:
        left = self.rows(names) or 0
        read = plain_reader(self.stream(), self._offset, self._dtype)

        def take(rows: int) -> tuple[NDArray[Any], ...]:
            nonlocal left
            table = read(min(rows, left))
            left -= table.size
            return tuple(
                np.ascontiguousarray(table[name], number_type(self._dtype[name])) for name in names
            )

        return take

    def _pairs(self) -> Take:
        left = max(self._shape)
        read = plain_reader(self.stream(), self._offset, self._dtype)

        def take(rows: int) -> tuple[NDArray[Any], ...]:
            nonlocal left
            table = as_number_type(read(2 * min(rows, left))).reshape(-1, 2)
            left -= len(table)
            return table[:, 0], table[:, 1]

        return take

    def _channels(self) -> Take:
        size = max(self._shape)

        def member(offset: int) -> Member:
            dtype = self._dtype
            return Member((size,), dtype, lambda: plain_reader(self.stream(), offset, dtype))

        places = [self._offset + k * size * self._dtype.itemsize for k in range(2)]
        return take_each([member(place) for place in places], self._open)
