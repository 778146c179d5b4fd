"""The last blocks of a session, written at once and in place, so that a sudden end loses none.

Blocks reach their dataset in compressed chunks of 0.1 s. Until then they are in the dataset `tail`,
a ring of slots of fixed size at a fixed position in the file. A slot is written with one system
call; once that has returned, it survives the end of the process. Its number is stored before and
after the data: if the last one is missing, the process was killed during the call; if both agree,
the checksum must match.
"""

from __future__ import annotations

import contextlib
import io
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

__all__ = ["TAIL", "TailReader", "TailWriter", "block_checks", "create_tail"]

TAIL = "tail"
_CHECKED = slice(12, -8)  # bytes of a slot that the checksum covers


def _slot_dtype(block_samples: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            ("sequence", "<u8"),
            ("check", "<u4"),
            ("experiment", "<u4"),
            ("row", "<u8"),
            ("drive_v", "<f8"),
            ("reference", "<f8"),
            ("start_s", "<f8"),
            ("codes", "<i2", (block_samples, 2)),
            ("end", "<u8"),
        ]
    )


def block_checks(experiment: int, first: int, blocks: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """CRC-32 of each block, over its experiment, its row and all its data.

    Args:
        experiment: its number in the session, from 1.
        first: row of the first block.
        blocks: `codes` of shape `(B, N, 2)`; `drive_v`, `reference`, `start_s` of shape `(B,)`.
    Returns:
        Shape `(B,)`.
    """
    codes = blocks["codes"]
    slots = np.zeros(len(codes), _slot_dtype(codes.shape[1]))
    slots["experiment"], slots["row"] = experiment, first + np.arange(len(codes))
    for name in ("codes", "drive_v", "reference", "start_s"):
        slots[name] = blocks[name]
    return np.array([zlib.crc32(slot.tobytes()[_CHECKED]) for slot in slots], "<u4")


def create_tail(file: h5py.File, slots: int, block_samples: int) -> None:
    """Create the dataset of the ring; HDF5 does not write to it afterwards.

    Args:
        file: open for writing.
        slots: number of blocks in the ring.
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
    """Writes the slots of the ring.

    Args:
        file: with the ring, flushed.
        raw: the same file, unbuffered, open for reading and writing; closed with the tail.
    """

    def __init__(self, file: h5py.File, raw: io.FileIO) -> None:
        tail = file[TAIL]
        self._slot = np.zeros((), tail.dtype)
        self._bytes = self._slot.reshape(1).view(np.uint8)
        self._offset, self._slots = int(tail.id.get_offset()), int(tail.shape[0])
        self._written = 0
        self._raw = raw
        if hasattr(os, "posix_fallocate"):  # so that the last blocks fit even on a full disk
            with contextlib.suppress(OSError):
                os.posix_fallocate(raw.fileno(), self._offset, tail.nbytes)

    @property
    def raw(self) -> io.FileIO:
        """The session file, unbuffered."""
        return self._raw

    def append(
        self, experiment: int, row: int, drive_v: float, reference: float, start_s: float,
        codes: NDArray[np.int16],
    ) -> int:  # fmt: skip
        """Write one block; it is in the file when this method returns.

        Returns:
            Its checksum, see `block_checks`.
        Raises:
            OSError: the file cannot be written.
        """
        slot = self._slot
        slot["experiment"], slot["row"] = experiment, row
        slot["drive_v"], slot["reference"], slot["start_s"] = drive_v, reference, start_s
        slot["codes"] = codes
        slot["check"] = check = zlib.crc32(self._bytes[_CHECKED].data)
        place = self._written % self._slots
        self._written += 1
        slot["sequence"] = slot["end"] = self._written
        self._raw.seek(self._offset + place * self._slot.nbytes)
        self._raw.write(self._bytes.data)
        return check

    def close(self) -> None:
        """Close the descriptor; safe to call twice."""
        self._raw.close()


class TailReader:
    """Reads the ring, even while it is written.

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
        """The highest row of an experiment in the ring; -1: none.

        A slot whose write was not finished does not count, although its row may be in the file: the
        system writes page by page, and the writer may be killed between two pages.
        """
        slots = self._slots
        if slots is None:
            return -1
        ours = slots["experiment"] == experiment
        if "end" in (slots.dtype.names or ()):  # not in a session of format 1
            ours &= slots["sequence"] == slots["end"]
        return int(slots["row"][ours].max()) if ours.any() else -1

    def rows(self, experiment: int, first: int) -> NDArray[Any]:
        """Complete slots of an experiment, in order, from a row on without a gap.

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
            if not self._is_whole(slot) or int(slot["row"]) != first + keep:
                break
            keep += 1
        return np.asarray(found[:keep])

    @staticmethod
    def _is_whole(slot: np.void) -> bool:
        if "end" not in (slot.dtype.names or ()):  # of a session of format 1
            data = slot.tobytes()
            return zlib.crc32(data[4:]) == int.from_bytes(data[:4], "little")
        check = zlib.crc32(slot.tobytes()[_CHECKED])
        return bool(slot["sequence"] == slot["end"] and check == slot["check"])

    def verify(self) -> None:
        """Check every slot of a ring that is no longer written.

        One slot may be incomplete: the one after the newest, where the writer was killed.

        Raises:
            ValueError: a slot is damaged.
        """
        slots = self._slots
        if slots is None or "end" not in (slots.dtype.names or ()):
            return
        sequence, end, count = slots["sequence"], slots["end"], len(slots)
        last = int(end.max())
        for place, slot in enumerate(slots):
            if not slot["end"] and not slot["sequence"]:
                continue
            cut = place == last % count and int(slot["end"]) in (0, last + 1 - count)
            if (int(end[place]) - 1 - place) % count == 0 and self._is_whole(slot):
                continue
            if cut and int(sequence[place]) in (last + 1, int(slot["end"])):
                continue
            raise ValueError(f"slot {place} of the tail does not match its checksum")

    def close(self) -> None:
        """Release the file."""
        self._slots = None
