"""Analyse the times of a file: rate, jitter, missing rows; split it into records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.identify.record import Record
from haselab.store.columns.table import Table

__all__ = ["TimeAxis", "check_complete", "check_rising", "records_of", "time_axis"]

Floats = NDArray[np.float64]
_FEW_MISSING = 3  # rows whose input is interpolated
_LEAST_ROWS = 50  # of a part between two gaps
_JITTER = 0.45  # of a step: with more, rows cannot be numbered


@dataclass(frozen=True)
class TimeAxis:
    """Times of rows on a clock with a constant rate.

    Args:
        rate_hz: rows per second, including missing ones.
        number: number of each row on that clock; numbers of missing rows are left out. `(N,)`.
        time_s: times since the first row, in s. Shape `(N,)`.
    """

    rate_hz: float
    number: NDArray[np.intp]
    time_s: Floats

    @property
    def missing(self) -> int:
        """Number of missing rows."""
        return int(self.number[-1]) + 1 - self.number.size

    @property
    def jitter_s(self) -> float:
        """Rms deviation of the times from the clock, in s."""
        return float(np.std(self.time_s - self.number / self.rate_hz))


def check_rising(time_s: NDArray[np.float64], file: Path, name: str) -> None:
    """Refuse times that do not increase.

    Args:
        time_s: column of times. Shape `(N,)`.
        file: where they are from, for the message.
        name: of the column.
    Raises:
        InputError: a step that is not above 0.
    """
    steps = np.diff(time_s)
    if not (steps > 0.0).all():
        at = int(np.flatnonzero(~(steps > 0.0))[0])
        raise InputError(
            f"Column {name} does not increase after row {at + 1} (step of {steps[at]:g} s). Sort "
            f"the rows, or remove repeated ones: {file}"
        )


def check_complete(axis: TimeAxis, file: Path, name: str) -> None:
    """Refuse times with missing rows.

    Args:
        axis: of the times.
        file: where they are from, for the message.
        name: of their column.
    Raises:
        InputError: a missing row; the rows after it are later than a constant rate says.
    """
    if not axis.missing:
        return
    at = int(np.flatnonzero(np.diff(axis.number) > 1)[0])
    step_s = float(axis.time_s[at + 1] - axis.time_s[at])
    raise InputError(
        f"Column {name} has a step of {step_s:g} s after row {at + 1} instead of "
        f"{1.0 / axis.rate_hz:g} s; in the whole file {axis.missing} rows are missing. Split it at "
        f"each gap, or resample the record: {file}"
    )


def time_axis(time_s: Floats, file: Path, name: str = "time_s") -> TimeAxis:
    """Find the rate and the row numbers of recorded times.

    Args:
        time_s: of the rows, in s. Shape `(N,)`.
        file: of the times, for messages.
        name: of their column, for messages.
    Returns:
        The clock of these times.
    Raises:
        InputError: fewer than two times, times that do not increase, or too uneven for one rate.
    """
    if time_s.size < 2:
        raise InputError(f"Column {name} has {time_s.size} times. Record longer: {file}")
    check_rising(time_s, file, name)
    steps = np.diff(time_s)
    usual_s = float(np.median(steps))
    since_s = time_s - time_s[0]
    number = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / usual_s), 1.0))])
    for _ in range(3):
        slope_s = float(np.polyfit(number, since_s, 1)[0])
        number = np.rint((since_s - np.median(since_s - slope_s * number)) / slope_s)
        number -= number[0]
    off = np.abs(since_s - slope_s * number - np.median(since_s - slope_s * number)).max()
    if (np.diff(number) < 1.0).any() or off > _JITTER * slope_s:
        raise InputError(
            f"Column {name} is too uneven for one rate: steps of {steps.min():g} to "
            f"{steps.max():g} s. Split the file into parts with one rate: {file}"
        )
    return TimeAxis(1.0 / slope_s, number.astype(np.intp), since_s)


def records_of(
    table: Table,
    columns: Sequence[str],
    axis: TimeAxis,
    hold: str,
    *,
    hold_assumed: bool = False,
) -> list[Record]:
    """Split uneven rows into records whose notes say what was done.

    The input is assumed to change on the clock; the output is used at its own times. The input of
    up to 3 missing rows in one place is interpolated. After a larger gap a new record begins, with
    its own initial state.

    Args:
        table: with the columns.
        columns: names of input and output.
        axis: times of the rows.
        hold: how the input behaves between its updates, see `Record`.
        hold_assumed: whether the hold was not stated.
    """
    u, y = table[columns[0]], table[columns[1]]
    cuts = np.flatnonzero(np.diff(axis.number) > _FEW_MISSING + 1) + 1
    records, left_out = [], 0
    for rows in np.split(np.arange(u.size), cuts):
        if rows.size < _LEAST_ROWS or np.ptp(u[rows]) == 0.0 or np.ptp(y[rows]) == 0.0:
            left_out += rows.size
            continue
        first = int(axis.number[rows[0]])
        number = axis.number[rows] - first
        source = np.interp(np.arange(number[-1] + 1), number, u[rows])
        times_s = axis.time_s[rows] - first / axis.rate_hz
        times_s = np.where(np.abs(times_s * axis.rate_hz - number) < 1e-6, number / axis.rate_hz,
                           times_s)  # fmt: skip
        records.append(Record(source, axis.rate_hz, y[rows], times_s, None, hold, hold_assumed))
    notes = []
    if axis.missing:
        notes.append(
            f"{axis.missing} rows are missing in {int((np.diff(axis.number) > 1).sum())} places; "
            f"split into {len(records)} record{'s' if len(records) > 1 else ''}, each with its own "
            "initial state."
        )
    if axis.jitter_s > 1e-3 / axis.rate_hz:
        notes.append(
            f"The times jitter by {axis.jitter_s:.2g} s rms: the output is used at its own times, "
            f"the input is assumed to change every {1.0 / axis.rate_hz:.6g} s."
        )
    if left_out:
        notes.append(
            f"{left_out} rows are excluded: their parts between gaps are constant or shorter than "
            f"{_LEAST_ROWS} rows."
        )
    return [replace(record, notes=tuple(notes)) for record in records]
