"""Named columns of numbers, whole, from CSV, MATLAB, NumPy, HDF5 and LabVIEW files."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Archive
from haselab.store.columns.reader import ColumnStream, open_archive, rate_of_times
from haselab.store.columns.selection import (
    AS_THE_FILE_STATES,
    ColumnOptions,
    assumed_seconds,
    certain_times,
    stated_unit,
    time_column,
    why_no_times,
)
from haselab.store.columns.units import Unit
from haselab.store.optional import library

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["Table", "read_every_column", "read_table"]

Floats = NDArray[np.float64]
_CHUNK_ROWS = 1 << 20
_SHOWN_ROWS = 5
_LARGEST = 1e30  # powers of it do not overflow in a fit


@dataclass(frozen=True, repr=False)
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
        why_no_times: why a column that is called like one of times is none; empty: there is none.
        full_names: name of a column by its name in the file, with group and unit, which finds it
            too.
    """

    columns: Mapping[str, Floats]
    rate_hz: float | None
    left_out: int = 0
    units: Mapping[str, Unit | None] = field(default_factory=dict)
    time_name: str | None = None
    time_s: Floats | None = None
    assumed_seconds: bool = False
    why_no_times: str = ""
    full_names: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Size, rate and columns, with the units that they state."""
        rows = next(iter(self.columns.values())).size if self.columns else 0
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:g} Hz"
        stated = {
            n: unit.si for n, unit in self.units.items() if unit is not None and unit.si != "1"
        }
        names = [f"{name} ({stated[name]})" if stated.get(name) else name for name in self]
        return f"Table of {rows} rows{rate}: {', '.join(names)}"

    def __contains__(self, name: object) -> bool:
        return name in self.columns or name in self.full_names

    def __getitem__(self, name: str) -> Floats:
        name = name if name in self.columns else self.full_names.get(name, name)
        if name not in self.columns:
            raise InputError(
                f"There is no column {name!r}; the table has {', '.join(self)}. Name one of these."
            )
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def to_pandas(self) -> pandas.DataFrame:
        """The columns as a pandas DataFrame, its attributes the rate and the units.

        Returns:
            A row for each row of the table.
        Raises:
            InputError: pandas is not installed.
        """
        frame: pandas.DataFrame = library("pandas", "frames").DataFrame(dict(self.columns))
        if self.rate_hz is not None:
            frame.attrs["rate_hz"] = self.rate_hz
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """The columns as an xarray Dataset over the time, or over `row` where there is none.

        Returns:
            The data set; each variable states its unit where the table knows it.
        Raises:
            InputError: xarray is not installed.
        """
        over = "row" if self.time_name is None else self.time_name
        columns = {n: (over, v, _unit_of(n)) for n, v in self.columns.items() if n != over}
        times = {} if self.time_s is None else {over: (over, self.time_s, {"units": "s"})}
        known = {} if self.rate_hz is None else {"rate_hz": self.rate_hz}
        dataset: xarray.Dataset = library("xarray", "frames").Dataset(columns, times, known)
        return dataset

    def _repr_html_(self) -> str:
        """First rows, as a notebook shows them."""
        shown = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        head = np.stack([values[:_SHOWN_ROWS] for values in self.columns.values()], axis=1)
        rows = "".join(
            "<tr>" + "".join(f"<td>{value:.6g}</td>" for value in row) + "</tr>" for row in head
        )
        count = next(iter(self.columns.values())).size
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:g} Hz"
        return f"<table><tr>{shown}</tr>{rows}</table><p>{count} rows{rate}</p>"


_UNITS = {"_v": "V", "_s": "s", "_f": "F", "_ohm": "ohm", "_m": "m", "_px": "px", "_n": "N",
          "_pa": "Pa", "_rad": "rad", "_hz": "Hz"}  # fmt: skip


def _unit_of(name: str) -> dict[str, str]:
    return next(({"units": unit} for end, unit in _UNITS.items() if name.endswith(end)), {})


def read_every_column(path: Path | str) -> Table:
    """Read all columns of numbers of a file.

    Args:
        path: as `read_table`.
    Returns:
        The table in SI units, without the rows that a column `valid` marks with 0.
    Raises:
        InputError: no such file, unknown kind, or no column of numbers.
    """
    with open_archive(path) as archive:
        plain = [archive.plain_name(full) for full in archive.names]
        names = {
            full: name if plain.count(name) == 1 else full
            for full, name in zip(archive.names, plain, strict=True)
        }
        found = {name: _column(archive, name) for name in names.values() if name != "valid"}
        columns = {name: values for name, values in found.items() if values is not None}
        longest = max((values.size for values in columns.values()), default=0)
        wanted = [name for name, values in columns.items() if values.size == longest]
    if not longest:
        raise InputError(f"The file has no column of numbers. {path}")
    full_names = {full: name for full, name in names.items() if name in wanted and name != full}
    return replace(read_table(path, wanted), full_names=full_names)


def read_table(
    path: Path | str,
    columns: Sequence[str],
    options: ColumnOptions = AS_THE_FILE_STATES,
    may_lack: Collection[str] = (),
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
        may_lack: columns in which values may be NaN. A row with 0 in a column `valid` is then kept,
            without these values.
    Returns:
        The wanted columns in SI units, and the rate.
    Raises:
        InputError: no such file, unknown kind, a column that is missing, empty or not of finite
            numbers, or unequal lengths.
    """
    wanted = list(dict.fromkeys(columns))
    with open_archive(path) as archive:
        stream = ColumnStream(archive, wanted, use_times=False, options=options)
        chunks = list(stream.chunks(_CHUNK_ROWS))
        whole = {name: np.concatenate([p[k] for p in chunks]) for k, name in enumerate(wanted)}
        valid = _valid_rows(archive, wanted, len(whole[wanted[0]]))
        kept = np.ones_like(valid) if may_lack else valid
        for lacking in may_lack:
            whole[lacking] = np.where(valid, whole[lacking], np.nan)
        values = {
            name: _finite(name, column[kept], archive.file, may_lack=name in may_lack)
            for name, column in whole.items()
        }
        left_out = int(np.count_nonzero(~valid))
        rate_hz = stream.rate_hz if kept.all() else None
        time_name, time_s, why = None, None, ""
        if rate_hz is None:
            time_name, time_s, why = _times(archive, kept, options, wanted)
        if time_s is not None:
            rate_hz = rate_of_times(time_s)
        units = dict(zip(wanted, stream.units, strict=True))
        assumed = time_name is not None and assumed_seconds(archive, time_name, options)
    return Table(values, rate_hz, left_out, units, time_name, time_s, assumed, why)


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
        return _numbers(archive, name, options)
    except InputError:
        return None


def _numbers(archive: Archive, name: str, options: ColumnOptions) -> NDArray[Any]:
    stream = ColumnStream(archive, [name], use_times=False, options=options)
    return np.concatenate([chunk for (chunk,) in stream.chunks(_CHUNK_ROWS)])


def _times(
    archive: Archive, kept: NDArray[np.bool_], options: ColumnOptions, beside: Sequence[str]
) -> tuple[str | None, Floats | None, str]:
    """Read the column of times: its name and values, or why there is none."""
    name = time_column(archive, options, beside=archive.locate_all(beside))
    if name is None:
        return None, None, why_no_times(archive, options)
    surely, why = certain_times(archive, name, options), why_no_times(archive, options)
    times: NDArray[Any] | None = None
    try:
        times = _numbers(archive, name, options)
    except InputError as error:
        if surely and (name == "time_s" or stated_unit(archive, name, options)):
            raise
        why = str(error) if archive.is_clock(name) else why
    if times is None or times.size != kept.size or not np.isfinite(times[kept]).all():
        if options.time is not None:
            raise InputError(
                f"Column {options.time} has no times: each row needs a number of seconds, or of "
                f"the unit that --unit states. Name another column with --time: {archive.file}"
            )
        return None, None, why or _incomplete(name, times, kept)
    time_s = np.asarray(times[kept], dtype=np.float64)
    if not surely and not (np.diff(time_s) > 0.0).all():
        return None, None, f"Column {name} does not rise everywhere."
    return name, time_s, ""


def _incomplete(name: str, times: NDArray[Any] | None, kept: NDArray[np.bool_]) -> str:
    """Say which row of some times is not finite; empty if most are not."""
    if times is None or times.size != kept.size:
        return ""
    rows = np.flatnonzero(kept & ~np.isfinite(times))
    if rows.size > 0.5 * np.count_nonzero(kept):
        return ""
    return (
        f"Column {name} has {times[rows[0]]:g} in row {rows[0] + 1} ({rows.size} such rows): "
        "remove these rows, or write their times."
    )


def _finite(name: str, values: NDArray[Any], file: Path, *, may_lack: bool) -> Floats:
    vector = np.ascontiguousarray(values, dtype=np.float64)
    bad = np.flatnonzero(~((np.abs(vector) <= _LARGEST) | (may_lack & np.isnan(vector))))
    if bad.size:
        advice = (
            "Write nan where it was not measured. Keep the rows: the fit needs their input"
            if may_lack
            else f"Remove these rows, or use finite numbers up to {_LARGEST:g}"
        )
        raise InputError(
            f"Column {name} has {vector[bad[0]]:g} in row {bad[0] + 1} ({bad.size} such rows). "
            f"{advice}: {file}"
        )
    return vector
