"""Columns of HDF5 files, of MATLAB files of version 7.3, and of a session's experiment."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.store.archive import RATE_NAMES, Member, MemberArchive, Read, plain_reader, positive

__all__ = ["Hdf5Archive", "chunked_reader"]

_ONE_CHUNK_BYTES = 1 << 20  # datasets in smaller chunks are read several chunks at a time


def chunked_reader(dataset: h5py.Dataset, axis: int) -> Read:
    """Reads a dataset along one axis by whole chunks, so that none is decompressed twice.

    Args:
        dataset: whose other axes are read in full.
        axis: along which rows are counted.
    Returns:
        Reads arrays of so many values, in the dataset's own type.
    """
    row = [n for k, n in enumerate(dataset.shape) if k != axis]
    values = int(np.prod(row, dtype=np.int64))
    chunk = dataset.chunks[axis] if dataset.chunks else 1
    chunk *= max(1, _ONE_CHUNK_BYTES // (chunk * values * dataset.dtype.itemsize))
    size = dataset.shape[axis]
    position, rest = 0, np.empty(0, dataset.dtype)

    def load(out: NDArray[Any], rows: int) -> None:
        nonlocal position
        if position + rows > size:
            raise EOFError(f"dataset {dataset.name} ends early")
        shape = list(dataset.shape)
        shape[axis] = rows
        where = [slice(None)] * len(shape)
        where[axis] = slice(position, position + rows)
        dataset.read_direct(out.reshape(shape), tuple(where))
        position += rows

    def read(count: int) -> NDArray[Any]:
        nonlocal rest
        out = np.empty(count, dataset.dtype)
        done = min(rest.size, count)
        out[:done], rest = rest[:done], rest[done:]
        whole = (count - done) // values // chunk * chunk
        if whole:
            load(out[done : done + whole * values], whole)
            done += whole * values
        if done < count:
            rows = min(chunk, size - position)
            rest = np.empty(rows * values, dataset.dtype)
            load(rest, rows)
            if count - done > rest.size:
                raise EOFError(f"dataset {dataset.name} ends early")
            out[done:], rest = rest[: count - done], rest[count - done :]
        return out

    return read


class Hdf5Archive(MemberArchive):
    """Datasets of all groups, as `group/name`.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        self._file = self._open.enter_context(h5py.File(file, "r"))
        self._sets: dict[str, h5py.Dataset] = {}
        self._file.visititems(self._collect)
        self.members = {name: self._member(data) for name, data in self._sets.items()}

    def _collect(self, name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.shape is not None:
            self._sets[name] = item

    def _member(self, dataset: h5py.Dataset) -> Member:
        def start() -> Read:
            offset = dataset.id.get_offset()
            if offset is not None and dataset.external is None:  # its values lie in a row
                return plain_reader(self.stream(), offset, dataset.dtype)
            if dataset.size == 1:
                return _one_value(dataset)
            return chunked_reader(dataset, int(np.argmax(dataset.shape)))

        return Member(dataset.shape, dataset.dtype, start)

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """A dataset of one number, or an attribute of the file or of a column."""
        rate_hz = super().rate_hz(names)
        for holder in (self._file, *(self._sets[name] for name in names)):
            for name in RATE_NAMES:
                value = holder.attrs.get(name)
                if rate_hz is None and value is not None and np.size(value) == 1:
                    rate_hz = positive(np.reshape(value, -1)[0])
        return rate_hz


def _one_value(dataset: h5py.Dataset) -> Read:
    return lambda count: np.reshape(dataset[()], count)
