"""Data in: files, pandas, xarray and dictionaries become tables and records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, check_length, checked, real_array, shown
from haselab.identify.record import Record
from haselab.pipelines.examples.data_sets import find_data_set, write_data_set
from haselab.pipelines.sensing.series import derived_series
from haselab.pipelines.time_axis import records_of, time_axis
from haselab.store.columns.reader import rate_of_times, rates_agree
from haselab.store.columns.selection import TIME_NAMES, ColumnOptions
from haselab.store.columns.table import Table, read_every_column, read_table
from haselab.store.columns.units import Unit, parse_unit, split_header
from haselab.store.export.frames import session_dataset, session_tables
from haselab.store.export.session import Derived
from haselab.store.session.reader import SessionReader, session_file

if TYPE_CHECKING:
    import pandas
    import xarray

    Data: TypeAlias = (
        Table | Mapping[str, ArrayLike] | pandas.DataFrame | xarray.Dataset | str | Path
    )
else:
    Data = Any  # pandas and xarray need not be there; `_columns` refuses what has no columns

__all__ = ["Data", "Session", "example", "is_uneven", "load", "numeric_table", "records", "table"]

Floats = NDArray[np.float64]
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

    def to_pandas(
        self, experiment: str = "", *, zero_length_m: float | None = None
    ) -> dict[str, pandas.DataFrame]:
        """One experiment as pandas tables.

        Args:
            experiment: its name; the session's only one need not be named.
            zero_length_m: length at zero strain, in m, for the column `strain`. None: that of an
                imported session, else that of the actuator file beside the session.
        Returns:
            `monitors`, `blocks`, `tracks`, `events`, and `capacitance` and `strain` where the
            session states what they need. The table `strain` has a column `strain` if the length
            at zero strain is known; `strain_from_start` is relative to the first frame.
        Raises:
            InputError: no such experiment, no positive length, or pandas is not installed.
        """
        return session_tables(
            self.path, self._one(experiment), derived=_with_zero_length(zero_length_m)
        )

    def to_xarray(
        self, experiment: str = "", *, zero_length_m: float | None = None
    ) -> xarray.Dataset:
        """One experiment as an xarray data set, with units.

        Args:
            experiment: its name; the session's only one need not be named.
            zero_length_m: length at zero strain, in m, for the column `strain`. None: that of an
                imported session, else that of the actuator file beside the session.
        Returns:
            The monitors over block and sample, the tracks over frame and point, and what follows.
        Raises:
            InputError: no such experiment, no positive length, or xarray is not installed.
        """
        return session_dataset(
            self.path, self._one(experiment), derived=_with_zero_length(zero_length_m)
        )

    def _one(self, experiment: str) -> str:
        """The named experiment, or the only one."""
        if experiment or len(self.experiments) == 1:
            return experiment or self.experiments[0]
        raise InputError(
            f"The session has {len(self.experiments)} experiments. Name one of them: "
            f"{', '.join(self.experiments)}."
        )


def _with_zero_length(zero_length_m: float | None) -> Derived:
    """What is computed from an experiment, with a length that was checked."""
    check_length("zero_length_m", zero_length_m)
    return partial(derived_series, zero_length_m=zero_length_m)


@checked
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
    if (session := _session_in(path)) is not None:
        with SessionReader(session) as reader:
            return Session(session, tuple(reader.names))
    return read_every_column(path)


@checked
def table(data: Data, *, rate_hz: float | None = None) -> Table:
    """Columns of any source as a table.

    Args:
        data: a file, a table, a pandas DataFrame, an xarray Dataset with one dimension, or a
            dictionary of columns. Columns that are no numbers are left out.
        rate_hz: rows a second, in Hz, which the times must not contradict. None: from the file or
            the attribute `rate_hz`, or from the times in an index or a column `time_s`, `time` or
            `t`, in s or in the unit in its name, such as `time_ms` or `t [ms]`.
    Returns:
        The table.
    Raises:
        InputError: no column of numbers, columns of unequal lengths, a rate that the data
            contradict, or a session, which holds several tables.
    """
    if not isinstance(data, (str, Path)):
        return _at_rate(data if isinstance(data, Table) else _table(data), rate_hz)
    found = load(data)
    if isinstance(found, Session):
        raise _is_session(found.path)
    return _at_rate(found, rate_hz)


def numeric_table(
    data: Data, names: Sequence[str], rate_hz: float | None, time: str | None = None
) -> Table:
    """Columns of any source as a table in which some are numbers.

    Args:
        data: as of `table`.
        names: columns that must be there.
        rate_hz: rows a second, in Hz. None: as the data state it.
        time: column of the times, in s or in the unit that it states. None: found by its name.
    Returns:
        The table; of a file, these columns alone.
    Raises:
        InputError: a column that is missing or holds something else, or as of `table`.
    """
    if len(set(names)) < len(names):
        raise InputError(
            f"Column {names[0]!r} is named for two quantities. Name another column for one of them."
        )
    if isinstance(data, (str, Path)):
        if (file := _session_in(Path(data))) is not None:
            raise _is_session(file)
        return _at_rate(read_table(data, names, ColumnOptions(time)), rate_hz)
    found = table(data)
    # A column such as "t [ms]" has become "time_s" already.
    if time is not None and (time in found or isinstance(data, Table) or time not in data):
        _require_columns(found, [time], data)
        time_s = found[time] * (1.0 if isinstance(data, Table) else _factor_to_s(time, data[time]))
        found = replace(found, rate_hz=rate_of_times(time_s), time_name=time, time_s=time_s)
    _require_columns(found, names, data)
    return _at_rate(found, rate_hz)


def _require_columns(found: Table, names: Sequence[str], data: Any) -> None:
    for name in names:
        if name not in found:
            reasons = {} if isinstance(data, Table) else _columns(data)[1]
            listed = f"There is no column {name!r}; the data have {', '.join(found)}."
            raise InputError(f"{reasons.get(name, listed)} Name another column.")


def is_uneven(found: Table) -> bool:
    """Whether a table has times that one rate does not describe.

    Args:
        found: the table.
    Returns:
        False also for a table without times.
    """
    return found.time_s is not None and rate_of_times(found.time_s) is None


def _at_rate(found: Table, given_hz: float | None) -> Table:
    """The table with the rate that the caller states; its own rate must not contradict it."""
    if given_hz is None:
        return found
    if not 0.0 < given_hz < math.inf:
        raise InputError(f"rate_hz is {given_hz:g}; it must be above 0 Hz and finite.")
    known_hz = [found.rate_hz] if found.rate_hz is not None else _rates_hz(found.time_s)
    rows = max((values.size for values in found.columns.values()), default=0) or 1
    if known_hz and not any(rates_agree(each, given_hz, rows) for each in known_hz):
        raise InputError(
            f"rate_hz is {given_hz:g}, but the data have {known_hz[-1]:.6g} rows per second. Leave "
            "out rate_hz, or change the data."
        )
    return replace(found, rate_hz=float(given_hz))


def _rates_hz(time_s: Floats | None) -> list[float]:
    """Rates that uneven times can mean: by the mean step and by the usual one."""
    steps_s = np.diff(time_s) if time_s is not None else np.zeros(0)
    if not steps_s.size or not (steps_s > 0.0).all():
        return []
    return [1.0 / float(step_s) for step_s in (steps_s.mean(), np.median(steps_s))]


def _session_in(path: Path) -> Path | None:
    """The session file that a path means, or None."""
    is_one = path.name == _SESSION or (path.is_dir() and (path / _SESSION).exists())
    return session_file(path) if is_one else None


def _is_session(file: Path) -> InputError:
    return InputError(
        "A session holds one table for each experiment. Use "
        f"hl.load(path).to_pandas(experiment). {file}"
    )


def _table(data: Any) -> Table:
    """Columns of numbers of a DataFrame, a Dataset or a dictionary."""
    columns, reasons = _columns(data)
    lengths = {values.size for values in columns.values()}
    if not columns:
        why = next(iter(reasons.values()), "Give columns by name.")
        raise InputError(f"The data have no column of numbers. {why}")
    if len(lengths) > 1:
        raise InputError(
            f"The data have columns of the lengths {sorted(lengths)}. Give columns of one length."
        )
    if lengths == {0}:
        raise InputError(f"The columns {', '.join(columns)} have no rows. Give at least one row.")
    time_name = next((n for n in TIME_NAMES if n in columns and _may_be_times(n, columns[n])), None)
    time_s = None if time_name is None else columns[time_name]
    rate_hz = None if time_s is None else rate_of_times(time_s)
    why = "" if time_s is not None else _why_no_times(columns)
    found = Table(columns, rate_hz, time_name=time_name, time_s=time_s, why_no_times=why)
    stated = getattr(data, "attrs", {}).get("rate_hz")
    if stated is None:
        return found
    number = real_array("The attribute rate_hz", stated)
    if number.size != 1:
        raise InputError(f"The attribute rate_hz has shape {number.shape}; it must be one number.")
    return _at_rate(found, float(number.item()))


def _may_be_times(name: str, values: Floats) -> bool:
    """A column that is only called like times, such as t, has to rise, as in files."""
    return name == "time_s" or bool((np.diff(values) > 0.0).all())


def _why_no_times(columns: Mapping[str, Floats]) -> str:
    """Why a column that is called like one of times is none; empty where there is none."""
    for name, values in columns.items():
        if _base(name) in TIME_NAMES:
            rises = (np.diff(values) > 0.0).all()
            why = "states a unit that is not a time" if rises else "does not rise everywhere"
            return f"Column {name} {why}."
    return ""


def _columns(data: Any) -> tuple[dict[str, Floats], dict[str, str]]:
    """Columns of numbers by name, and why each other column is none.

    An index or a coordinate of times is a column too.
    """
    if not (hasattr(data, "keys") and hasattr(data, "__getitem__")):
        raise InputError(
            f"The data are {shown(data)}; they must be a file, a table, a DataFrame, a Dataset or "
            "a dictionary of columns, such as {'u': u, 'y': y}."
        )
    found = {str(name): data[name] for name in data.keys()}  # noqa: SIM118
    found |= {str(name): each for name, each in getattr(data, "coords", {}).items()}
    factors = {name: _seconds(name, values) for name, values in found.items()}
    index = getattr(data, "index", None)
    if index is not None and (factor := _seconds(index.name, index)) is not None:
        found["time_s"], factors["time_s"] = index, factor
    columns, reasons = {}, {}
    for name, values in found.items():
        try:
            columns[name] = _column(f"Column {name}", values)
        except InputError as error:
            reasons[name] = str(error)
    named = [name for name in columns if _base(name) in TIME_NAMES]
    for name in sorted(named, key=lambda each: TIME_NAMES.index(_base(each))):
        factor = factors[name]
        if factor is not None and _may_be_times(name, columns[name]):
            if name not in TIME_NAMES or factor != 1.0:
                columns["time_s"] = columns.pop(name) * factor
            break
    return columns, reasons


def _base(name: str) -> str:
    """Name of a column without its unit, as columns of times are called."""
    return split_header(name)[0].casefold()


def _seconds(name: object, values: Any) -> float | None:
    """Factor to s of times in the unit that their name or attribute states; None for others."""
    if getattr(getattr(values, "dtype", None), "kind", "") in ("m", "M"):
        return 1.0  # `_column` makes seconds of them
    found = _time_unit(str(name), values) if _base(str(name)) in TIME_NAMES else None
    return found.factor if found is not None and found.si == "s" else None


def _time_unit(name: str, values: Any) -> Unit:
    """The unit that the name or the attribute of a column states; s if neither does."""
    unit = split_header(name)[1] or str(getattr(values, "attrs", {}).get("units", ""))
    return parse_unit(unit or "s", f"Column '{name}'")


def _factor_to_s(name: str, values: Any) -> float:
    """Factor to s of a column that the caller names as that of times.

    Raises:
        InputError: it states another unit.
    """
    if getattr(getattr(values, "dtype", None), "kind", "") in ("m", "M"):
        return 1.0
    found = _time_unit(name, values)
    if found.si != "s":
        raise InputError(f"Column {name!r} is in {found.si}, not in s. Name a column of times.")
    return found.factor


def _column(name: str, values: Any) -> Floats:
    """One column as numbers; clock times become seconds since the first."""
    kind = getattr(getattr(values, "dtype", None), "kind", "")
    array = np.asarray(values, dtype="datetime64[ns]") if kind == "M" else values
    if kind in ("m", "M"):
        array = np.asarray(array)
        array = (array - array[:1]) / np.timedelta64(1, "s")
    column = real_array(name, array)
    if column.ndim != 1:
        raise InputError(f"{name} has shape {column.shape}; it must have one number for each row.")
    return column


@checked
def records(
    data: Data | Record | Sequence[Record],
    input: str = "u",
    output: str = "y",
    *,
    rate_hz: float | None = None,
    time: str | None = None,
    hold: str | None = None,
) -> list[Record]:
    """Input and output of any source as the fits of `haselab.identify` take them.

    Args:
        data: as of `table`.
        input: column of the input.
        output: column of the output.
        rate_hz: rows a second, in Hz, which the times must not contradict. None: from the times.
        time: column of the times, in s or in the unit that it states. None: found by its name, such
            as `time_s` or `t [ms]`.
        hold: the input between its rows: "zero" (held), "first" (straight lines) or
            "band-limited". None: assumed to be held; a fit adds a note if its result depends on it.
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
    if isinstance(data, Sequence) and data and all(isinstance(each, Record) for each in data):
        return list(data)
    found = numeric_table(data, (input, output), rate_hz, time)
    assumed, hold = hold is None, "zero" if hold is None else hold
    if found.rate_hz is not None and not is_uneven(found):
        record = Record.sampled(found[input], found[output], found.rate_hz, hold=hold)
        return [replace(record, hold_assumed=assumed)]
    if found.time_s is None or found.time_name is None:
        why = f" {found.why_no_times}" if found.why_no_times else ""
        raise InputError(
            f"The data state no sampling rate.{why} Give rate_hz, or name the column with time=."
        )
    axis = time_axis(found.time_s, Path("data"), found.time_name)
    kept = records_of(found, (input, output), axis, hold, hold_assumed=assumed)
    if not kept:
        raise InputError("Every part between gaps is too short or constant. Record without gaps.")
    return kept


@checked
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
