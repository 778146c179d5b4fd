"""Columns of HDF5 files, of MATLAB files of version 7.3, and of a session's experiment."""

from __future__ import annotations

import contextlib
import math
import os
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import (
    RATE_NAMES,
    Member,
    MemberArchive,
    Read,
    one_rate,
    plain_reader,
    positive,
)
from haselab.store.session.opening import is_session, open_session

__all__ = ["Hdf5Archive", "chunked_reader"]

# Fills an array with so many rows of a dataset, from the first of a chunk on.
Load = Callable[[NDArray[Any], int, int], None]
_MOST_THREADS = 4
_ONE_CHUNK_BYTES = 1 << 20  # datasets in smaller chunks are read several chunks at a time


def chunked_reader(dataset: h5py.Dataset, axis: int, opened: contextlib.ExitStack) -> Read:
    """Read a dataset along one axis by whole chunks, so that none is decompressed twice.

    Args:
        dataset: whose other axes are read in full.
        axis: along which rows are counted.
        opened: closes what the reader opens.
    Returns:
        Reads arrays of so many values, in the dataset's own type.
    """
    row = [n for k, n in enumerate(dataset.shape) if k != axis]
    values = int(np.prod(row, dtype=np.int64))
    chunk = dataset.chunks[axis] if dataset.chunks else 1
    chunk *= max(1, _ONE_CHUNK_BYTES // (chunk * values * dataset.dtype.itemsize))
    size = dataset.shape[axis]
    position, rest = 0, np.empty(0, dataset.dtype)
    if dataset.chunks and _only_deflated(dataset, axis):
        load = _load_packed(dataset, axis, opened)
    else:
        load = _load_any(dataset, axis)

    def ahead(out: NDArray[Any], rows: int) -> None:
        nonlocal position
        if position + rows > size:
            raise EOFError(f"dataset {dataset.name} ends early")
        load(out, position, rows)
        position += rows

    def read(count: int) -> NDArray[Any]:
        nonlocal rest
        out = np.empty(count, dataset.dtype)
        done = min(rest.size, count)
        out[:done], rest = rest[:done], rest[done:]
        whole = (count - done) // values // chunk * chunk
        if whole:
            ahead(out[done : done + whole * values], whole)
            done += whole * values
        if done < count:
            rows = min(chunk, size - position)
            rest = np.empty(rows * values, dataset.dtype)
            ahead(rest, rows)
            if count - done > rest.size:
                raise EOFError(f"dataset {dataset.name} ends early")
            out[done:], rest = rest[: count - done], rest[count - done :]
        return out

    return read


def _load_any(dataset: h5py.Dataset, axis: int) -> Load:
    """By HDF5 itself, whatever the filters."""

    def load(out: NDArray[Any], first: int, rows: int) -> None:
        shape = list(dataset.shape)
        shape[axis] = rows
        where = [slice(None)] * len(shape)
        where[axis] = slice(first, first + rows)
        dataset.read_direct(out.reshape(shape), tuple(where))

    return load


def _only_deflated(dataset: h5py.Dataset, axis: int) -> bool:
    """Whether chunks span all other axes and are packed by deflate, perhaps after a shuffle."""
    filters = 1 + bool(dataset.shuffle)
    return (
        dataset.compression == "gzip"
        and dataset.id.get_create_plist().get_nfilters() == filters
        and all(dataset.chunks[k] == n for k, n in enumerate(dataset.shape) if k != axis)
    )


def _load_packed(dataset: h5py.Dataset, axis: int, opened: contextlib.ExitStack) -> Load:
    """Inflate chunks with as many threads as there are processors: HDF5 uses one."""
    pool = opened.enter_context(ThreadPoolExecutor(min(_MOST_THREADS, os.cpu_count() or 1)))
    chunk, slow = dataset.chunks[axis], _load_any(dataset, axis)
    values = int(np.prod(dataset.chunks, dtype=np.int64)) // chunk

    def inflate(out: NDArray[Any], first: int, rows: int) -> None:
        place = [0] * dataset.ndim
        place[axis] = first
        try:
            skipped, packed = dataset.id.read_direct_chunk(tuple(place))
        except (OSError, RuntimeError, ValueError):  # a chunk that was never written
            skipped, packed = 1, b""
        if skipped:
            slow(out, first, rows)
            return
        data = np.frombuffer(zlib.decompress(packed), np.uint8)
        if dataset.shuffle:
            width = dataset.dtype.itemsize
            planes, bytes_out = data.reshape(width, -1), out.view(np.uint8)
            for k in range(width):
                bytes_out[k::width] = planes[k, : out.size]
        else:
            out.view(np.uint8)[:] = data[: out.nbytes]

    def load(out: NDArray[Any], first: int, rows: int) -> None:
        parts = [(k, min(chunk, rows - k)) for k in range(0, rows, chunk)]
        jobs = [
            pool.submit(inflate, out[k * values : (k + n) * values], first + k, n) for k, n in parts
        ]
        for job in jobs:
            job.result()

    return load


def _opened(file: Path) -> h5py.File:
    """The file, open; a session only when its checksums match."""
    if not is_session(file):
        return h5py.File(file, "r")
    opened = open_session(file)
    if opened.doubt:
        opened.file.close()
        raise InputError(
            f"The numbers of this session are not verified ({opened.doubt}). Use 'haselab session "
            f"export' and read the exported files. {file}"
        )
    return opened.file


class Hdf5Archive(MemberArchive):
    """Datasets of all groups, as `group/name`.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        self._file = self._open.enter_context(_opened(file))
        self._sets: dict[str, h5py.Dataset] = {}
        self._elsewhere: list[str] = []
        self._file.visititems(self._collect)
        self._file.visititems_links(self._note_link)
        self.members = {name: self._member(data) for name, data in self._sets.items()}

    def _note_link(self, name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            self._elsewhere.append(name)

    def _locate(self, name: str) -> str | None:
        found = super()._locate(name)
        if found is None:
            linked = [
                other for other in self._elsewhere if name in (other, other.rpartition("/")[2])
            ]
            if linked:
                raise self._lies_elsewhere(linked[0])
        elif self._sets[found].is_virtual or self._sets[found].external:
            raise self._lies_elsewhere(found)
        return found

    def _lies_elsewhere(self, name: str) -> InputError:
        return InputError(
            f"The values of {name} are in another file, which is not read. Copy them into this "
            f"one, for example with h5repack. {self.file}"
        )

    def _collect(self, name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.shape is not None:
            self._sets[name] = item

    def _member(self, dataset: h5py.Dataset) -> Member:
        def start() -> Read:
            offset = dataset.id.get_offset()
            if dataset.is_virtual or dataset.external:
                raise self._lies_elsewhere(str(dataset.name))
            if offset is not None:  # its values lie in a row
                return plain_reader(self.stream(), offset, dataset.dtype)
            if dataset.size == 1:
                return _one_value(dataset)
            return chunked_reader(dataset, int(np.argmax(dataset.shape)), self._open)

        packing = _packing(dataset)
        if packing is None:
            return Member(dataset.shape, dataset.dtype, start)
        return Member(dataset.shape, np.dtype(np.float64), lambda: _unpacked(start(), *packing))

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """A dataset of one number, or what the attributes of the file and the columns agree on."""
        stated = super().rate_hz(names)
        if stated is not None:
            return stated
        holders = (self._file, *(self._sets[name] for name in names))
        values = [holder.attrs.get(name) for holder in holders for name in RATE_NAMES]
        single = [np.reshape(v, -1)[0] for v in values if v is not None and np.size(v) == 1]
        return one_rate(rate_hz for value in single if (rate_hz := positive(value)))

    def unit_text(self, full: str) -> str:
        """The dataset's attribute `units` or `unit`, else what its name states."""
        for key in ("units", "unit"):
            value = self._sets[full].attrs.get(key)
            if isinstance(value, bytes):
                value = value.decode("utf-8", errors="replace")
            if isinstance(value, str) and value.strip():
                return value
        return super().unit_text(full)


def _packing(dataset: h5py.Dataset) -> tuple[float, float, float] | None:
    """Factor, offset and fill value that the attributes state; None where they change nothing.

    Source: CF Conventions 1.11, sections 2.5.1 and 8.1.
    """
    if dataset.dtype.kind not in "iuf":
        return None
    stated = []
    for key, default in (("scale_factor", 1.0), ("add_offset", 0.0), ("_FillValue", math.nan)):
        value = dataset.attrs.get(key)
        number = np.size(value) == 1 and np.asarray(value).dtype.kind in "iuf"
        stated.append(float(np.reshape(value, -1)[0]) if number else default)
    factor, offset, fill = stated
    return None if (factor, offset) == (1.0, 0.0) and math.isnan(fill) else (factor, offset, fill)


def _unpacked(read: Read, factor: float, offset: float, fill: float) -> Read:
    """Numbers that are stored scaled; a missing one is NaN."""

    def unpacked(count: int) -> NDArray[Any]:
        stored = np.asarray(read(count), dtype=np.float64)
        return np.where(stored == fill, math.nan, stored * factor + offset)

    return unpacked


def _one_value(dataset: h5py.Dataset) -> Read:
    return lambda count: np.reshape(dataset[()], count)
