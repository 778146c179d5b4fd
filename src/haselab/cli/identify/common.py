"""What the commands of `haselab identify` share: options, reading records, the answer."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, ResultError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.columns import (
    STRAIN,
    Quantity,
    advice_on_columns,
    check_strain,
    check_unit,
    drive_of,
    note_units,
    strains_of,
)
from haselab.cli.common import POSITIVE, REAL, emit
from haselab.cli.options import shared_option
from haselab.identify.record import Record
from haselab.identify.statics.columns import plausible_strain, plausible_voltage
from haselab.identify.training_output import find_copy
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.time_axis import check_complete, check_rising, records_of, time_axis
from haselab.store.columns.reader import check_rate
from haselab.store.columns.selection import ColumnOptions, check_assumed_seconds
from haselab.store.columns.table import Table, read_table

__all__ = [
    "CAPACITANCE",
    "FILE",
    "FILES",
    "INPUT",
    "LOAD",
    "MONITOR_SCALE",
    "OUTPUT",
    "RATE",
    "STRAIN",
    "STRESS",
    "STRETCH",
    "VOLTAGE",
    "Fit",
    "Recorded",
    "axis_names",
    "emit_fit",
    "name_files_in_errors",
    "output_name",
    "rate_hz_of",
    "read_columns",
    "read_quantities",
    "read_record",
    "read_recorded",
    "read_valid",
    "refuse_copies",
    "unit_of_name",
    "unit_text",
]

FILE = click.argument("file", type=click.Path(path_type=Path))
FILES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
RATE = shared_option("--rate-hz", type=REAL, detail="Default: the rate in the file.")
INPUT = shared_option("--input", "source", default="u", show_default=True)
OUTPUT = shared_option("--output", default="y", show_default=True)

MONITOR_SCALE = shared_option(
    "--volt-per-monitor-volt", type=POSITIVE,
    detail="The column is then this monitor, and the drive is the column times this scale, divided "
    "by gain_v_per_v of the actuator file. Default: the column is the drive.",
)  # fmt: skip

_SHORTER = {  # parts of an answer that nobody reads on the screen
    "covariance": "of all parameters (use --json or --out)",
    "training_output": "stored for haselab compare (use --json or --out)",
}
_COPY = 0.9  # share of the samples of a record, above which it is a copy of another one

STRETCH = Quantity("--stretch", ("stretch",), "1", "the stretch", signed=False)
VOLTAGE = Quantity("--voltage", ("voltage_v", "voltage"), "V", "the voltage")
CAPACITANCE = Quantity(
    "--capacitance",
    ("capacitance_f", "capacitance", "relative_capacitance"),
    None,
    "the capacitance, in F or in relative units",
    signed=False,
)
LOAD = Quantity("--load", ("load_n", "load", "force_n", "force"), "N", "the force")
STRESS = Quantity(
    "--stress", ("nominal_stress_pa", "nominal_stress", "stress"), "Pa", "the nominal stress"
)


class Fit(Protocol):
    """What all fits have in common."""

    @property
    def status(self) -> str:
        """`ok`, or why there is no result."""

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""

    def answer(self) -> JsonObject:
        """Keys of the public contract."""


def emit_fit(
    fit: Fit,
    files: Sequence[Path],
    as_json: bool,
    out: Path | None,
    more: Mapping[str, Any] | None = None,
    shorter: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    shown: Mapping[str, Any] | None = None,
) -> None:
    """Print the answer and the keys `more`; without a result, end the command with code 3.

    The readable lines have `shorter` in place of long parts of the answer, and `units`, by name;
    or `shown` in place of all of it.
    """
    if not fit.succeeded:
        listed = " ".join(str(file) for file in files)
        if as_json:
            emit(fit.answer(), as_json=True, out=out)
        raise ResultError(f"{fit.status}: {listed}")
    answer = {**fit.answer(), **(more or {})}
    stored = {name: text for name, text in _SHORTER.items() if answer.get(name) is not None}
    shorter = {**stored, **(shorter or {})}
    emit(answer, as_json=as_json, out=out, shorter=shorter, units=units, shown=shown)


@contextmanager
def name_files_in_errors(*files: Path) -> Iterator[None]:
    """Append the names of the files to an error about their columns."""
    try:
        yield
    except InputError as error:
        text = str(error)
        names = " ".join(str(file) for file in files)
        raise InputError(text if names in text else f"{text.rstrip('.')}: {names}") from error


def refuse_copies(files: Sequence[Path], outputs: Sequence[NDArray[np.float64]]) -> None:
    """Refuse a record that repeats another one: it would count twice, and narrow the intervals.

    If they only share a part, such as the same first experiment of two sessions on one twin, a
    warning says so.

    Args:
        files: one for each record.
        outputs: measured values of one quantity. Shape `(M_r,)` each.
    Raises:
        InputError: most samples of a record are those of another one.
    """
    found = find_copy(outputs)
    if found is None:
        return
    one, other, share = found
    text = (
        f"{files[one]} and {files[other]} have the same measured values (up to "
        f"{100.0 * share:.0f} % of them)."
    )
    if share > _COPY:
        raise InputError(
            f"{text} They would count twice. Leave out one of them, or the part that both have."
        )
    click.echo(
        f"haselab: warning: {text} These count twice, so the intervals are too narrow. Leave out "
        "the part that both have. On a twin, record with another seed.",
        err=True,
    )


def read_record(
    file: Path, names: Sequence[str], rate_hz: float | None, columns: ColumnOptions
) -> Table:
    """Read columns sampled at even times; a gap in the times is an `InputError`."""
    table = read_columns(file, names, columns)
    if table.rate_hz is None and table.time_s is not None:
        _check_even(table, rate_hz, file)
    return table


def read_columns(file: Path, names: Sequence[str], columns: ColumnOptions) -> Table:
    """Read columns and check that their values fit the units in their names."""
    table = read_valid(file, names, columns)
    _check_units(table, names, file)
    return table


@dataclass(frozen=True)
class Recorded:
    """Input and output of a file, ready for a fit.

    Args:
        records: one for each part without gaps.
        units: SI units of input and output, "1" for a pure number; "" where the file states none.
    """

    records: list[Record]
    units: tuple[str, str]


def read_recorded(
    file: Path,
    names: tuple[str, str],
    rate_hz: float | None,
    held_at_hz: float | None,
    columns: ColumnOptions,
    *,
    hold: str | None = None,
    through: Path | None = None,
    to_strain: bool = True,
    drive_of_file: Path | None = None,
    volt_per_monitor_volt: float | None = None,
) -> Recorded:
    """Read the records of a file.

    Args:
        file: with the columns.
        names: of the columns of input and output.
        rate_hz: sampling rate; None: that of the file.
        held_at_hz: update rate of the output converter; None: the sampling rate.
        columns: what the user states about the columns.
        hold: how the input behaves between its updates; None: not stated, so held is assumed.
        through: actuator file whose voltage map converts the input from V to strain.
        to_strain: with `through`, also convert an output in m to strain if the file has the length
            at strain 0.
        drive_of_file: actuator file with the limits of the drive, which an input in V is compared
            with; None: `through`.
        volt_per_monitor_volt: V at the actuator for each V of the input, which is then a monitor.
    Returns:
        The records.
    Raises:
        InputError: no sampling rate, no usable data, or a drive beyond the limits.
        LimitError: a voltage outside the voltage map.
    """
    table = read_columns(file, names, columns)
    units = (_unit(table, names[0]), _unit(table, names[1]))
    limits = drive_of_file or through
    voltage = units[0] == "V" or through is not None or volt_per_monitor_volt is not None
    if units[0] in ("", "V") and voltage and limits is not None:
        drive_v = drive_of(
            names[0], table[names[0]], file, load_actuator(limits), volt_per_monitor_volt
        )
        table = replace(table, columns={**table.columns, names[0]: drive_v})
        units = "V", units[1]
    elif volt_per_monitor_volt is not None:
        raise InputError(
            f"--volt-per-monitor-volt is for a monitor in V, but column {names[0]} is "
            f"{unit_text(units[0])}. Leave out the option, or name another column: {file}"
        )
    if through is not None:
        if units[0] not in ("", "V"):
            raise InputError(
                f"--through-voltage-map converts a voltage, but column {names[0]} is "
                f"{unit_text(units[0])}. Leave out the option, or name another column: {file}"
            )
        known = load_actuator(through)
        changed = {names[0]: known.voltage_map().strain(table[names[0]])}
        units = "1", units[1]
        if units[1] == "":  # the model is to be one from strain to strain
            check_strain(names[1], table[names[1]], None, file, known)
        if to_strain and units[1] == "m" and known.actuator.geometry.zero_length_m is not None:
            output, stated = names[1], table.units[names[1]]
            changed[output] = strains_of(output, table[output], stated, file, known)
            units = "1", "1"
        table = replace(table, columns={**table.columns, **changed})
    assumed = hold is None and held_at_hz is None
    hold = "zero" if hold is None else hold
    time_s = table.time_s if table.rate_hz is None else None
    if time_s is not None and held_at_hz is None:
        axis = time_axis(time_s, file, table.time_name or "time_s")
        _check_rate(table, rate_hz, axis.rate_hz, file)
        records = records_of(table, names, axis, hold, hold_assumed=assumed)
        if not records:
            raise InputError(
                f"Every part between gaps of column {table.time_name} is too short or constant. "
                f"Record without gaps: {file}"
            )
        return Recorded(records, units)
    rate = rate_hz_of(table, rate_hz, file)
    u, y = (table[name] for name in names)
    record = Record.sampled(u, y, rate, hold=hold, held_at_hz=held_at_hz)
    return Recorded([replace(record, hold_assumed=assumed)], units)


def unit_of_name(name: str) -> str:
    """SI unit of columns with such a name, as haselab writes them; "" where it says nothing."""
    return "1" if name.endswith("strain") else "V" if name.endswith("_v") else ""


def axis_names(source: str, output: str, units: tuple[str, str] | Table) -> tuple[str, str]:
    """Names of input and output for the axes of a figure, with the units that are known."""
    if isinstance(units, Table):
        units = (_unit(units, source), _unit(units, output))
    first, second = (
        "Strain" if name == "strain" else f"{name} ({unit})" if unit else name
        for name, unit in zip((source, output), units, strict=True)
    )
    return first, second


def output_name(output: str, unit: str, through_map: bool) -> str:
    """Name of a model's output: the column, or "strain" where the voltage map made it one.

    Args:
        output: name of the column.
        unit: SI unit of the values that were fitted; empty: not known.
        through_map: whether the input was converted to a strain, so that a pure number is one too.
    """
    return "strain" if through_map and unit in ("", "1") else output


def unit_text(unit: str) -> str:
    """A unit in a sentence."""
    return "a pure number, such as a strain" if unit == "1" else f"in {unit}"


def _unit(table: Table, name: str) -> str:
    """SI unit that the file or the name of the column states."""
    stated = table.units.get(name)
    return unit_of_name(name) if stated is None else stated.si


def read_valid(
    file: Path,
    names: Sequence[str],
    columns: ColumnOptions,
    options: Sequence[str] = ("--input", "--output"),
    may_lack: Collection[str] = (),
) -> Table:
    """Read columns without the rows that a column `valid` marks with 0; print how many.

    Args:
        file: the file.
        names: of the columns.
        columns: what the user states about them.
        options: the options that name these columns.
        may_lack: columns in which values may be NaN; only they lack the values of such rows.
    Returns:
        The columns.
    """
    with advice_on_columns(options):
        table = read_table(file, names, columns, may_lack)
    note_units(table, file)
    if table.left_out:
        click.echo(
            f"haselab: left out {table.left_out} rows with 0 in column valid. File: {file}",
            err=True,
        )
    return table


def read_quantities(
    file: Path,
    wanted: Mapping[Quantity, str | None],
    columns: ColumnOptions,
    known: ActuatorTables | None = None,
) -> tuple[NDArray[np.float64], ...]:
    """Read columns of quantities, in SI units and in the order of `wanted`.

    Args:
        file: the file.
        wanted: the column that the user named for each quantity, or None.
        columns: what the user states about the columns.
        known: the actuator's file, with which strains are compared, and by whose length at strain
            0 displacements are divided.
    Returns:
        Values of each. Shape `(N,)`.
    Raises:
        InputError: a column is missing, or its unit belongs to another quantity; see also
            `strains_of`.
    """
    names = {quantity: quantity.column(file, given) for quantity, given in wanted.items()}
    table = read_valid(file, list(names.values()), columns, [each.option for each in names])
    found = []
    for quantity, name in names.items():
        if quantity is STRAIN:
            found.append(strains_of(name, table[name], table.units[name], file, known))
        else:
            check_unit(name, table.units[name], quantity, file)
            found.append(table[name])
    return tuple(found)


def _check_units(table: Table, names: Sequence[str], file: Path) -> None:
    """Refuse a column whose name states a unit that its values cannot have."""
    for name, other in zip(names, reversed(names), strict=True):
        if name.endswith("strain"):
            check_strain(name, table[name], table.units[name], file)
            plausible_strain(table[name], other, table[other])
        elif name.endswith("_v"):
            plausible_voltage(table[name])


def _check_even(table: Table, rate_hz: float | None, file: Path) -> None:
    """Refuse uneven times, and report the first gap or repeated time."""
    assert table.time_s is not None
    steps = np.diff(table.time_s)
    usual_s = float(np.median(steps)) if rate_hz is None else 1.0 / rate_hz
    uneven = np.flatnonzero(np.abs(steps - usual_s) > 0.5 * usual_s)
    if uneven.size == 0:
        return
    at = int(uneven[0])
    raise InputError(
        f"Column {table.time_name} has a step of {steps[at]:g} s after row {at + 1} instead of "
        f"{usual_s:g} s ({uneven.size} such steps). Split the file there and give the parts as "
        f"separate records: {file}"
    )


def rate_hz_of(table: Table, given: float | None, file: Path) -> float:
    """Sampling rate of a table: as given, else from the file; they must not contradict."""
    where = f"column {table.time_name}"
    if table.left_out and table.rate_hz is None:
        raise InputError(
            f"Without the {table.left_out} rows that have 0 in column valid, the times in column "
            "time_s are uneven. Split the file there and give the parts as separate records: "
            f"{file}"
        )
    if given is not None and 0.0 < given < float("inf"):
        rows = next(iter(table.columns.values())).size
        if table.time_s is not None and table.time_name is not None:
            found_hz = table.rate_hz
            if found_hz is None:
                axis = time_axis(table.time_s, file, table.time_name)
                check_complete(axis, file, table.time_name)
                found_hz = axis.rate_hz
            _check_rate(table, given, found_hz, file)
        elif table.rate_hz is not None:
            check_rate(given, table.rate_hz, rows, "the file's own rate", file)
    rate_hz = table.rate_hz if given is None else given
    if rate_hz is None and table.time_s is not None:
        check_rising(table.time_s, file, table.time_name or "time_s")
        raise InputError(
            f"The times in {where} are uneven. Resample the record. If no row is missing, you can "
            f"state the rate with --rate-hz instead: {file}"
        )
    if rate_hz is None:
        why = f" {table.why_no_times}" if table.why_no_times else ""
        raise InputError(
            f"The file states no sampling rate.{why} Add --rate-hz, name the column of the times "
            f"with --time, or add a line '# rate_hz = ...': {file}"
        )
    if not 0.0 < rate_hz < float("inf"):
        raise InputError(f"--rate-hz is {rate_hz:g} Hz. Use a rate above 0 Hz.")
    if given is None and table.time_s is not None:
        _check_rate(table, None, rate_hz, file)
    return rate_hz


def _check_rate(table: Table, given: float | None, found_hz: float, file: Path) -> None:
    """Compare the rate of the times with the stated one; without one, times need a clear unit."""
    name = table.time_name or "time_s"
    rows = next(iter(table.columns.values())).size
    assumed = name if table.assumed_seconds else ""
    if given is not None:
        check_rate(given, found_hz, rows, f"column {name}", file, assumed=assumed)
    elif assumed:
        check_assumed_seconds(assumed, found_hz, file)
