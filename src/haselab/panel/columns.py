"""Live signals in shared memory: the bench writes, the web server reads, and neither waits.

The monitors are kept at several resolutions. A column of a coarser level holds the smallest and the
largest sample of its interval, so a spike of one sample is visible at every zoom. A reader copies
columns and then checks the counter again: columns that the writer has overwritten meanwhile are
left out. Blocks that nobody saw, such as those with which 0 V is read back, are missing.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import struct
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError

__all__ = ["SIGNALS", "Columns", "LiveReader", "LiveWriter"]

# of each block, in SI units
SIGNALS = ("drive_v", "reference", "capacitance_f", "strain", "residual_v")
_FACTORS = (1, 20, 200, 2000)  # samples of a column of the monitors
_KEPT = (2_000_000, 400_000, 300_000, 120_000)  # columns: 10 s, 40 s, 5 min, 20 min at 200 kHz
_BLOCKS = 120_000  # rows of the signals
_HEADER, _ABOUT = 4096, 64  # size of the header, place of its description
_COUNTERS = struct.Struct("<qq")  # blocks so far; block after the last gap
_BRIDGED_S = 2.0  # longest time without a block after which earlier data are still shown
_MARGIN = 4  # blocks: a reader keeps away from the columns that are overwritten next


class Columns(NamedTuple):
    """Part of a signal.

    Args:
        start_s: time at the start of the first column, on the rig's clock.
        step_s: duration of a column.
        low: smallest value of each column, shape `(N, channels)`.
        high: largest value, the same shape.
    """

    start_s: float
    step_s: float
    low: NDArray[np.float64]
    high: NDArray[np.float64]


class _Memory:
    """A file in memory, with a ring of columns for each level of the monitors and one of blocks."""

    def __init__(self, path: Path, *, create: bool) -> None:
        shapes = [
            (kept, 1 if factor == 1 else 2, 2) for factor, kept in zip(_FACTORS, _KEPT, strict=True)
        ]
        # time, signals, 1 if it was read or 0 if it is missing, clock of the computer
        rows = (_BLOCKS, 3 + len(SIGNALS))
        size = _HEADER + sum(2 * int(np.prod(shape)) for shape in shapes) + 8 * int(np.prod(rows))
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if create else 0)
        file = os.open(path, flags, 0o600)
        try:
            if create:
                _reserve(file, size, path.parent.parent)
            self.map = mmap.mmap(file, size)
        finally:
            os.close(file)
        place, self.monitors = _HEADER, []
        for shape in shapes:
            self.monitors.append(np.ndarray(shape, np.int16, self.map, place))
            place += self.monitors[-1].nbytes
        self.rows = np.ndarray(rows, np.float64, self.map, place)

    def use(self, block: int, levels: list[int]) -> None:
        """Shorten each level to whole blocks, so that no block wraps around."""
        for k in levels:
            columns = block // _FACTORS[k]
            self.monitors[k] = self.monitors[k][: len(self.monitors[k]) // columns * columns]

    @property
    def counters(self) -> tuple[int, int]:
        """Number of blocks so far, and the first one after the last gap."""
        blocks, first = _COUNTERS.unpack_from(self.map, 0)
        return blocks, first

    @counters.setter
    def counters(self, values: tuple[int, int]) -> None:
        _COUNTERS.pack_into(self.map, 0, *values)

    def close(self) -> None:
        self.monitors, self.rows = [], np.empty((0, 0))
        self.map.close()


class LiveWriter:
    """Writes the blocks of a bench. Use as a context, which removes the file.

    Args:
        path: of the file, in a folder in memory such as `/dev/shm`.
        rate_hz: samples a second.
        block_samples: of each channel in a block.
        scales: shown unit per code of the voltage and of the current channel.
    Raises:
        DeviceError: There is not enough space in the folder.
    """

    def __init__(
        self, path: Path, rate_hz: float, block_samples: int, scales: tuple[float, float]
    ) -> None:
        self._path, self._block_s = path, block_samples / rate_hz
        self._levels = [k for k, factor in enumerate(_FACTORS) if block_samples % factor == 0]
        self._memory = _Memory(path, create=True)
        self._memory.use(block_samples, self._levels)
        about = {
            "rate_hz": rate_hz,
            "block": block_samples,
            "scales": scales,
            "levels": self._levels,
        }
        text = json.dumps(about).encode()
        struct.pack_into(f"<i{len(text)}s", self._memory.map, _ABOUT, len(text), text)
        self._last_s = float("nan")

    def __enter__(self) -> LiveWriter:
        return self

    def __exit__(self, *exc: object) -> None:
        self._memory.close()
        self._path.unlink(missing_ok=True)

    def append(self, codes: NDArray[np.int16], time_s: float, values: tuple[float, ...]) -> None:
        """Add a block.

        Args:
            codes: of both monitors, shape `(block_samples, 2)`.
            time_s: at the end of the block. Blocks that are missing before it are counted; if
                they last longer than 2 s, earlier blocks are not shown any more.
            values: of `SIGNALS`; NaN: there is none.
        """
        memory = self._memory
        count, first = memory.counters
        missing = (time_s - self._last_s) / self._block_s - 1.0
        if not -0.5 < missing <= _BRIDGED_S / self._block_s:
            first = count
        else:
            nothing = (math.nan,) * len(values)
            for k in range(round(missing)):
                at_s = self._last_s + (k + 1) * self._block_s
                memory.rows[count % _BLOCKS] = (at_s, *nothing, 0.0, time.monotonic())
                count += 1
                memory.counters = (count, first)
        for k in self._levels:
            columns, ring = len(codes) // _FACTORS[k], memory.monitors[k]
            start = count * columns % len(ring)
            into = ring[start : start + columns]
            if _FACTORS[k] == 1:
                into[:, 0] = codes
            else:
                parts = codes.reshape(columns, _FACTORS[k], 2)
                np.minimum.reduce(parts, axis=1, out=into[:, 0])
                np.maximum.reduce(parts, axis=1, out=into[:, 1])
        memory.rows[count % _BLOCKS] = (time_s, *values, 1.0, time.monotonic())
        memory.counters = (count + 1, first)
        self._last_s = time_s


class LiveReader:
    """Reads what a `LiveWriter` has written.

    Args:
        path: of the writer's file.
    """

    def __init__(self, path: Path) -> None:
        self._memory = _Memory(path, create=False)
        (size,) = struct.unpack_from("<i", self._memory.map, _ABOUT)
        about = json.loads(self._memory.map[_ABOUT + 4 : _ABOUT + 4 + size])
        self._rate_hz, self._scales = float(about["rate_hz"]), np.array(about["scales"])
        self._block, self._levels = int(about["block"]), list(about["levels"])
        self._memory.use(self._block, self._levels)

    def close(self) -> None:
        """Close the file."""
        self._memory.close()

    @property
    def blocks(self) -> int:
        """Number of blocks so far."""
        return self._memory.counters[0]

    @property
    def end_s(self) -> float:
        """Time at the end of the last block, on the rig's clock; NaN before the first."""
        count = self.blocks
        return float(self._memory.rows[(count - 1) % _BLOCKS, 0]) if count else float("nan")

    @property
    def gap_s(self) -> float:
        """When the time of the rig last jumped, on its clock; NaN: never, or too long ago.

        Earlier data are not shown.
        """
        count, first = self._memory.counters
        if first == 0 or count - first > _BLOCKS - _MARGIN:
            return float("nan")
        return float(self._memory.rows[first % _BLOCKS, 0]) - self._block / self._rate_hz

    @property
    def written_s(self) -> float:
        """When the last block was written, on the monotonic clock of the computer; NaN: never."""
        count = self.blocks
        return float(self._memory.rows[(count - 1) % _BLOCKS, -1]) if count else float("nan")

    def monitors(self, from_s: float, to_s: float, most: int) -> Columns:
        """Both monitors between two times, reduced to the smallest and the largest values.

        A column begins at a multiple of its duration, so a view that moves does not flicker.

        Args:
            from_s: first time, on the rig's clock.
            to_s: last time.
            most: largest number of columns.
        Returns:
            Values in the unit of the writer's scales, NaN where blocks are missing; channels are
            voltage and current.
        """
        wanted = max((to_s - from_s) / max(most, 1) * self._rate_hz, 1.0)  # samples of a column
        usable = [k for k in self._levels if _FACTORS[k] <= wanted] or self._levels[:1]
        reaching = [k for k in self._levels[usable[-1] :] if self._oldest_s(k) <= from_s]
        level = (reaching or self._levels[-1:])[0]
        factor, ring = _FACTORS[level], self._memory.monitors[level]
        per = max(
            -(-int(np.ceil(wanted)) // factor), 1
        )  # columns of the ring for one of the answer
        begin, end, zero_s = self._span(level, from_s, to_s)
        begin += -begin % per
        end = begin + max(end - begin, 0) // per * per
        copy = _copied(ring, begin, end)
        lost = self._first(level) - begin  # overwritten while they were copied
        if lost > 0:
            lost += -lost % per
            begin, copy = begin + lost, copy[lost:]
        low, high = copy[:, 0], copy[:, -1]
        step_s, block = factor / self._rate_hz, self._block // factor
        ends = begin // block, -(-(begin + len(copy)) // block)  # blocks
        missing = _copied(self._memory.rows[:, -2], *ends) == 0.0
        if missing.any():
            those = np.repeat(missing, block)[begin - ends[0] * block :][: len(copy), np.newaxis]
            low, high = np.where(those, 32767, low), np.where(those, -32768, high)
        low = low.reshape(-1, per, 2).min(axis=1, initial=32767)
        high = high.reshape(-1, per, 2).max(axis=1, initial=-32768)
        known = low <= high
        return Columns(
            zero_s + begin * step_s,
            per * step_s,
            np.where(known, low * self._scales, math.nan),
            np.where(known, high * self._scales, math.nan),
        )

    def _first(self, level: int) -> int:
        """First column of a level that is still valid."""
        count, first = self._memory.counters
        columns = self._block // _FACTORS[level]
        kept = min(len(self._memory.monitors[level]), _BLOCKS * columns)
        return max((count + _MARGIN) * columns - kept, first * columns)

    def _oldest_s(self, level: int) -> float:
        count, first = self._memory.counters
        kept = len(self._memory.monitors[level]) * _FACTORS[level] // self._block
        kept = min(kept, _BLOCKS) - _MARGIN
        return self.end_s - min(count - first, kept) * self._block / self._rate_hz

    def _span(self, level: int, from_s: float, to_s: float) -> tuple[int, int, float]:
        """First column and the one after the last, and the time of column 0."""
        count = self.blocks
        if count == 0:
            return 0, 0, from_s
        end_s = float(self._memory.rows[(count - 1) % _BLOCKS, 0])
        columns, step_s = self._block // _FACTORS[level], _FACTORS[level] / self._rate_hz
        zero_s = end_s - count * columns * step_s
        begin = int(np.floor((from_s - zero_s) / step_s))
        end = int(np.ceil((to_s - zero_s) / step_s))
        first = self._first(level)
        return min(max(begin, first), count * columns), min(end, count * columns), zero_s

    def signals(self, from_s: float, to_s: float, most: int) -> Columns:
        """The signals of the blocks between two times, reduced like the monitors.

        Args:
            from_s: first time, on the rig's clock.
            to_s: last time.
            most: largest number of columns.
        Returns:
            One channel for each of `SIGNALS`; NaN where no block of a column has a value.
        """
        count, first = self._memory.counters
        block_s = self._block / self._rate_hz
        if count == 0:
            return Columns(
                from_s, block_s, np.empty((0, len(SIGNALS))), np.empty((0, len(SIGNALS)))
            )
        zero_s = float(self._memory.rows[(count - 1) % _BLOCKS, 0]) - count * block_s
        begin = max(int(np.floor((from_s - zero_s) / block_s)), first, count - _BLOCKS + _MARGIN, 0)
        end = min(int(np.ceil((to_s - zero_s) / block_s)), count)
        per = max(-(-(end - begin) // max(most, 1)), 1)
        begin += -begin % per
        end = begin + max(end - begin, 0) // per * per
        rows = _copied(self._memory.rows[:, 1:-2], begin, end)
        parts = rows.reshape(-1, per, len(SIGNALS))
        low, high = np.fmin.reduce(parts, axis=1), np.fmax.reduce(parts, axis=1)
        return Columns(zero_s + begin * block_s, per * block_s, low, high)


def _reserve(file: int, size: int, folder: Path) -> None:
    """Reserve the space of a file: without it, a write to full memory ends the process by SIGBUS.

    Raises:
        DeviceError: There is not enough space.
    """
    try:
        os.ftruncate(file, size)
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file, 0, size)
    except OSError as error:
        raise DeviceError(
            f"There is no space for the live signals ({error.strerror}). Free at least "
            f"{-(-size // 1_000_000)} MB in {folder}."
        ) from None


def _copied(ring: NDArray[Any], begin: int, end: int) -> NDArray[Any]:
    """Copy rows of a ring, counted since its first one."""
    first, count = begin % len(ring), end - begin
    head = ring[first : first + count]
    if len(head) == count:
        return head.copy()
    return np.concatenate([head, ring[: count - len(head)]])
