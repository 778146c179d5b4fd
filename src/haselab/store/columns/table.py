"""Named columns of numbers, whole, from CSV, MATLAB, NumPy, HDF5 and LabVIEW files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive
from haselab.store.columns.reader import ColumnStream, open_archive, rate_of_times

__all__ = ["Table", "read_table"]

Floats = NDArray[np.float64]
_PIECE_ROWS = 1 << 20
_LARGEST = 1e30  # whose powers a fit can bear


@dataclass(frozen=True)
class Table:
    """Columns of equal length.

    Args:
        columns: values by name. Shape `(N,)` each.
        rate_hz: rows a second if the file tells, else None.
        left_out: rows that a column `valid` marks with 0.
    """

    columns: Mapping[str, Floats]
    rate_hz: float | None
    left_out: int = 0

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)


def read_table(path: Path | str, columns: Sequence[str]) -> Table:
    """Read named columns of a file.

    The rate comes from a scalar `rate_hz` (or an attribute, or a line `# rate_hz = 400`), from the
    increment of LabVIEW channels, or from an evenly spaced column `time_s`. Rows with 0 in a column
    `valid`, as `haselab sense` and `haselab track` write them, are left out; then the rate comes
    from the times alone.

    Args:
        path: `.csv`, `.txt`, `.mat` (v5 and v7.3), `.npz`, `.npy`, `.h5`, `.hdf5` or `.tdms`; as
            `open_columns`, which reads larger ones.
        columns: wanted names; for HDF5, LabVIEW and structures also `group/name`.
    Returns:
        The wanted columns in SI units as they are in the file, and the rate.
    Raises:
        InputError: no such file, unknown kind, a column that is missing, empty or not of finite
            numbers, or unequal lengths.
    """
    wanted = list(dict.fromkeys(columns))
    with open_archive(path) as archive:
        stream = ColumnStream(archive, wanted, use_times=False)
        pieces = list(stream.pieces(_PIECE_ROWS))
        whole = {name: np.concatenate([p[k] for p in pieces]) for k, name in enumerate(wanted)}
        kept = _valid_rows(archive, wanted, len(whole[wanted[0]]))
        values = {name: _finite(name, column[kept], archive.file) for name, column in whole.items()}
        left_out = int(np.count_nonzero(~kept))
        rate_hz = None if left_out else stream.rate_hz
        if rate_hz is None:
            rate_hz = _rate_of_times(archive, values, kept)
    return Table(values, rate_hz, left_out)


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


def _column(archive: Archive, name: str) -> NDArray[Any] | None:
    """A column that nobody asked for; None where there is none of numbers."""
    try:
        if archive.locate(name) is None:
            return None
        stream = ColumnStream(archive, [name], use_times=False)
        return np.concatenate([piece for (piece,) in stream.pieces(_PIECE_ROWS)])
    except InputError:
        return None


def _rate_of_times(
    archive: Archive, values: Mapping[str, Floats], kept: NDArray[np.bool_]
) -> float | None:
    """From a column of times, wanted or not."""
    if "time_s" in values:
        return rate_of_times(values["time_s"])
    times = _column(archive, "time_s")
    return None if times is None or times.size != kept.size else rate_of_times(times[kept])


def _finite(name: str, values: NDArray[Any], file: Path) -> Floats:
    vector = np.ascontiguousarray(values, dtype=np.float64)
    bad = np.flatnonzero(~(np.abs(vector) <= _LARGEST))
    if bad.size:
        raise InputError(
            f"Column {name} holds {vector[bad[0]]:g} in row {bad[0] + 1} ({bad.size} such rows); "
            f"allowed are finite numbers up to {_LARGEST:g}. Remove these rows: {file}"
        )
    return vector
