"""Columns of MATLAB files of version 5 (`save -v6`, `-v7`), walked element by element.

A variable is a tree of elements, each a tag (type, bytes) and data padded to 8 bytes. Only tags and
names are read to find the arrays; their values are then read in parts, directly from the file or
from the zlib stream that contains the variable.
"""

from __future__ import annotations

import contextlib
import io
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from haselab.store.columns.archive import Member, MemberArchive, Read, filled, plain_reader

__all__ = ["MatArchive"]

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_STRUCT, _FIRST_NUMERIC, _LAST_NUMERIC = 2, 6, 15
_COMPLEX = 0x0800
_INPUT_BYTES = 1 << 18
# Storage of an element, and class of an array, as NumPy types.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8",
           13: "u8"}  # fmt: skip
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8",
            15: "u8"}  # fmt: skip


class _Source(Protocol):
    """Bytes from a place on."""

    position: int

    def read(self, count: int) -> bytes:
        """Exactly so many bytes."""

    def skip(self, count: int) -> None:
        """Pass over so many bytes."""


class _Plain:
    """Bytes of the file itself."""

    def __init__(self, stream: BinaryIO, position: int) -> None:
        self._stream, self.position = stream, position

    def read(self, count: int) -> bytes:
        self._stream.seek(self.position)
        data = self._stream.read(count)
        if len(data) < count:
            raise EOFError("it ends within a variable")
        self.position += count
        return data

    def skip(self, count: int) -> None:
        self.position += count


class _Inflated:
    """Bytes of one zlib stream within the file, in order."""

    def __init__(self, stream: BinaryIO, start: int, size: int) -> None:
        self._stream, self._left, self.position = stream, size, 0
        self._inflate = zlib.decompressobj()
        stream.seek(start)

    def some(self, count: int) -> bytes:
        """At least one byte, at most `count`."""
        while True:
            data = self._inflate.unconsumed_tail
            if not data:
                data = self._stream.read(min(_INPUT_BYTES, self._left))
                self._left -= len(data)
            out = self._inflate.decompress(data, count)
            if out:
                self.position += len(out)
                return out
            if not data or self._inflate.eof:
                raise EOFError("a compressed variable ends early")

    def readinto(self, buffer: memoryview, /) -> int:
        """Some bytes into a place, at least one."""
        data = self.some(min(len(buffer), 4 * _INPUT_BYTES))
        buffer[: len(data)] = data
        return len(data)

    def read(self, count: int) -> bytes:
        parts = []
        while count:
            parts.append(self.some(count))
            count -= len(parts[-1])
        return b"".join(parts)

    def skip(self, count: int) -> None:
        while count:
            count -= len(self.some(min(count, _INPUT_BYTES)))


@dataclass(frozen=True)
class _Tag:
    """Type and size of an element, its data when they lie in the tag, and its padding."""

    kind: int
    size: int
    data: bytes | None

    @property
    def padding(self) -> int:
        return 0 if self.data is not None else -self.size % 8


class MatArchive(MemberArchive):
    """Numeric arrays of a version 5 file, and those in its structures as `structure/field`.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    Raises:
        ValueError: not such a file.
    Source: The MathWorks, MAT-File Format, R2023a, chapter 1.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        self._walk = self._open.enter_context(file.open("rb"))
        head = self._walk.read(_HEADER_BYTES)
        order = {b"IM": "<", b"MI": ">"}.get(head[126:128])
        if len(head) < _HEADER_BYTES or order is None:
            raise ValueError("it is not a MATLAB file of version 5 or 7.3")
        self._order = order
        self.members = {name: member for name, member in self._variables() if name}

    def _variables(self) -> Iterator[tuple[str, Member]]:
        position, end = _HEADER_BYTES, self.file.stat().st_size
        while position + 8 <= end:
            plain = _Plain(self._walk, position)
            tag = self._tag(plain)
            if plain.position + tag.size > end:
                raise EOFError("it ends within a variable")
            if tag.kind == _COMPRESSED:
                yield from self._compressed(plain.position, tag.size)
            elif tag.kind == _MATRIX:
                yield from self._matrix(plain, "", self._from_plain)
            position += 8 + tag.size

    def _compressed(self, start: int, size: int) -> Iterator[tuple[str, Member]]:
        def from_stream(position: int, dtype: np.dtype[Any]) -> Read:
            inflated = _Inflated(self.stream(), start, size)
            inflated.skip(position)
            return lambda count: filled(inflated, count, dtype)

        # The walk reads ahead of a zlib stream, so each has a handle of its own.
        source = _Inflated(self.stream(), start, size)
        if self._tag(source).kind == _MATRIX:
            yield from self._matrix(source, "", from_stream)

    def _from_plain(self, position: int, dtype: np.dtype[Any]) -> Read:
        return plain_reader(self.stream(), position, dtype)

    def _tag(self, source: _Source) -> _Tag:
        first, second = np.frombuffer(source.read(8), f"{self._order}u4").tolist()
        if first >> 16:  # a small element: size, type and data in eight bytes
            data = np.array([second], f"{self._order}u4").tobytes()
            return _Tag(first & 0xFFFF, first >> 16, data[: first >> 16])
        return _Tag(first, second, None)

    def _data(self, source: _Source) -> bytes:
        tag = self._tag(source)
        if tag.data is not None:
            return tag.data
        data = source.read(tag.size)
        source.skip(tag.padding)
        return data

    def _ints(self, source: _Source) -> list[int]:
        values: list[int] = np.frombuffer(self._data(source), f"{self._order}i4").tolist()
        return values

    def _matrix(
        self, source: _Source, prefix: str, start: Callable[[int, np.dtype[Any]], Read]
    ) -> Iterator[tuple[str, Member]]:
        """Arrays of the matrix whose tag has just been read."""
        flags = self._ints(source)[0]
        shape = tuple(self._ints(source))
        name = prefix + self._data(source).decode("latin1")
        kind = flags & 0xFF
        if kind == _STRUCT and np.prod(shape) == 1:
            yield from self._fields(source, name, start)
        elif _FIRST_NUMERIC <= kind <= _LAST_NUMERIC:
            yield name, self._array(source, shape, flags, start)

    def _fields(
        self, source: _Source, name: str, start: Callable[[int, np.dtype[Any]], Read]
    ) -> Iterator[tuple[str, Member]]:
        width = self._ints(source)[0]
        text = self._data(source)
        for k in range(0, len(text), width):
            field = text[k : k + width].partition(b"\0")[0].decode("latin1")
            tag = self._tag(source)
            end = source.position + tag.size
            if tag.size:
                yield from self._matrix(source, f"{name}/{field}", start)
            source.skip(end - source.position)

    def _array(
        self,
        source: _Source,
        shape: tuple[int, ...],
        flags: int,
        start: Callable[[int, np.dtype[Any]], Read],
    ) -> Member:
        tag = self._tag(source)
        stored = np.dtype(self._order + _STORED[tag.kind])
        dtype = np.dtype(_CLASSES[flags & 0xFF]) if not flags & _COMPLEX else np.dtype("c16")
        if tag.size != int(np.prod(shape)) * stored.itemsize:
            raise ValueError("a variable has another size than it states")
        if tag.data is not None:
            stream = io.BytesIO(tag.data)
            return Member(shape, dtype, lambda: _converted(_again(stream, stored), dtype))
        position = source.position
        packed = isinstance(source, _Inflated)
        return Member(shape, dtype, lambda: _converted(start(position, stored), dtype), packed)


def _again(stream: io.BytesIO, stored: np.dtype[Any]) -> Read:
    stream.seek(0)
    return lambda count: filled(stream, count, stored)


def _converted(read: Read, dtype: np.dtype[Any]) -> Read:
    """Reads arrays of the array's class from what is stored, often in a smaller type."""
    return lambda count: read(count).astype(dtype, copy=False)
