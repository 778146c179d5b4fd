"""What a user states about the columns of a file: the column of times, and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from haselab.base import InputError
from haselab.store.columns.archive import Archive
from haselab.store.columns.units import Unit, parse_unit

__all__ = [
    "AS_THE_FILE_STATES",
    "TIME_NAMES",
    "ColumnOptions",
    "assumed_seconds",
    "certain_times",
    "check_assumed_seconds",
    "stated_unit",
    "time_column",
    "why_no_times",
]

# With the rounding of times of few digits.
_AMBIGUOUS_HZ, _AMBIGUOUS_MONITORS_HZ = 10.0 * 1.001, 1e3 * 1.001
TIME_NAMES = ("time_s", "time", "zeit", "t", "x_value", "times", "temps", "tiempo", "tempo")


@dataclass(frozen=True)
class ColumnOptions:
    """Statements of the user about the columns of a file.

    Args:
        time: name of the column of times; None: found by name.
        units: units by column name, such as `{"U": "mV"}`; they override those in the file.
    """

    time: str | None = None
    units: Mapping[str, str] = field(default_factory=dict)


AS_THE_FILE_STATES = ColumnOptions()


def stated_unit(archive: Archive, full: str, options: ColumnOptions) -> Unit | None:
    """The unit of a column, from the options, else from the file; None if it is not stated.

    Args:
        archive: the file.
        full: name of the column in it.
        options: of the user.
    Returns:
        The unit.
    Raises:
        InputError: it is not known.
    """
    for name, text in options.units.items():
        if archive.locate(name) == full:
            return parse_unit(text, f"--unit {name}={text}")
    text = archive.unit_text(full)
    if not text:
        return None
    try:
        return parse_unit(text, f"Column '{full}'")
    except InputError as error:
        advice = f"If you know the unit, state it with --unit '{full}=UNIT'"
        raise InputError(f"{error} {advice}: {archive.file}") from error


def time_column(
    archive: Archive,
    options: ColumnOptions,
    used: Sequence[str] = (),
    beside: Sequence[str] | None = None,
) -> str | None:
    """Full name of the column of times.

    A column is used as the time if it is the only one with the first of the names time, Zeit, t,
    X_Value and the like, and if its unit, if stated, is a time; or if it is the only one with clock
    times. Where a file has several groups of
    columns, such as the structures of a MATLAB file, those of the group of the data come first.

    Args:
        archive: the file.
        options: of the user.
        used: columns that are something else.
        beside: columns to which the times belong. None: `used`.
    Returns:
        The name; None where there is none.
    Raises:
        InputError: the column that the options name is missing or has no times, or has a minus.
    """
    if options.time is not None:
        (full,) = archive.locate_all([options.time])
        if archive.is_negative(options.time):
            raise InputError(
                f"--time {options.time} asks for times with the other sign, which would fall. "
                f"Name the column without the minus: {archive.file}"
            )
        unit = stated_unit(archive, full, options)
        if unit is not None and unit.si != "s":
            raise InputError(
                f"--time {options.time} names a column in {unit.symbol}, which is not a time. Name "
                f"the column of the times: {archive.file}"
            )
        return full
    groups = {full.rpartition("/")[0] for full in (used if beside is None else beside)}
    if len(groups) == 1 and (group := groups.pop()):
        own = [full for full in archive.names if full.rpartition("/")[0] == group]
        exact = f"{group}/time_s" if f"{group}/time_s" in own else None
        if (found := _times_among(archive, options, own, exact, used)) is not None:
            return found
        if sum(full.endswith("/time_s") for full in archive.names) > 1:
            return None  # these are the times of other groups
    exact = None if len(groups) > 1 else archive.locate("time_s")
    return _times_among(archive, options, archive.names, exact, used)


def _times_among(
    archive: Archive,
    options: ColumnOptions,
    names: Sequence[str],
    exact: str | None,
    used: Sequence[str],
) -> str | None:
    """The column of times among some columns, one of which may be called exactly `time_s`."""
    if exact is not None:
        return None if exact in used or not _is_time(archive, exact, options) else exact
    plain = [(full, archive.plain_name(full).casefold()) for full in names]
    for name in TIME_NAMES:
        found = [full for full, base in plain if base == name and full not in used]
        times = [full for full in found if _is_time(archive, full, options)]
        if len(times) == 1:
            return times[0]
    clocks = [full for full in names if archive.is_clock(full) and full not in used]
    return clocks[0] if len(clocks) == 1 else None


def why_no_times(archive: Archive, options: ColumnOptions) -> str:
    """Why a column that is called like one of times is none.

    Args:
        archive: the file.
        options: of the user.
    Returns:
        A sentence; empty where no such column states another unit.
    """
    for full in archive.names:
        if archive.plain_name(full).casefold() in TIME_NAMES and not _is_time(
            archive, full, options
        ):
            return f"Column {full} states a unit that is not a time."
    return ""


def certain_times(archive: Archive, full: str, options: ColumnOptions) -> bool:
    """Whether a column must have rising times, as the user or the file says that it has times.

    Clock times may have too few digits for the rate of the rows.

    Args:
        archive: the file.
        full: name of the column.
        options: of the user.
    """
    if options.time is not None or full == "time_s":
        return True
    return stated_unit(archive, full, options) is not None and not archive.is_clock(full)


def assumed_seconds(archive: Archive, full: str, options: ColumnOptions) -> bool:
    """Whether a column of times is taken as seconds though nobody says so.

    Args:
        archive: the file.
        full: name of the column of times.
        options: of the user.
    Returns:
        True for a column such as `t` without a unit; `time_s` states its own.
    """
    name = archive.plain_name(full).casefold()
    return not name.endswith("_s") and stated_unit(archive, full, options) is None


def check_assumed_seconds(name: str, rate_hz: float, file: Path, *, monitors: bool = False) -> None:
    """Refuse times without a unit whose rate is so low in seconds that ms are as likely.

    Records of moving actuators have 50 Hz to 10 kHz: in milliseconds these are 0.05 to 10. Monitors
    have up to 1 MHz.

    Args:
        name: of the column.
        rate_hz: rows per second, if the times are in s.
        file: where they are from.
        monitors: whether the file has voltage and current.
    Raises:
        InputError: at most 10 rows per second, or 1000 of monitors.
    """
    if rate_hz <= (_AMBIGUOUS_MONITORS_HZ if monitors else _AMBIGUOUS_HZ):
        raise InputError(
            f"Column {name} states no unit: in seconds it has {rate_hz:.4g} rows per second, in "
            f"milliseconds {1e3 * rate_hz:.4g}. State which: --unit {name}=s or --unit {name}=ms: "
            f"{file}"
        )


def _is_time(archive: Archive, full: str, options: ColumnOptions) -> bool:
    try:
        unit = stated_unit(archive, full, options)
    except InputError:
        return False
    return unit is None or unit.si == "s"
