"""Named columns of numbers from CSV, MATLAB, NumPy, HDF5 and LabVIEW files."""

from __future__ import annotations

import csv
import importlib
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from haselab.base import InputError

__all__ = ["Table", "read_table"]

Floats = NDArray[np.float64]
_RATE_NAMES = ("rate_hz", "sample_rate_hz", "fs_hz", "fs")
_RATE_LINE = re.compile(r"#\s*(?:rate_hz|sample_rate_hz|fs)\s*[=:]\s*([-+.\deE]+)\s*$")


@dataclass(frozen=True)
class Table:
    """Columns of equal length.

    Args:
        columns: values by name. Shape `(N,)` each.
        rate_hz: rows a second if the file tells, else None.
    """

    columns: Mapping[str, Floats]
    rate_hz: float | None

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)


def read_table(path: Path | str, columns: Sequence[str]) -> Table:
    """Read named columns of a file.

    The rate comes from a scalar `rate_hz` (or an attribute, or a line `# rate_hz = 400`), from the
    increment of LabVIEW channels, or from an evenly spaced column `time_s`.

    Args:
        path: `.csv`, `.txt`, `.mat` (v5 and v7.3), `.npz`, `.h5`, `.hdf5` or `.tdms`.
        columns: wanted names; for HDF5, LabVIEW and structures also `group/name`.
    Returns:
        The wanted columns in SI units as they are in the file, and the rate.
    Raises:
        InputError: no such file, unknown kind, a column that is missing, empty or not of finite
            numbers, or unequal lengths.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"There is no such file. Check the path: {file}")
    kind = file.suffix.lower()
    if kind not in _READERS:
        raise InputError(
            f"Files of the kind '{kind}' are not read; allowed are {' '.join(_READERS)}. "
            f"Convert it: {file}"
        )
    wanted = list(dict.fromkeys(columns))
    try:
        found, rate_hz = _READERS[kind](file, wanted)
    except InputError:
        raise
    except Exception as error:  # damaged files raise anything in their readers
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"The file cannot be read ({reason}). Export it again: {file}") from error
    values = {name: _checked(name, found[name], file) for name in wanted}
    sizes = {name: value.size for name, value in values.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in sizes.items())
        raise InputError(
            f"The columns have unequal lengths ({listed}); allowed are equal ones. "
            f"Export them from the same recording: {file}"
        )
    return Table(values, rate_hz if rate_hz is not None else _rate_of_time(found.get("time_s")))


def _checked(name: str, values: Any, file: Path) -> Floats:
    try:
        array = np.asarray(values)
        if np.iscomplexobj(array):
            raise TypeError("complex")
        vector = np.asarray(array, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"Column {name} does not hold real numbers; allowed are numbers in SI units. "
            f"Correct the column: {file}"
        ) from error
    if vector.ndim > 1 and max(vector.shape) != vector.size:
        raise InputError(
            f"Column {name} has shape {vector.shape}; allowed is one value a row. "
            f"Split it into columns: {file}"
        )
    vector = np.ascontiguousarray(vector.reshape(-1))
    if vector.size == 0:
        raise InputError(
            f"Column {name} is empty; allowed is one row or more. Record again: {file}"
        )
    bad = np.flatnonzero(~np.isfinite(vector))
    if bad.size:
        raise InputError(
            f"Column {name} holds {vector[bad[0]]} in row {bad[0] + 1} ({bad.size} such rows); "
            f"allowed are finite numbers. Remove these rows: {file}"
        )
    return vector


def _missing(wanted: Sequence[str], present: Sequence[str], file: Path) -> InputError:
    listed = ", ".join(present) if present else "none"
    return InputError(
        f"The file lacks {', '.join(wanted)}; present are {listed}. "
        f"Name a column that is there: {file}"
    )


def _rate_of_time(time_s: Any) -> float | None:
    """Rate of evenly spaced times, within 1 % of a step."""
    try:
        steps = np.diff(np.asarray(time_s, dtype=np.float64).reshape(-1))
    except (TypeError, ValueError):
        return None
    if steps.size == 0 or not np.isfinite(steps).all():
        return None
    mean = float(steps.mean())
    even = mean > 0.0 and bool((np.abs(steps - mean) <= 0.01 * mean).all())
    return 1.0 / mean if even else None


def _scalar_rate(named: Mapping[str, Any]) -> float | None:
    for name in _RATE_NAMES:
        if name in named and np.size(named[name]) == 1:
            return _positive(named[name])
    return None


def _positive(value: Any) -> float | None:
    try:
        rate_hz = float(np.asarray(value, dtype=np.float64).reshape(-1)[0])
    except (TypeError, ValueError):
        return None
    return rate_hz if 0.0 < rate_hz < float("inf") else None


def _read_csv(file: Path, wanted: Sequence[str]) -> tuple[dict[str, Any], float | None]:
    rate_hz, skipped, header = None, 0, ""
    with file.open(encoding="utf-8-sig", newline="") as stream:
        for line in stream:
            skipped += 1
            match = _RATE_LINE.match(line.strip())
            rate_hz = _positive(match.group(1)) if match else rate_hz
            if line.strip() and not line.lstrip().startswith("#"):
                header = line
                break
    if not header:
        raise InputError(f"The file is empty; allowed is a header and rows. Record again: {file}")
    delimiter = max(",;\t", key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter))]
    lacking = [name for name in wanted if name not in names]
    if lacking and all(_is_number(name) for name in names):
        raise InputError(
            f"The file has no header row; allowed is one with the names of the columns. "
            f"Add it: {file}"
        )
    if lacking:
        raise _missing(lacking, names, file)
    read = [*wanted, *(["time_s"] if "time_s" in names and "time_s" not in wanted else [])]
    places = [names.index(name) for name in read]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty table is told by `_checked`
            values = np.loadtxt(
                file, delimiter=delimiter, skiprows=skipped, usecols=places, ndmin=2,
                encoding="utf-8-sig", comments="#",
            )  # fmt: skip
    except ValueError as error:
        raise _bad_cell(file, delimiter, skipped, read, places) from error
    return {name: values[:, i] for i, name in enumerate(read)}, rate_hz


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _bad_cell(
    file: Path, delimiter: str, skipped: int, read: Sequence[str], places: Sequence[int]
) -> InputError:
    """The first cell that is no number."""
    with file.open(encoding="utf-8-sig", newline="") as stream:
        for number, line in enumerate(stream, start=1):
            if number <= skipped or not line.strip() or line.startswith("#"):
                continue
            cells = next(csv.reader([line], delimiter=delimiter))
            for name, place in zip(read, places, strict=True):
                cell = cells[place].strip() if place < len(cells) else "nothing"
                if not _is_number(cell):
                    return InputError(
                        f"Column {name} holds '{cell}' in line {number}; allowed are numbers. "
                        f"Correct or remove the line: {file}"
                    )
    return InputError(f"The rows cannot be read as numbers. Export the table again: {file}")


def _read_npz(file: Path, wanted: Sequence[str]) -> tuple[dict[str, Any], float | None]:
    with np.load(file, allow_pickle=False) as archive:
        return _picked({name: archive[name] for name in archive.files}, wanted, file)


def _read_mat(file: Path, wanted: Sequence[str]) -> tuple[dict[str, Any], float | None]:
    if h5py.is_hdf5(file):
        return _read_h5(file, wanted)
    named: dict[str, Any] = {}
    for name, value in loadmat(file, squeeze_me=True, struct_as_record=True).items():
        if name.startswith("__"):
            continue
        fields = getattr(getattr(value, "dtype", None), "names", None)
        if fields and np.size(value) == 1:
            named.update({f"{name}/{field}": np.asarray(value[field][()]) for field in fields})
        else:
            named[name] = value
    return _picked(named, wanted, file)


def _read_h5(file: Path, wanted: Sequence[str]) -> tuple[dict[str, Any], float | None]:
    with h5py.File(file, "r") as archive:
        sets: dict[str, h5py.Dataset] = {}

        def collect(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                sets[name] = item

        archive.visititems(collect)
        named = _Lazy(sets)
        found, rate_hz = _picked(named, wanted, file)
        for holder in (archive, *(sets[name] for name in sets if name.split("/")[-1] in wanted)):
            rate_hz = rate_hz if rate_hz is not None else _scalar_rate(holder.attrs)
    return found, rate_hz


class _Lazy(Mapping[str, Any]):
    """Datasets that are read when they are asked for."""

    def __init__(self, sets: Mapping[str, h5py.Dataset]) -> None:
        self._sets = sets

    def __getitem__(self, name: str) -> Any:
        return self._sets[name][()]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sets)

    def __len__(self) -> int:
        return len(self._sets)


def _read_tdms(file: Path, wanted: Sequence[str]) -> tuple[dict[str, Any], float | None]:
    try:
        tdms: Any = importlib.import_module("nptdms")
    except ImportError as error:
        raise InputError(
            f"LabVIEW files need nptdms. Install haselab[formats], or export as CSV: {file}"
        ) from error
    channels = {
        f"{group.name}/{channel.name}": channel
        for group in tdms.TdmsFile.read(file).groups()
        for channel in group.channels()
    }
    named = {name: channel[:] for name, channel in channels.items()}
    found, rate_hz = _picked(named, wanted, file)
    for name, channel in channels.items():
        step_s = channel.properties.get("wf_increment", 0.0)
        if rate_hz is None and {name, name.split("/")[-1]} & set(wanted) and step_s > 0.0:
            rate_hz = 1.0 / float(step_s)
    return found, rate_hz


def _picked(
    named: Mapping[str, Any], wanted: Sequence[str], file: Path
) -> tuple[dict[str, Any], float | None]:
    """Wanted columns by full name, or by last name where that is the only one."""
    last: dict[str, list[str]] = {}
    for name in named:
        last.setdefault(name.split("/")[-1], []).append(name)
    found, lacking = {}, []
    for name in [*wanted, "time_s", *_RATE_NAMES]:
        full = [name] if name in named else last.get(name, [])
        if len(full) == 1:
            found[name] = named[full[0]]
        elif name in wanted and not full:
            lacking.append(name)
        elif name in wanted:
            raise InputError(
                f"Column {name} is there {len(full)} times ({', '.join(full)}). "
                f"Give the full name: {file}"
            )
    if lacking:
        raise _missing(lacking, list(named), file)
    return found, _scalar_rate({k: v for k, v in found.items() if k not in wanted})


_READERS: Mapping[
    str, Callable[[Path, Sequence[str]], tuple[dict[str, Any], float | None]]
] = {
    ".csv": _read_csv,
    ".txt": _read_csv,
    ".mat": _read_mat,
    ".npz": _read_npz,
    ".h5": _read_h5,
    ".hdf5": _read_h5,
    ".tdms": _read_tdms,
}  # fmt: skip
