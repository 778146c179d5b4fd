"""The last blocks of a session, written at once and in place: a sudden end loses none of them.

Blocks reach their dataset in compressed chunks of 0.1 s. Until then they lie in the dataset `tail`,
a ring of slots of fixed size whose place in the file never changes. A slot is written by one call
to the system, so it survives the end of the process; its checksum tells a slot that was cut.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

__all__ = ["TAIL", "TailReader", "TailWriter", "create_tail"]

TAIL = "tail"
_CHECK = "check"


def _slot_dtype(block_samples: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            (_CHECK, "<u4"),
            ("experiment", "<u4"),
            ("row", "<u8"),
            ("drive_v", "<f8"),
            ("reference", "<f8"),
            ("start_s", "<f8"),
            ("codes", "<i2", (block_samples, 2)),
        ]
    )


def create_tail(file: h5py.File, slots: int, block_samples: int) -> None:
    """Make the ring's dataset; nothing of HDF5 writes to it afterwards.

    Args:
        file: open for writing.
        slots: blocks that it holds.
        block_samples: samples per channel in one block.
    """
    dcpl = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    dcpl.set_layout(h5py.h5d.CONTIGUOUS)
    dcpl.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    dcpl.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    dtype = h5py.h5t.py_create(_slot_dtype(block_samples), logical=True)
    space = h5py.h5s.create_simple((slots,))
    h5py.h5d.create(file.id, TAIL.encode(), dtype, space, dcpl)
    tail = file[TAIL]
    tail.make_scale(TAIL)
    tail.attrs["about"] = "ring of the last blocks as they came; valid where the CRC-32 holds"


class TailWriter:
    """Writes slots in turn.

    Args:
        file: with the ring, all of it flushed.
        path: of the file.
    Raises:
        OSError: the system refuses, for instance because the disk is full.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        tail = file[TAIL]
        self._slot = np.zeros((), tail.dtype)
        self._bytes = self._slot.reshape(1).view(np.uint8)
        self._offset, self._slots = int(tail.id.get_offset()), int(tail.shape[0])
        self._next = 0
        self._raw = path.open("r+b", buffering=0)
        if hasattr(os, "posix_fallocate"):  # a full disk then takes the last blocks all the same
            with contextlib.suppress(OSError):
                os.posix_fallocate(self.fileno(), self._offset, tail.nbytes)

    def fileno(self) -> int:
        """Descriptor of the session file."""
        return self._raw.fileno()

    def append(
        self, experiment: int, row: int, drive_v: float, reference: float, start_s: float,
        codes: NDArray[np.int16],
    ) -> None:  # fmt: skip
        """Write one block; it is in the file when this returns.

        Raises:
            OSError: the system refuses.
        """
        slot = self._slot
        slot["experiment"], slot["row"] = experiment, row
        slot["drive_v"], slot["reference"], slot["start_s"] = drive_v, reference, start_s
        slot["codes"] = codes
        slot[_CHECK] = zlib.crc32(self._bytes[4:].data)
        self._raw.seek(self._offset + self._next * self._slot.nbytes)
        self._raw.write(self._bytes.data)
        self._next = (self._next + 1) % self._slots

    def close(self) -> None:
        """Close the descriptor; safe to call twice."""
        self._raw.close()


class TailReader:
    """Reads the ring, also while it is written.

    Args:
        file: open for reading.
        path: of the file.
    """

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._slots: NDArray[np.void] | None = None
        if TAIL in file:
            tail = file[TAIL]
            offset, shape = tail.id.get_offset(), tail.shape
            if offset is not None and path.stat().st_size >= offset + tail.nbytes:
                self._slots = np.memmap(path, tail.dtype, "r", int(offset), shape)

    def newest(self, experiment: int) -> int:
        """The highest row of an experiment that lies here; -1: none."""
        if self._slots is None:
            return -1
        ours = self._slots["row"][self._slots["experiment"] == experiment]
        return int(ours.max()) if ours.size else -1

    def rows(self, experiment: int, first: int) -> NDArray[Any]:
        """Whole slots of an experiment, in order, from this row on without a gap.

        Args:
            experiment: its number in the session, from 1.
            first: row.
        Returns:
            Structured array with fields `drive_v reference start_s codes`, perhaps empty.
        """
        if self._slots is None:
            return np.empty(0, _slot_dtype(1))
        there = (self._slots["experiment"] == experiment) & (self._slots["row"] >= first)
        found = self._slots[np.flatnonzero(there)]
        found = found[np.argsort(found["row"], kind="stable")]
        keep = 0
        for slot in found:
            data = slot.tobytes()
            good = zlib.crc32(data[4:]) == int.from_bytes(data[:4], "little")
            if not good or int(slot["row"]) != first + keep:
                break
            keep += 1
        return np.asarray(found[:keep])

    def close(self) -> None:
        """Let go of the file."""
        self._slots = None
