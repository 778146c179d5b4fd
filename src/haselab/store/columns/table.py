"""Named columns of numbers, whole, from CSV, MATLAB, NumPy, HDF5 and LabVIEW files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive
from haselab.store.columns.reader import ColumnStream, open_archive, rate_of_times
from haselab.store.columns.selection import (
    AS_THE_FILE_STATES,
    ColumnOptions,
    assumed_seconds,
    time_column,
)
from haselab.store.columns.units import Unit

__all__ = ["Table", "read_table"]

Floats = NDArray[np.float64]
_PIECE_ROWS = 1 << 20
_LARGEST = 1e30  # powers of it do not overflow in a fit


@dataclass(frozen=True)
class Table:
    """Columns of equal length, in SI units.

    Args:
        columns: values by the name that was asked for. Shape `(N,)` each.
        rate_hz: rows a second if the file states it, else None.
        left_out: rows that a column `valid` marks with 0.
        units: unit that each column states, by the same names; None where it states none.
        time_name: column of the times, if there is one.
        assumed_seconds: no unit of these times is stated anywhere: they are taken as seconds.
        time_s: its values. Shape `(N,)`.
    """

    columns: Mapping[str, Floats]
    rate_hz: float | None
    left_out: int = 0
    units: Mapping[str, Unit | None] = field(default_factory=dict)
    time_name: str | None = None
    time_s: Floats | None = None
    assumed_seconds: bool = False

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)


def read_table(
    path: Path | str, columns: Sequence[str], options: ColumnOptions = AS_THE_FILE_STATES
) -> Table:
    """Read named columns of a file.

    The rate comes from a scalar `rate_hz` (or an attribute, or a line `# rate_hz = 400`), from the
    increment of LabVIEW channels, or from an evenly spaced column of times. Rows with 0 in a column
    `valid`, as `haselab sense` and `haselab track` write them, are left out; then the rate comes
    from the times alone.

    Args:
        path: as `open_columns`, which reads larger files.
        columns: wanted names, as `open_columns` takes them.
        options: the column of times, and units, where the file does not state them.
    Returns:
        The wanted columns in SI units, and the rate.
    Raises:
        InputError: no such file, unknown kind, a column that is missing, empty or not of finite
            numbers, or unequal lengths.
    """
    wanted = list(dict.fromkeys(columns))
    with open_archive(path) as archive:
        stream = ColumnStream(archive, wanted, use_times=False, options=options)
        pieces = list(stream.pieces(_PIECE_ROWS))
        whole = {name: np.concatenate([p[k] for p in pieces]) for k, name in enumerate(wanted)}
        kept = _valid_rows(archive, wanted, len(whole[wanted[0]]))
        values = {name: _finite(name, column[kept], archive.file) for name, column in whole.items()}
        left_out = int(np.count_nonzero(~kept))
        rate_hz = None if left_out else stream.rate_hz
        time_name, time_s = None, None
        if rate_hz is None:
            time_name, time_s = _times(archive, kept, options)
            rate_hz = None if time_s is None else rate_of_times(time_s)
        units = dict(zip(wanted, stream.units, strict=True))
        assumed = time_name is not None and assumed_seconds(archive, time_name, options)
    return Table(values, rate_hz, left_out, units, time_name, time_s, assumed)


def _valid_rows(archive: Archive, wanted: Sequence[str], rows: int) -> NDArray[np.bool_]:
    """Rows that no column `valid` marks with 0, shape `(rows,)`."""
    every = np.ones(rows, dtype=np.bool_)
    if "valid" in wanted or (valid := _column(archive, "valid")) is None or valid.size != rows:
        return every
    kept = np.asarray(valid != 0.0, dtype=np.bool_)
    if not kept.any():
        raise InputError(
            f"All {rows} rows have 0 in column valid, so none can be used: {archive.file}"
        )
    return kept


def _column(
    archive: Archive, name: str, options: ColumnOptions = AS_THE_FILE_STATES
) -> NDArray[Any] | None:
    """Read an optional column; None if there is no such column of numbers."""
    try:
        if archive.locate(name) is None:
            return None
        stream = ColumnStream(archive, [name], use_times=False, options=options)
        return np.concatenate([piece for (piece,) in stream.pieces(_PIECE_ROWS)])
    except InputError:
        return None


def _times(
    archive: Archive, kept: NDArray[np.bool_], options: ColumnOptions
) -> tuple[str | None, Floats | None]:
    """Read the column of times; return None if there is none of finite numbers."""
    name = time_column(archive, options)
    if name is None:
        return None, None
    times = _column(archive, name, options)
    if times is None or times.size != kept.size or not np.isfinite(times[kept]).all():
        if options.time is not None:
            raise InputError(
                f"Column {options.time} has no times: each row needs a number of seconds, or of "
                f"the unit that --unit states. Name another column with --time: {archive.file}"
            )
        return None, None
    time_s = np.asarray(times[kept], dtype=np.float64)
    if options.time is None and name != "time_s" and not (np.diff(time_s) > 0.0).all():
        return None, None  # a column that is only called like one of times, such as t
    return name, time_s


def _finite(name: str, values: NDArray[Any], file: Path) -> Floats:
    vector = np.ascontiguousarray(values, dtype=np.float64)
    bad = np.flatnonzero(~(np.abs(vector) <= _LARGEST))
    if bad.size:
        raise InputError(
            f"Column {name} has {vector[bad[0]]:g} in row {bad[0] + 1} ({bad.size} such rows). "
            f"Remove these rows, or use finite numbers up to {_LARGEST:g}: {file}"
        )
    return vector
