"""Read named columns of numbers in parts, from files that may be larger than memory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, InputError
from haselab.base.exits import no_exit
from haselab.base.registry import Registry
from haselab.store.columns.archive import Archive
from haselab.store.columns.selection import (
    AS_THE_FILE_STATES,
    ColumnOptions,
    assumed_seconds,
    certain_times,
    check_assumed_seconds,
    stated_unit,
    time_column,
)
from haselab.store.columns.units import Unit

__all__ = [
    "FORMATS",
    "ColumnStream",
    "check_rate",
    "check_times",
    "head_of_times",
    "open_archive",
    "open_columns",
    "pairs_of",
    "rate_of_times",
    "rates_agree",
]

_HEAD_ROWS = 4096
_HDF5, _MAT_HEADER_BYTES = b"\x89HDF\r\n\x1a\n", 512
_UNITS_OF_TIME = {"ms": 1e3, "us": 1e6}  # per second
_NEVER_NEGATIVE = {"F": "a capacitance", "kg": "a mass", "Hz": "a frequency", "Ω": "a resistance"}
_EVEN = 0.01  # of a step: how far times may be from even ones

_TEXT_ENDINGS = (".csv", ".txt", ".tsv", ".tab", ".dat", ".asc", ".lvm", ".prn")


def _fault(archive: object, ending: str) -> str:
    """Return what is wrong with the class of an entry point, or an empty text."""
    if not ending.startswith("."):
        return "its name is not the ending of a file, such as .xyz"
    is_archive = isinstance(archive, type) and issubclass(archive, Archive)
    return "" if is_archive else "it is not a class derived from Archive"


FORMATS: Registry[Callable[[Path, contextlib.ExitStack], Archive]] = Registry(
    "file format",
    "haselab.formats",
    {
        ending: f"haselab.store.columns.{place}"
        for ending, place in {
            **dict.fromkeys(_TEXT_ENDINGS, "text.csv_file:CsvArchive"),
            ".mat": "mat:MatArchive",
            ".npz": "numpy_file:NpzArchive",
            ".npy": "numpy_file:NpyArchive",
            ".h5": "hdf5:Hdf5Archive",
            ".hdf5": "hdf5:Hdf5Archive",
            ".tdms": "tdms:TdmsArchive",
        }.items()
    },
    _fault,
)


def _unreadable(file: Path, error: Exception) -> InputError:
    """Make the error for a damaged file, for which the libraries raise any exception."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"The file cannot be read ({reason}). Export it again: {file}")


def _is_hdf5(file: Path) -> bool:
    """As version 7.3 is: HDF5 behind a header of 512 bytes, or of none."""
    with file.open("rb") as stream:
        head = stream.read(_MAT_HEADER_BYTES + len(_HDF5))
    return head.startswith(_HDF5) or head[_MAT_HEADER_BYTES:] == _HDF5


def open_archive(path: Path | str) -> Archive:
    """Open a file of columns; only the names and places of the columns are read.

    Args:
        path: of a file; its ending states its kind.
    Returns:
        The open file; close it.
    Raises:
        InputError: no such file, unknown kind, or damaged.
    """
    file = Path(path)
    if file.is_dir():
        raise InputError(f"The path is a folder, not a file. Name the file in it: {file}")
    if not file.is_file():
        raise InputError(f"There is no such file. Check the path: {file}")
    kind = file.suffix.lower()
    if kind not in FORMATS.packages():
        raise InputError(
            f"Files with the ending '{kind}' are not supported. Export the data as CSV, or as one "
            f"of {' '.join(FORMATS.packages())}: {file}"
        )
    if file.stat().st_size == 0 and kind not in _TEXT_ENDINGS:
        raise InputError(f"The file is empty. Record again: {file}")
    if kind == ".mat" and _is_hdf5(file):
        kind = ".h5"  # version 7.3
    opener = FORMATS.find(kind)  # which imports it now: `haselab sense` must start fast
    opened = contextlib.ExitStack()
    try:
        with no_exit():
            return opener(file, opened)
    except InputError:
        opened.close()
        raise
    except Exception as error:
        opened.close()
        raise _unreadable(file, error) from error


def rate_of_times(time_s: NDArray[Any]) -> float | None:
    """Rate of evenly spaced times, within 1 % of a step.

    Args:
        time_s: shape `(N,)`.
    Returns:
        Rows per second; None if the steps are uneven, not positive or not finite.
    Example:
        >>> rate_of_times(np.array([0.0, 0.01, 0.02]))
        100.0
    """
    steps = np.diff(np.asarray(time_s, dtype=np.float64))
    if steps.size == 0 or not np.isfinite(steps).all():
        return None
    mean = float(steps.mean())
    even = mean > 0.0 and bool((np.abs(steps - mean) <= _EVEN * mean).all())
    return 1.0 / mean if even else None


def rates_agree(one_hz: float, other_hz: float, rows: int) -> bool:
    """Whether two rates of a record differ by at most 0.1 %, or 1.5 rows in total.

    Args:
        one_hz: a rate.
        other_hz: another.
        rows: of the record; times with few digits state its rate only to 1.5 rows.
    Returns:
        True if both can be meant.
    Example:
        >>> rates_agree(1000.5, 1000.0, 4096), rates_agree(1010.0, 1000.0, 4096)
        (True, False)
    """
    return abs(one_hz / other_hz - 1.0) <= max(1.5 / rows, 1e-3)


def check_rate(
    given_hz: float, found_hz: float, rows: int, where: str, file: Path, *, assumed: str = ""
) -> None:
    """Refuse a rate that differs from the file's by more than 0.1 % and 1.5 rows in total.

    Args:
        given_hz: by the user.
        found_hz: in the file.
        rows: of the record.
        where: in the file it was found, for the error.
        file: path of it.
        assumed: column of times whose unit nobody states and that was taken as seconds; "": none.
    Raises:
        InputError: they contradict each other.
    Example:
        >>> check_rate(1000.0, 1000.5, 4096, "column time_s", Path("a.csv"))
    """
    if rates_agree(found_hz, given_hz, rows):
        return
    for unit, factor in _UNITS_OF_TIME.items() if assumed else ():
        if rates_agree(found_hz * factor, given_hz, rows):
            raise InputError(
                f"--rate-hz is {given_hz:g}, but column {assumed}, which states no unit, has "
                f"{found_hz:.6g} rows per second if its times are in s. They agree if it is in "
                f"{unit}: add --unit {assumed}={unit}: {file}"
            )
    raise InputError(
        f"--rate-hz is {given_hz:g}, but {where} has {found_hz:.6g} rows per second. Leave out "
        f"--rate-hz, or change the file: {file}"
    )


def pairs_of(one: NDArray[Any], other: NDArray[Any]) -> NDArray[Any] | None:
    """The array of shape `(N, 2)` whose columns these are, not copied; None if they are none.

    Args:
        one: shape `(N,)`.
        other: shape `(N,)`.
    Example:
        >>> pairs = np.arange(6).reshape(3, 2)
        >>> bool((pairs_of(pairs[:, 0], pairs[:, 1]) == pairs).all())
        True
        >>> pairs_of(pairs[:, 1], pairs[:, 0]) is None
        True
    """
    step = one.itemsize
    beside = other.ctypes.data - one.ctypes.data == step and one.dtype == other.dtype
    if not (beside and one.strides == other.strides == (2 * step,) and one.size == other.size):
        return None
    return np.lib.stride_tricks.as_strided(one, (one.size, 2), (2 * step, step))


class ColumnStream(Closing):
    """Columns of one file, read in parts.

    Args:
        archive: what the file holds; closed with the stream.
        names: wanted columns.
        use_times: look for a rate in the column of times where nothing else states one. Its steps
            are then checked on the way.
        options: what the user states about the columns.

    Values come in SI units: `units` has the unit that each column states, or None. `rows` and
    `rate_hz` are None where the file does not state them; `rows_read` counts on the way. `start_s`
    is the time of the first row, 0 where there are no times.
    Raises:
        InputError: a column is missing, empty, not of numbers; unequal lengths.
    """

    def __init__(
        self,
        archive: Archive,
        names: Sequence[str],
        *,
        use_times: bool = True,
        options: ColumnOptions = AS_THE_FILE_STATES,
    ) -> None:
        self._archive, self._options = archive, options
        self._names = archive.locate_all(names)
        self._negative = [archive.is_negative(name) for name in names]
        if len(names) > 1 and len(set(self._names)) < len(names):
            raise InputError(
                f"Column {self._names[0]} is named for two quantities. Name another column for one "
                f"of them: {archive.file}"
            )
        for name in options.units:
            if archive.locate(name) is None:
                raise InputError(
                    f"--unit {name}={options.units[name]} names no column of the file, which has "
                    f"{', '.join(archive.names)}: {archive.file}"
                )
        self.units = [stated_unit(archive, name, options) for name in self._names]
        for name, unit, negative in zip(names, self.units, self._negative, strict=True):
            if negative and unit is not None and unit.si in _NEVER_NEGATIVE:
                raise InputError(
                    f"Column {name} asks for the other sign, but {_NEVER_NEGATIVE[unit.si]} cannot "
                    f"be negative. Name it without the minus: {archive.file}"
                )
        self._times: str | None = None
        self.assumed_seconds = ""  # column of times whose unit nobody states
        self._time_factor = 1.0
        self.start_s = 0.0
        self.rows_read = 0
        try:
            with no_exit():
                self.rate_hz = archive.rate_hz(self._names)
                if self.rate_hz is None and use_times:
                    self._use_times()
                elif self.rate_hz is not None:
                    self._check_stated_rate(self.rate_hz)
                self.rows = archive.rows(self._all_names)
        except InputError:
            raise
        except Exception as error:
            raise _unreadable(archive.file, error) from error
        if self.rows == 0:
            raise self._empty()

    @property
    def _all_names(self) -> list[str]:
        return self._names if self._times is None else [*self._names, self._times]

    def _use_times(self) -> None:
        full = time_column(self._archive, self._options, self._names)
        if full is None or full in self._names:
            return
        unit = stated_unit(self._archive, full, self._options)
        try:
            self._archive.rows([*self._names, full])
            (head,) = self._archive.start([full])(_HEAD_ROWS)
        except InputError:
            if certain_times(self._archive, full, self._options):
                raise
            return  # a column that is only called like one of times
        self._time_factor = 1.0 if unit is None else unit.factor
        falls = np.flatnonzero(~(np.diff(head) > 0.0))
        if falls.size and certain_times(self._archive, full, self._options):
            raise InputError(
                f"Column {full} does not increase after row {falls[0] + 1}. Sort the rows, or "
                f"remove repeated ones: {self._archive.file}"
            )
        self.rate_hz = rate_of_times(head * self._time_factor)
        self._times = full if self.rate_hz is not None else None
        self.start_s = float(head[0]) * self._time_factor if self._times else 0.0
        if self.rate_hz and assumed_seconds(self._archive, full, self._options):
            check_assumed_seconds(full, self.rate_hz, self._archive.file, monitors=True)
            self.assumed_seconds = full

    def _check_stated_rate(self, stated_hz: float) -> None:
        """Compare a rate that the file states with its times."""
        full = time_column(self._archive, self._options, self._names)
        if full is None or full in self._names:
            return
        try:
            self._archive.rows([*self._names, full])  # refuses times of a table of another length
            (head,) = self._archive.start([full])(_HEAD_ROWS)
        except InputError:
            return  # a column that is only called like one of times
        unit = stated_unit(self._archive, full, self._options)
        time_s = head * (1.0 if unit is None else unit.factor)
        found_hz = rate_of_times(time_s)
        if found_hz and not rates_agree(found_hz, stated_hz, head.size):
            raise InputError(
                f"The file states a rate of {stated_hz:g} Hz, but column {full} has {found_hz:.6g} "
                f"rows per second. Remove the wrong one: {self._archive.file}"
            )
        self.start_s = float(time_s[0]) if found_hz else 0.0

    def _empty(self) -> InputError:
        return InputError(f"Column {self._names[0]} is empty. Record again: {self._archive.file}")

    def share_read(self) -> float:
        """How much of the columns has been read, 0 to 1."""
        if self.rows is not None:
            return self.rows_read / self.rows
        return self._archive.share_read() or 0.0

    def chunks(self, rows: int) -> Iterator[tuple[NDArray[Any], ...]]:
        """The columns from their first row on.

        Args:
            rows: of each chunk but the last.
        Returns:
            One array a column, in the order asked for, shape `(rows,)`: int16, float32 or float64
            in native byte order, whichever the file holds, float64 for other numbers. Contiguous,
            or two columns of one array (see `pairs_of`); perhaps read-only. Values that are not
            finite are passed on.
        Raises:
            InputError: damaged, a cell that is no number, no rows, or uneven times.
        """
        try:
            with no_exit():
                yield from self._pieces(rows)
        except InputError:
            raise
        except Exception as error:
            raise _unreadable(self._archive.file, error) from error

    def _pieces(self, rows: int) -> Iterator[tuple[NDArray[Any], ...]]:
        take = self._archive.start(self._all_names)
        last_s: float | None = None
        self.rows_read = 0
        while True:
            arrays = take(rows)
            count = len(arrays[0])
            if count == 0:
                break
            if self._times is not None:
                arrays, time_s = arrays[:-1], arrays[-1] * self._time_factor
                self._check_times(time_s, last_s)
                last_s = float(time_s[-1])
            self.rows_read += count
            yield tuple(map(_in_si, arrays, self.units, self._negative))
            if count < rows:
                break
        if self.rows_read == 0:
            raise self._empty()

    def _check_times(self, time_s: NDArray[Any], last_s: float | None) -> None:
        assert self.rate_hz is not None
        steps = np.diff(time_s) if last_s is None else np.diff(time_s, prepend=last_s)
        uneven = ~(np.abs(steps * self.rate_hz - 1.0) <= 2.0 * _EVEN)
        if uneven.any():
            first = int(np.argmax(uneven))
            row = self.rows_read + first + (1 if last_s is not None else 2)
            raise InputError(
                f"Column {self._times} has a step of {steps[first]:g} s before row {row}, but "
                f"{1.0 / self.rate_hz:g} s elsewhere. Split the record there, or state the rate "
                f"with --rate-hz: {self._archive.file}"
            )

    def close(self) -> None:
        """Close the file."""
        self._archive.close()


def check_times(
    path: Path, given_hz: float, options: ColumnOptions, names: Sequence[str] = ()
) -> float:
    """Refuse a rate that contradicts the column of times of a file, if it has one.

    Args:
        path: of the file.
        given_hz: by the user.
        options: what the user states about its columns.
        names: columns that have this rate; times of another table are not theirs.
    Returns:
        The time of the first row, in s; 0 if there are no times.
    Raises:
        InputError: they contradict each other.
    """
    head = head_of_times(path, options, _HEAD_ROWS, names)
    if head is None:
        return 0.0
    name, time_s = head
    steps = np.diff(time_s)
    # Times with few digits repeat, so they state the rate less exactly.
    if steps.size and (steps > 0.0).all() and np.isfinite(steps).all():
        found = [1.0 / float(step) for step in (steps.mean(), np.median(steps))]
        nearest = min(found, key=lambda rate: abs(rate / given_hz - 1.0))
        with open_archive(path) as archive:
            full = time_column(archive, options, beside=archive.locate_all(names)) or name
            assumed = name if assumed_seconds(archive, full, options) else ""
        check_rate(given_hz, nearest, steps.size, f"column {name}", path, assumed=assumed)
        return float(time_s[0])
    return 0.0


def head_of_times(
    path: Path | str, options: ColumnOptions, rows: int, names: Sequence[str] = ()
) -> tuple[str, NDArray[np.float64]] | None:
    """Read the name and the first values, in s, of the column of times; None if there is none.

    Args:
        path: of the file.
        options: what the user states about its columns.
        rows: how many values to read.
        names: columns to which the times belong; there are none if they have another length.
    Returns:
        The name, and the values of shape `(rows,)` or fewer.
    Raises:
        InputError: the column that the options name is missing or does not contain numbers.
    """
    with open_archive(path) as archive:
        beside = archive.locate_all(names)
        name = time_column(archive, options, beside=beside)
        if name is None:
            return None
        unit = stated_unit(archive, name, options)
        try:
            archive.rows([*beside, name])
            (values,) = archive.start([name])(rows)
        except InputError:
            if options.time is not None or name == "time_s":
                raise
            return None
    return name, values.astype(np.float64) * (1.0 if unit is None else unit.factor)


def _in_si(values: NDArray[Any], unit: Unit | None, negative: bool) -> NDArray[Any]:
    """Values of a column in the SI unit, not copied where they are."""
    factor = (1.0 if unit is None else unit.factor) * (-1.0 if negative else 1.0)
    if factor == 1.0:
        return values
    return np.asarray(values * np.float64(factor), dtype=np.float64)


def open_columns(
    path: Path | str,
    names: Sequence[str],
    *,
    use_times: bool = True,
    options: ColumnOptions = AS_THE_FILE_STATES,
) -> ColumnStream:
    """Open named columns of a file for reading in parts.

    Memory is needed for a chunk alone, whatever the file's length; of a compressed HDF5 file also
    for one chunk of each column.

    Args:
        path: text tables (`.csv`, `.txt`, `.lvm` and others), `.mat` (v5 and v7.3), `.npz`,
            `.npy`, `.h5`, `.hdf5` or `.tdms`.
        names: wanted columns, with or without the unit in their names, with a minus before the name
            for the other sign; in text tables also their numbers from 1 on; for HDF5, LabVIEW and
            structures also `group/name`. An array of shape `(n, 2)` or `(2, n)` in a `.npy` has no
            names: its columns are the two wanted.
        use_times: take the rate from the column of times where nothing else states it.
        options: the column of times, and units, where the file does not state them.
    Returns:
        The stream; use it as a context.
    Raises:
        InputError: no such file, unknown kind, damaged, a column that is missing or not of
            numbers, or unequal lengths.
    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(Path(folder) / "a.npz", u=np.arange(5.0), y=np.ones(5), rate_hz=400.0)
        ...     with open_columns(Path(folder) / "a.npz", ["y", "u"]) as stream:
        ...         print(stream.rows, stream.rate_hz, [u.tolist() for _, u in stream.chunks(3)])
        5 400.0 [[0.0, 1.0, 2.0], [3.0, 4.0]]
    """
    archive = open_archive(path)
    try:
        return ColumnStream(archive, names, use_times=use_times, options=options)
    except BaseException:
        archive.close()
        raise
