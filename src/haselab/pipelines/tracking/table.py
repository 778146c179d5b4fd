"""The table of tracks: rows of a CSV file, formatted many at a time.

Numbers are formatted with tables of digit groups, eight bytes each, about 0.3 us per row, so that
writing does not slow down tracking.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from haselab.tracking import LossReason, Tracks
from haselab.tracking.options import Floats

__all__ = ["COLUMNS", "METRES", "Block", "TrackRows", "reason_name"]

# The columns of the public contract; then displacements if there is a scale, and the reason.
COLUMNS = ("frame", "time_s", "point", "x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid")
METRES = ("displacement_x_m", "displacement_y_m")

Words = NDArray[np.uint64]

_GROUP = 100_000  # five digits
_NAN, _INF = 2 * _GROUP, 2 * _GROUP + 1  # indices in the table of integers
_PIXEL_STEP, _METRE_STEP = 1e-5, 1e-12  # last digit of a position, of a displacement


@dataclass(frozen=True)
class Block:
    """Some consecutive frames of tracks.

    Args:
        first: how many frames were read before.
        time_s: times of the frames, in s. Shape `(F,)`.
        tracks: of all points. Shape `(F, P)`.
        number: numbers of the frames in the recording, including missing ones. Shape `(F,)`.
    """

    first: int
    time_s: Floats
    tracks: Tracks
    number: NDArray[np.intp]


def reason_name(mask: int) -> str:
    """Why a point is not valid, as one word of the table; empty if it is valid."""
    return "+".join(str(flag.name).lower() for flag in LossReason if mask & flag)


def _as_words(texts: Sequence[bytes]) -> Words:
    """Pad texts with zero bytes to rows of 64-bit words. Shape `(N, words)`."""
    width = -(-max(len(text) for text in texts) // 8) * 8
    return np.array(texts, f"S{width}").view(np.uint64).reshape(len(texts), -1)


@cache
def _digits(count: int) -> NDArray[np.uint8]:
    """The last `count` digits of 0 to 99,999 as characters. Shape `(100000, count)`."""
    powers = 10 ** np.arange(count - 1, -1, -1)
    return (np.arange(_GROUP)[:, None] // powers % 10 + ord("0")).astype(np.uint8)


@cache
def _integers() -> Words:
    """Texts of 0 to 99,999, of their negatives, and of nan and inf."""
    text = np.zeros((2 * _GROUP + 2, 8), np.uint8)
    digits = _digits(5)
    blank = (np.cumsum(digits != ord("0"), axis=1) == 0) & (np.arange(5) < 4)
    text[:_GROUP, 1:6] = text[_GROUP:_NAN, 1:6] = np.where(blank, 0, digits)
    text[_GROUP:_NAN, 0] = ord("-")
    for place, word in ((_NAN, b"nan"), (_INF, b"inf")):
        text[place, :3] = np.frombuffer(word, np.uint8)
    return text.view(np.uint64).reshape(-1)


@cache
def _group(before: str, count: int, after: str) -> Words:
    """Digit groups between two texts; one more entry with only `after`, for nan."""
    text = np.zeros((_GROUP + 1, 8), np.uint8)
    start = len(before)
    text[:_GROUP, :start] = np.frombuffer(before.encode(), np.uint8)
    text[:_GROUP, start : start + count] = _digits(count)
    text[:_GROUP, start + count : start + count + len(after)] = np.frombuffer(
        after.encode(), np.uint8
    )
    text[_GROUP, : len(after)] = np.frombuffer(after.encode(), np.uint8)
    return text.view(np.uint64).reshape(-1)


def _fixed(values: Floats, step: float, groups: Sequence[tuple[Words, int]]) -> list[Words]:
    """Format numbers in fixed point: the integer part, then groups of digits and a comma."""
    finite = np.isfinite(values)
    scale = round(1.0 / step)
    units = np.rint(np.abs(np.where(finite, values, 0.0)) / step).astype(np.int64)
    whole, part = np.divmod(units, scale)
    place = np.where((values < 0.0) & (units > 0), whole + _GROUP, whole)
    huge = (whole >= _GROUP) | np.isinf(values)
    place = np.where(np.isnan(values), _NAN, np.where(huge, _INF, place))
    words = [_integers()[place]]
    blank = ~finite | huge
    for table, digits in groups:
        scale //= 10**digits
        head, part = np.divmod(part, scale) if scale > 1 else (part, part)
        words.append(table[np.where(blank, _GROUP, head)])
    return words


class TrackRows:
    """Formats rows of the table.

    Args:
        names: of the points.
        metres_per_px: scale of the displacements, if known.
    """

    def __init__(self, names: Sequence[str], metres_per_px: float | None) -> None:
        self._metres_per_px = metres_per_px
        self._names = _as_words([_field(name) for name in names] or [b","])
        self._flags = _as_words([b"0,", b"1,"])[:, 0]

    def header(self) -> bytes:
        """The header line."""
        metres = () if self._metres_per_px is None else METRES
        return (",".join((*COLUMNS, *metres, "reason")) + "\n").encode()

    def block(self, block: Block, rest_px: Floats) -> bytes:
        """Format all points of some frames, frame by frame. `rest_px` has the shape `(P, 2)`."""
        frames, points = block.tracks.x_px.shape
        tracks = block.tracks
        reason = np.zeros(tracks.valid.shape, np.uint16) if tracks.reason is None else tracks.reason
        numbers = (tracks.x_px, tracks.y_px, tracks.std_x_px, tracks.std_y_px, tracks.quality)
        return self.rows(
            np.repeat(block.number, points),
            np.repeat(block.time_s, points),
            np.tile(np.arange(points), frames),
            np.stack([column.ravel() for column in numbers]),
            reason.ravel(),
            np.tile(rest_px.T, frames),
        )

    def rows(
        self,
        frame: NDArray[np.intp],
        time_s: Floats,
        point: NDArray[np.intp],
        numbers: Floats,
        reason: NDArray[np.uint16],
        rest_px: Floats,
    ) -> bytes:
        """Format any rows, in the order of the frames.

        Args:
            frame, time_s, point, reason: number of the frame, its time in s, index of the point's
                name, why it is not valid. Shape `(R,)`.
            numbers: x, y, their deviations, quality. Shape `(5, R)`.
            rest_px: origin of the displacement. Shape `(2, R)`.

        Returns:
            The lines.
        """
        if not frame.size:
            return b""
        _, start, place = np.unique(frame, return_index=True, return_inverse=True)
        heads = _as_words([b"%d,%s," % (frame[k], f"{time_s[k]:.9g}".encode()) for k in start])
        columns: list[Words] = [*heads[place].T, *self._names[point].T]
        five = [(_group(".", 5, ","), 5)]
        for values in numbers:
            columns += _fixed(values, _PIXEL_STEP, five)
        columns.append(self._flags[(reason == 0).astype(np.intp)])
        if self._metres_per_px is not None:
            twelve = [(_group(".", 5, ""), 5), (_group("", 5, ""), 5), (_group("", 2, ","), 2)]
            for values, rest in zip(numbers[:2], rest_px, strict=True):
                columns += _fixed((values - rest) * self._metres_per_px, _METRE_STEP, twelve)
        masks, place = np.unique(reason, return_inverse=True)
        reasons = _as_words([f"{reason_name(int(mask))}\n".encode() for mask in masks])
        columns.extend(reasons[place].T)
        text = np.empty((frame.size, len(columns)), np.uint64)
        for k, column in enumerate(columns):
            text[:, k] = column
        characters = text.view(np.uint8).reshape(-1)
        return bytes(characters[characters != 0].data)


def _field(name: str) -> bytes:
    """Format a name as a field of CSV, with the comma."""
    line = io.StringIO()
    csv.writer(line, lineterminator=",").writerow([name.replace("\0", "")])
    return line.getvalue().encode()
