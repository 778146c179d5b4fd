"""Data in: files, pandas, xarray and dictionaries become tables and records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError
from haselab.identify.record import Record
from haselab.pipelines.examples.data_sets import find_data_set, write_data_set
from haselab.pipelines.sensing.series import derived_series
from haselab.pipelines.time_axis import records_of, time_axis
from haselab.store.columns.reader import rate_of_times, rates_agree
from haselab.store.columns.table import Table, read_every_column
from haselab.store.export.frames import session_dataset, session_tables
from haselab.store.session.reader import SessionReader, session_file

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["Data", "Session", "checked_rate", "example", "load", "records", "table"]

Floats = NDArray[np.float64]
Data: TypeAlias = "Table | Mapping[str, ArrayLike] | pandas.DataFrame | xarray.Dataset | str | Path"
_TIMES = ("time_s", "time", "t")
_SESSION = "session.h5"


@dataclass(frozen=True)
class Session:
    """A recorded session.

    Args:
        path: of session.h5.
        experiments: names of what was recorded.
    """

    path: Path
    experiments: tuple[str, ...]

    def to_pandas(self, experiment: str) -> dict[str, pandas.DataFrame]:
        """One experiment as pandas tables.

        Args:
            experiment: its name.
        Returns:
            `monitors`, `blocks`, `tracks`, `events`, and `capacitance` and `strain` where the
            session states what they need.
        Raises:
            InputError: no such experiment, or pandas is not installed.
        """
        return session_tables(self.path, experiment, derived=derived_series)

    def to_xarray(self, experiment: str) -> xarray.Dataset:
        """One experiment as an xarray data set, with units.

        Args:
            experiment: its name.
        Returns:
            The monitors over block and sample, the tracks over frame and point, and what follows.
        Raises:
            InputError: no such experiment, or xarray is not installed.
        """
        return session_dataset(self.path, experiment, derived=derived_series)


def load(path: str | Path) -> Table | Session:
    """Read a file of columns, or open a recorded session.

    Args:
        path: CSV, .mat, .npz, .h5 or .tdms; or session.h5, or the folder that holds one.
    Returns:
        A table of all columns of numbers in SI units, without the rows whose column `valid` is 0;
        a session for a recording.
    Raises:
        InputError: no such file, or nothing in it that can be read.
    """
    path = Path(path)
    if path.name == _SESSION or (path.is_dir() and (path / _SESSION).exists()):
        path = session_file(path)
        with SessionReader(path) as reader:
            return Session(path, tuple(reader.names))
    return read_every_column(path)


def table(data: Data, *, rate_hz: float | None = None) -> Table:
    """Columns of any source as a table.

    Args:
        data: a file, a table, a pandas DataFrame, an xarray Dataset with one dimension, or a
            dictionary of columns. Columns that are no numbers are left out.
        rate_hz: rows a second, in Hz. None: from the attribute `rate_hz`, or from the times in an
            index or a column `time_s`, `time` or `t`.
    Returns:
        The table.
    Raises:
        InputError: columns of unequal lengths, or a session, which holds several tables.
    """
    if isinstance(data, (str, Path)):
        found = load(data)
        if isinstance(found, Session):
            raise InputError(
                "A session holds one table for each experiment. Use "
                f"hl.load(path).to_pandas(experiment). {found.path}"
            )
        return found
    if isinstance(data, Table):
        return data
    columns = _columns(data)
    lengths = {values.size for values in columns.values()}
    if len(lengths) != 1:
        raise InputError(
            f"The data have columns of the lengths {sorted(lengths)}. Give columns of one length."
        )
    stated = getattr(data, "attrs", {}).get("rate_hz")
    time_name = next((name for name in _TIMES if name in columns), None)
    time_s = None if time_name is None else columns[time_name]
    if stated is None and time_s is not None:
        stated = rate_of_times(time_s)
    rate = checked_rate(None if stated is None else float(stated), rate_hz, lengths.pop())
    return Table(columns, rate, time_name=time_name, time_s=time_s)


def checked_rate(stated_hz: float | None, given_hz: float | None, rows: int) -> float | None:
    """The rate that the caller gives, else that of the data.

    Args:
        stated_hz: by the data or their times; None: not at all.
        given_hz: by the caller; None: not given.
        rows: of the data.
    Returns:
        The rate in Hz; None where nobody states one.
    Raises:
        InputError: the two contradict each other.
    """
    if given_hz is None or stated_hz is None:
        return stated_hz if given_hz is None else float(given_hz)
    if not rates_agree(stated_hz, given_hz, rows):
        raise InputError(
            f"rate_hz is {given_hz:g}, but the data have {stated_hz:.6g} rows per second. Leave "
            "out rate_hz, or change the data."
        )
    return float(given_hz)


def _median_hz(time_s: Floats) -> float | None:
    step_s = float(np.median(np.diff(time_s))) if time_s.size > 1 else 0.0
    return 1.0 / step_s if step_s > 0.0 else None


def _columns(data: Any) -> dict[str, Floats]:
    """Columns of numbers by name; an index or a coordinate of times is one too."""
    found = {str(name): np.asarray(data[name]) for name in data.keys()}  # noqa: SIM118
    found |= {str(name): np.asarray(each) for name, each in getattr(data, "coords", {}).items()}
    index = getattr(data, "index", None)
    if index is not None and (index.name in _TIMES or np.asarray(index).dtype.kind in "mM"):
        found["time_s"] = np.asarray(index)
    columns = {}
    for name, values in found.items():
        if values.dtype.kind in "mM":
            values = (values - values[0]) / np.timedelta64(1, "s")
        if values.dtype.kind in "fiub" and values.ndim == 1:
            columns[name] = np.asarray(values, dtype=np.float64)
    return columns


def records(
    data: Data | Record | Sequence[Record],
    input: str = "u",
    output: str = "y",
    *,
    rate_hz: float | None = None,
    hold: str = "zero",
) -> list[Record]:
    """Input and output of any source as the fits of `haselab.identify` take them.

    Args:
        data: as of `table`.
        input: column of the input.
        output: column of the output.
        rate_hz: rows a second, in Hz. None: from the times.
        hold: the input between its rows: "zero" (held), "first" (straight lines) or
            "band-limited".
    Returns:
        One record; several where the times have gaps.
    Raises:
        InputError: a column that is missing, no rate, NaN, a column without change.
    Example:
        >>> u = np.repeat([0.0, 1.0, 0.5], 20)
        >>> (record,) = records({"u": u, "y": np.cumsum(u), "time_s": np.arange(60) / 50.0})
        >>> record.input_rate_hz
        50.0
    """
    if isinstance(data, Record):
        return [data]
    if isinstance(data, Sequence) and not isinstance(data, str):
        return list(data)
    found = table(data)
    for name in (input, output):
        if name not in found.columns:
            raise InputError(
                f"There is no column {name!r}; the data have {', '.join(found)}. Name input and "
                "output."
            )
    if rate_hz is not None and found.rate_hz is None and found.time_s is not None:
        checked_rate(_median_hz(found.time_s), rate_hz, found[input].size)
    rate = checked_rate(found.rate_hz, rate_hz, found[input].size)
    if rate is not None:
        return [Record.sampled(found[input], found[output], rate, hold=hold)]
    if found.time_s is None or found.time_name is None:
        raise InputError("The data state no sampling rate. Give rate_hz, or a column time_s.")
    axis = time_axis(found.time_s, Path("data"), found.time_name)
    kept, _ = records_of(found, (input, output), axis, hold)
    if not kept:
        raise InputError("Every part between gaps is too short or constant. Record without gaps.")
    return kept


def example(name: str, folder: str | Path) -> list[Path]:
    """Write one of the small data sets that come with haselab.

    Args:
        name: as `haselab example` lists them, such as "chirp".
        folder: where the files go.
    Returns:
        The files; README.md among them has the commands that use them.
    Raises:
        InputError: no such data set, or the folder holds such files already.
    """
    return write_data_set(find_data_set(name), Path(folder))
