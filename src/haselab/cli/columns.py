"""Options that name the columns of a file and state their units."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.cli.options import OTHER_SIGN
from haselab.models.actuator import ActuatorTables
from haselab.store.columns.archive import MissingColumnsError
from haselab.store.columns.reader import open_archive
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import Table
from haselab.store.columns.units import Unit

__all__ = [
    "STRAIN",
    "Quantity",
    "advice_on_columns",
    "check_strain",
    "check_unit",
    "column_option",
    "column_options",
    "drive_of",
    "note_conversions",
    "note_seconds",
    "note_units",
    "options_of_each",
    "refuse_beyond_drive",
    "refuse_other_sign",
    "strains_of",
]

F = TypeVar("F", bound=Callable[..., Any])
_LARGE_STRAIN = 1.0  # twice the length: without a unit, it is more likely per cent
_FAR = 10.0  # times a known strain; per cent are 100 times
_LENGTHS = 0.5, 3.0  # of actuators, over the length at strain 0
_NEAREST_ZERO = 0.3  # smallest displacement, over the length at strain 0
_BESIDE = 0.05  # of the drive's range: offset and noise of a recorded drive
_OFTEN = 0.01  # share of the samples beyond it that are no noise
_FAR_BEYOND = 0.5  # of the drive's range, which no noise reaches
_FEWEST = 3  # samples; fewer are spikes


@dataclass(frozen=True)
class Quantity:
    """A quantity that a command reads from a column.

    Args:
        option: the option that names the column, such as `--strain`.
        names: default names of the column; the first that the file has is used.
        si: the SI unit of the quantity; None: any.
        what: the quantity, for --help.
        signed: whether it can be negative, so that the other sign of a column makes sense.
    """

    option: str
    names: tuple[str, ...]
    si: str | None
    what: str
    signed: bool = True

    @property
    def parameter(self) -> str:
        """Name of the parameter that receives the option."""
        return f"{self.option.lstrip('-').replace('-', '_')}_column"

    def column(self, file: Path, given: str | None) -> str:
        """Return the name of the column that holds this quantity in a file."""
        if given is not None and not self.signed:
            refuse_other_sign(self.option, given, file)
        if given is not None or len(self.names) == 1:
            return given or self.names[0]
        with open_archive(file) as archive:
            found = next((name for name in self.names if archive.locate(name) is not None), None)
        return found or self.names[0]


def refuse_other_sign(option: str, column: str, file: Path) -> None:
    """Refuse a minus before the name of a column that cannot be negative.

    Raises:
        InputError: there is one.
    """
    if column.startswith("-"):
        with open_archive(file) as archive:
            if archive.is_negative(column):
                raise InputError(
                    f"{option} {column} asks for the other sign, but its values cannot be "
                    f"negative. Name the column without the minus: {file}"
                )


STRAIN = Quantity("--strain", ("strain",), "1", "the strain")


def column_option(quantity: Quantity) -> Callable[[F], F]:
    """Add the option that names the column of a quantity (passed on as `NAME_column`)."""
    default = " or ".join(quantity.names)
    sign = f"; {OTHER_SIGN}" if quantity.signed else ""
    return click.option(
        quantity.option, quantity.parameter, metavar="COLUMN",
        help=f"Name the column of {quantity.what}{sign}. Default: {default}.",
    )  # fmt: skip


def _units(pairs: Sequence[str]) -> Mapping[str, str]:
    found = {}
    for pair in pairs:
        name, mark, unit = pair.rpartition("=")
        if not (mark and name.strip() and unit.strip()):
            raise InputError(
                f"--unit {pair} is not COLUMN=UNIT. Name the column and its unit, for example "
                "--unit U=mV."
            )
        found[name.strip()] = unit.strip()
    return found


def column_options(function: F) -> F:
    """Add `--time` and `--unit` (passed on together as `columns`)."""

    @click.option(
        "--time", "time_column", metavar="COLUMN",
        help="Name the column of the times, in s or in the unit in its header. Default: time_s, "
        "time, t, Zeit or X_Value.",
    )  # fmt: skip
    @click.option(
        "--unit", "unit_pairs", multiple=True, metavar="COLUMN=UNIT",
        help="State the unit of a column, for example U=mV. Repeat the option for more columns. "
        "Default: the unit in the header, else SI.",
    )  # fmt: skip
    @functools.wraps(function)
    def wrapper(
        *args: Any, time_column: str | None, unit_pairs: Sequence[str], **kwargs: Any
    ) -> Any:
        return function(*args, columns=ColumnOptions(time_column, _units(unit_pairs)), **kwargs)

    return wrapper  # type: ignore[return-value]


@contextmanager
def advice_on_columns(options: Sequence[str]) -> Iterator[None]:
    """Add to an error about missing columns which options name them."""
    try:
        yield
    except MissingColumnsError as error:
        raise error.advised(f"Name the columns with {' and '.join(options)}") from error


def check_unit(column: str, unit: Unit | None, quantity: Quantity, file: Path) -> None:
    """Refuse a column whose stated unit belongs to another quantity.

    Raises:
        InputError: the unit belongs to another quantity.
    """
    if unit is None or quantity.si is None or unit.si == quantity.si:
        return
    raise InputError(
        f"Column {column} is in {unit.symbol}, but {quantity.option} needs {quantity.what}"
        f"{'' if quantity.si == '1' else f' in {quantity.si} or a multiple of it'}. Name another "
        f"column, or state its unit with --unit: {file}"
    )


def check_strain(
    column: str,
    values: NDArray[np.float64],
    unit: Unit | None,
    file: Path,
    known: ActuatorTables | None = None,
) -> None:
    """Refuse strains without a unit that are probably in per cent.

    Args:
        column: name of it.
        values: shape `(N,)`.
        unit: that it states; None: none, and then it is checked.
        file: of the column.
        known: the actuator's file, whose maps say how large its strain is.
    Raises:
        InputError: a strain above 1, or 10 times the largest one of a map.
    """
    if unit is not None:
        return
    size = float(np.nanmax(np.abs(values)))
    place, largest = "", _LARGE_STRAIN / _FAR
    for section, strain in _largest_strains(known):
        if strain < largest:
            place, largest = section, strain
    if size <= _FAR * largest:
        return
    compared = f", but [{place}] of the actuator file ends at a strain of {largest:.3g}"
    raise InputError(
        f"Column {column} reaches {size:.3g} and states no unit"
        f"{compared if place else f'; as a strain, {size:.3g} times the length'}. Add --unit "
        f"'{column}=%' if it is in per cent, --unit '{column}=1' if it is a ratio, --unit "
        f"'{column}=mm' if it is a displacement or a length in mm, or name another column: {file}"
    )


def strains_of(
    column: str,
    values: NDArray[np.float64],
    unit: Unit | None,
    file: Path,
    known: ActuatorTables | None = None,
) -> NDArray[np.float64]:
    """Strains of a column: as they are, or of displacements or lengths and the length at strain 0.

    Args:
        column: name of it.
        values: in SI units. Shape `(N,)`.
        unit: that it states, or None.
        file: of the column.
        known: the actuator's file, with the length at strain 0.
    Returns:
        Shape `(N,)`.
    Raises:
        InputError: strains that are probably in per cent; no length at strain 0; values that may
            be neither displacements nor lengths; a unit of another quantity.
    """
    if unit is None or unit.si != "m":
        check_unit(column, unit, STRAIN, file)
        check_strain(column, values, unit, file, known)
        return values
    zero_m = None if known is None else known.actuator.geometry.zero_length_m
    if zero_m is None:
        raise InputError(
            f"Column {column} is in {unit.symbol}, but --strain needs the strain, or a displacement"
            " and the length at strain 0. State this length as zero_length_m in "
            f"[actuator.geometry] of an actuator file, and add --actuator FILE: {file}"
        )
    least, largest = float(np.nanmin(values)), float(np.nanmax(values))
    sensor_m = known.actuator.geometry.sensor_zero_m if known is not None else None
    near_zero = float(np.nanmin(np.abs(values))) < _NEAREST_ZERO * zero_m
    if _are_lengths(least, largest, zero_m):
        what, strain = "length / zero_length_m - 1", values / zero_m - 1.0
    elif (near_zero and max(-least, largest) < zero_m) or (
        sensor_m is not None and _are_lengths(least + sensor_m, largest + sensor_m, zero_m)
    ):
        what, strain = "displacement / zero_length_m", values / zero_m
        if sensor_m is not None:
            what = f"(displacement + {sensor_m:g} m) / zero_length_m - 1"
            strain = (values + sensor_m) / zero_m - 1.0
    else:
        raise InputError(
            f"Column {column} is from {least:.4g} to {largest:.4g} m, but the length at strain 0 "
            f"is zero_length_m = {zero_m:g} m, so its values are neither displacements nor lengths."
            " Correct zero_length_m, or state the unit of the column with --unit. For a reading "
            "that falls while the actuator lengthens, put a minus before the name of the column, "
            "and state the length at which it reads 0 as sensor_zero_m in [actuator.geometry]: "
            f"{file}"
        )
    low, high = float(np.nanmin(strain)), float(np.nanmax(strain))
    click.echo(
        f"haselab: strain = {what} ({low:.3g} to {high:.3g}), with zero_length_m = {zero_m:g} m of "
        f"the actuator file. File: {file}", err=True,
    )  # fmt: skip
    return np.asarray(strain)


def drive_of(
    column: str,
    values_v: NDArray[np.float64],
    file: Path,
    known: ActuatorTables | None,
    volt_per_monitor_volt: float | None = None,
) -> NDArray[np.float64]:
    """Drive before the amplifier of a column of voltages: as it is, or from a voltage monitor.

    Args:
        column: name of it.
        values_v: shape `(N,)`.
        file: of the column.
        known: the actuator's file, with the limits of the drive and the gain of the amplifier.
        volt_per_monitor_volt: V at the actuator for each V of the column; None: it is the drive.
    Returns:
        Shape `(N,)`.
    Raises:
        InputError: a drive beyond the limits; a monitor without the gain of the amplifier.
    """
    if volt_per_monitor_volt is None:
        refuse_beyond_drive(column, values_v, file, known)
        return values_v
    gain = None if known is None else known.drive.gain_v_per_v
    if gain is None:
        raise InputError(
            "--volt-per-monitor-volt needs the gain of the amplifier, to convert the monitor to the"
            " drive. State gain_v_per_v in [drive] of an actuator file, and add --actuator FILE: "
            f"{file}"
        )
    drive_v = values_v * (volt_per_monitor_volt / gain)
    refuse_beyond_drive(column, drive_v, file, known, what=f"Column {column}, as the drive,")
    click.echo(
        f"haselab: drive = {column} * {volt_per_monitor_volt:g} / {gain:g} "
        f"({float(np.nanmin(drive_v)):.3g} to {float(np.nanmax(drive_v)):.3g} V), with "
        f"gain_v_per_v = {gain:g} of the actuator file. File: {file}", err=True,
    )  # fmt: skip
    return drive_v


def refuse_beyond_drive(
    column: str,
    drive_v: NDArray[np.float64],
    file: Path,
    known: ActuatorTables | None,
    *,
    what: str = "",
    scale: str = "--volt-per-monitor-volt S",
) -> None:
    """Refuse a recorded drive outside the limits of the actuator: it is in another unit.

    Offsets, noise and spikes are allowed: at most 1 % of the samples may be beyond the limits by
    more than 5 % of their range, and at most two by more than half of it.

    Args:
        column: name of it.
        drive_v: its values as the drive before the amplifier. Shape `(N,)`.
        file: of the column.
        known: the actuator's file; without `high_v`, nothing is compared.
        what: start of the message; empty: the column.
        scale: the option that states the scale of a monitor.
    Raises:
        InputError: it is outside.
    """
    if known is None or known.drive.high_v is None:
        return
    high_v = known.drive.high_v
    low_v = -abs(high_v) if known.drive.low_v is None else known.drive.low_v
    beyond = np.maximum(drive_v - high_v, low_v - drive_v) / (high_v - low_v)
    often = np.count_nonzero(beyond > _BESIDE) > max(_OFTEN * beyond.size, _FEWEST - 1)
    if not often and np.count_nonzero(beyond > _FAR_BEYOND) < _FEWEST:
        return
    raise InputError(
        f"{what or f'Column {column}'} is from {float(np.nanmin(drive_v)):.4g} to "
        f"{float(np.nanmax(drive_v)):.4g} V, but low_v and high_v in [drive] of the actuator file "
        f"permit {low_v:g} to {high_v:g} V before the amplifier. If the column is a voltage "
        f"monitor, state {scale}: the V at the actuator for each V of the column (1000 for a "
        "monitor of 1 V/kV, 1 for the voltage at the actuator). If its unit is another one, add "
        f"--unit '{column}=mV'. If the drive may be that high, correct low_v and high_v: {file}"
    )


def _are_lengths(least_m: float, largest_m: float, zero_m: float) -> bool:
    """Whether an actuator of this length at strain 0 may have such lengths."""
    return _LENGTHS[0] * zero_m < least_m and largest_m < _LENGTHS[1] * zero_m


def options_of_each(files: Sequence[Path], columns: ColumnOptions) -> list[ColumnOptions]:
    """What the user states about the columns of each of several files.

    Args:
        files: tables.
        columns: about the columns of all of them.
    Returns:
        For each file, what is about a column of it.
    Raises:
        InputError: no file has the column.
    """
    found, names = [], dict[Path, Sequence[str]]()
    for file in files:
        with open_archive(file) as archive:
            has = {
                name for name in (*columns.units, *([columns.time] if columns.time else []))
                if archive.locate(name) is not None
            }  # fmt: skip
            names[file] = archive.names
        units = {name: unit for name, unit in columns.units.items() if name in has}
        found.append(ColumnOptions(columns.time if columns.time in has else None, units))
    unknown = [f"--unit {name}={unit}" for name, unit in columns.units.items()
               if not any(name in each.units for each in found)]  # fmt: skip
    if columns.time is not None and not any(each.time for each in found):
        unknown.append(f"--time {columns.time}")
    if unknown:
        raise InputError(
            f"{unknown[0]} names no column of the files: "
            + "; ".join(f"{file} has {', '.join(has)}" for file, has in names.items())
        )
    return found


def _largest_strains(known: ActuatorTables | None) -> Iterator[tuple[str, float]]:
    """Section and largest strain of each map of an actuator file."""
    if known is None:
        return
    if known.sensing.strain_map is not None and known.sensing.strain_map.range_f is not None:
        ends = known.strain_map().strain(known.sensing.strain_map.range_f)
        yield "sensing.strain_map", float(np.abs(ends).max())
    if known.drive.voltage_map is not None:
        to_volt = known.voltage_map()
        yield "drive.voltage_map", max(abs(to_volt.strain_low), abs(to_volt.strain_high))


def note_seconds(name: str, file: Path) -> None:
    """Say on stderr that a column of times is taken as seconds."""
    click.echo(
        f"haselab: column {name} states no unit: its values are taken as times in seconds. State "
        f"another one with --unit {name}=ms. File: {file}",
        err=True,
    )


def note_units(table: Table, file: Path) -> None:
    """Report on stderr which columns were converted, and times whose unit nobody states."""
    if table.assumed_seconds:
        note_seconds(str(table.time_name), file)
    note_conversions(table.units, file)


def note_conversions(units: Mapping[str, Unit | None], file: Path) -> None:
    """Report on stderr which columns were converted.

    Args:
        units: that the columns state, by their names.
        file: of the columns.
    """
    for name, unit in units.items():
        if unit is not None and unit.factor != 1.0:
            to = "a pure number" if unit.si == "1" else unit.si
            click.echo(
                f"haselab: column {name} was converted from {unit.symbol} to {to}. File: {file}",
                err=True,
            )
