"""The interface to files of columns: members by name, read from their first value on."""

from __future__ import annotations

import contextlib
import io
import mmap
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, InputError
from haselab.store.columns.units import split_header

__all__ = [
    "RATE_NAMES",
    "Archive",
    "Member",
    "MemberArchive",
    "MissingColumnsError",
    "Read",
    "Readable",
    "Take",
    "as_number_type",
    "filled",
    "number_type",
    "one_rate",
    "plain_reader",
    "positive",
    "take_each",
]

RATE_NAMES = ("rate_hz", "sample_rate_hz", "fs_hz", "fs")
_OWN_TYPES = (np.dtype(np.int16), np.dtype(np.float32), np.dtype(np.float64))
_REAL_KINDS = "fiub"
_MOST_LISTED = 30
_SAME_RATE = 1e-6  # of two statements of one rate; single precision rounds by 6e-8

# Gives exactly so many values, the next ones, in the type that the member states.
Read = Callable[[int], NDArray[Any]]
# Gives the next rows of some columns; fewer than asked for at the end alone, then none.
Take = Callable[[int], tuple[NDArray[Any], ...]]


@dataclass(frozen=True)
class Member:
    """One array of a file.

    Args:
        shape: of the array.
        dtype: in which the file holds it.
        start: gives what reads arrays of this type from the first value on.
        packed: reading takes the processor's time, and may go on in a thread.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    start: Callable[[], Read]
    packed: bool = False

    @property
    def size(self) -> int:
        """Number of values."""
        size = 1
        for length in self.shape:
            size *= length
        return size

    def scalar(self) -> float | None:
        """The value of an array of one number above 0, else None."""
        if self.size != 1 or self.dtype.kind not in _REAL_KINDS:
            return None
        return positive(self.start()(1)[0])


def number_type(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The type that chunks of such a column have: its own in native byte order, or float64."""
    native = dtype.newbyteorder("=")
    return native if native in _OWN_TYPES else np.dtype(np.float64)


def as_number_type(values: NDArray[Any]) -> NDArray[Any]:
    """The same values in `number_type`, not copied where they have it."""
    return values.astype(number_type(values.dtype), copy=False)


def positive(value: Any) -> float | None:
    """A finite number above 0, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if 0.0 < number < float("inf") else None


def one_rate(rates_hz: Iterable[float]) -> float | None:
    """The rate that all columns state.

    Args:
        rates_hz: of the columns that state one.
    Returns:
        None where they differ by more than rounding, or where no column states one.
    """
    stated = list(rates_hz)
    same = stated and max(stated) <= (1.0 + _SAME_RATE) * min(stated)
    return stated[0] if same else None


class MissingColumnsError(InputError):
    """Columns that a file lacks.

    Args:
        wanted: names that are missing.
        present: existing names.
        file: the file.
        advice: what to do.
    """

    def __init__(
        self,
        wanted: Sequence[str],
        present: Iterable[str],
        file: Path,
        advice: str = "Name an existing column",
    ) -> None:
        self.wanted, self.present, self.file = list(wanted), list(present), file
        listed = ", ".join(self.present[:_MOST_LISTED]) or "none"
        if len(self.present) > _MOST_LISTED:
            listed += f" and {len(self.present) - _MOST_LISTED} more"
        super().__init__(f"The file lacks {', '.join(wanted)}; it has {listed}. {advice}: {file}")

    def advised(self, advice: str) -> MissingColumnsError:
        """Make this error with other advice, such as the options that name the columns."""
        return MissingColumnsError(self.wanted, self.present, self.file, advice)


class Readable(Protocol):
    """What bytes can be read from into a place."""

    def readinto(self, buffer: memoryview, /) -> int | None:
        """Read up to the buffer's length; 0 or None at the end."""


def filled(stream: Readable, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """The next values of a stream of bytes.

    Raises:
        EOFError: there are fewer.
    """
    out = np.empty(count, dtype)
    left = out.view(np.uint8).data
    while left:
        got = stream.readinto(left)
        if not got:
            raise EOFError(f"it ends {len(left)} bytes early")
        left = left[got:]
    return out


def take_each(members: Sequence[Member], opened: contextlib.ExitStack) -> Take:
    """Begin to read members of equal size at their first value, each for itself.

    Args:
        members: of equal size; packed ones are read at the same time.
        opened: closes what is opened for it.
    """
    reads = [member.start() for member in members]
    left = min(member.size for member in members)
    mapped: Callable[..., Iterable[NDArray[Any]]] = map
    if len(members) > 1 and any(member.packed for member in members):
        mapped = opened.enter_context(ThreadPoolExecutor(len(members))).map

    def take(rows: int) -> tuple[NDArray[Any], ...]:
        nonlocal left
        rows = min(rows, left)
        left -= rows
        return tuple(mapped(lambda read: as_number_type(read(rows)), reads))

    return take


def plain_reader(stream: io.FileIO, offset: int, dtype: np.dtype[Any]) -> Read:
    """Reads values that lie one after the other in a file of its own handle.

    A chunk that the system holds in memory is mapped, not copied; one that has to come from the
    disk is read, which the disk does faster.

    Args:
        stream: opened without buffer, used only here.
        offset: of the first value, in bytes.
        dtype: of the values.
    Returns:
        Reads arrays, read-only where they are mapped; raises EOFError where the file ends early.
    """
    aligned = offset % max(1, dtype.alignment) == 0
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_SEQUENTIAL)

    def read(count: int) -> NDArray[Any]:
        nonlocal offset
        start, size = offset, count * dtype.itemsize
        offset += size
        if not (aligned and size and _in_memory(stream, start + size - 1)):
            stream.seek(start)
            return filled(stream, count, dtype)
        before = start % mmap.ALLOCATIONGRANULARITY
        # Given back with the last array that looks at it.
        window = mmap.mmap(stream.fileno(), before + size, access=mmap.ACCESS_READ,
                           offset=start - before)  # fmt: skip
        return np.frombuffer(window, dtype, count, before)

    return read


def _in_memory(stream: io.FileIO, place: int) -> bool:
    """Whether the system holds this byte of a file; False where that is unknown."""
    try:
        return os.preadv(stream.fileno(), [bytearray(1)], place, os.RWF_NOWAIT) == 1
    except (AttributeError, OSError):
        return False


class Archive(Closing, ABC):
    """A file of named columns.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        self.file = file
        self._open = opened

    @property
    @abstractmethod
    def names(self) -> Sequence[str]:
        """Full names of all that is there."""

    @abstractmethod
    def rate_hz(self, names: Sequence[str]) -> float | None:
        """Rows a second of these columns, if the file states it."""

    @abstractmethod
    def rows(self, names: Sequence[str]) -> int | None:
        """How many rows these columns have; None where only reading shows it.

        Raises:
            InputError: a column that is not one number a row, or unequal lengths.
        """

    @abstractmethod
    def start(self, names: Sequence[str]) -> Take:
        """Begin to read these columns at their first row."""

    def share_read(self) -> float | None:
        """How much of the file has been read, 0 to 1, where the number of rows is unknown."""
        return None

    def locate(self, name: str) -> str | None:
        """The full name of a column: given in full, as its end, or without its unit.

        A minus before the name asks for the same column with the other sign.

        Raises:
            InputError: several columns fit.
        """
        found = self._locate(name)
        return self._locate(name[1:].lstrip()) if found is None and name[:1] == "-" else found

    def is_negative(self, name: str) -> bool:
        """Whether a name asks for the other sign, as "-Weg" does unless a column is called so."""
        return name[:1] == "-" and self._locate(name) is None

    def _locate(self, name: str) -> str | None:
        if name in self.names:
            return name
        full = [other for other in self.names if other.rpartition("/")[2] == name]
        if len(full) > 1:
            raise self._ambiguous(name, full)
        return full[0] if full else self._by_name_without_unit(name)

    def _by_name_without_unit(self, name: str) -> str | None:
        """The only column with this name and a unit, such as `U [mV]` for U."""
        full = [
            other
            for other in self.names
            if other != name and split_header(other.rpartition("/")[2])[0] == name
        ]
        full = full or [other for other in self.names if split_header(other)[0] == name]
        if len(full) > 1:
            raise self._ambiguous(name, full)
        return full[0] if full else None

    def _ambiguous(self, name: str, full: Sequence[str]) -> InputError:
        return InputError(
            f"The file has {len(full)} columns {name} ({', '.join(full)}). "
            f"Use the full name: {self.file}"
        )

    def plain_name(self, full: str) -> str:
        """The name of a column without its group and its unit."""
        return split_header(full.rpartition("/")[2])[0]

    def unit_text(self, full: str) -> str:
        """The unit that the file states for a column, as text; empty if there is none."""
        return split_header(full.rpartition("/")[2])[1] or split_header(full)[1]

    def is_clock(self, full: str) -> bool:
        """Whether a column has clock times, which are read as seconds."""
        return False

    def locate_all(self, names: Sequence[str]) -> list[str]:
        """Full names of columns that must be there.

        Raises:
            InputError: one is missing, or there several times.
        """
        found = {name: self.locate(name) for name in names}
        lacking = [name for name, full in found.items() if full is None]
        if lacking:
            raise MissingColumnsError(lacking, self.names, self.file)
        return [full for full in found.values() if full is not None]

    def stream(self) -> io.FileIO:
        """The file once more, without buffer, closed with the archive."""
        return self._open.enter_context(self.file.open("rb", buffering=0))

    def close(self) -> None:
        """Close the file."""
        self._open.close()


class MemberArchive(Archive):
    """A file whose columns are read separately.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    members: Mapping[str, Member]

    @property
    def names(self) -> Sequence[str]:
        """Full names of all members."""
        return list(self.members)

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """Value of a member of one number with a name like `rate_hz`."""
        del names
        for name in RATE_NAMES:
            full = [other for other in self.members if other.rpartition("/")[2] == name]
            full = [name] if name in full else full
            if len(full) == 1 and (rate_hz := self.members[full[0]].scalar()) is not None:
                return rate_hz
        return None

    def rows(self, names: Sequence[str]) -> int | None:
        """The common length of the columns."""
        sizes = {name: self._checked(name) for name in names}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise InputError(
                f"The columns have unequal lengths ({listed}). "
                f"Export them from the same recording: {self.file}"
            )
        return next(iter(sizes.values()))

    def _checked(self, name: str) -> int:
        member = self.members[name]
        if member.dtype.kind not in _REAL_KINDS:
            raise InputError(
                f"Column {name} does not contain real numbers. Export it as numbers: {self.file}"
            )
        if member.size and max(member.shape, default=1) != member.size:
            raise InputError(
                f"Column {name} has shape {member.shape}, but must have one value per row. "
                f"Split it into columns: {self.file}"
            )
        return member.size

    def start(self, names: Sequence[str]) -> Take:
        """Begin to read these members at their first value."""
        return take_each([self.members[name] for name in names], self._open)
