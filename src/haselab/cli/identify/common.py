"""What the commands of `haselab identify` share: options, the rate of a table, the answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.common import REAL, emit
from haselab.identify.record import Record
from haselab.identify.statics.columns import plausible_strain, plausible_voltage
from haselab.pipelines.time_axis import records_of, time_axis, times_in
from haselab.store.columns.reader import check_rate
from haselab.store.columns.table import Table, read_table

__all__ = [
    "FILE",
    "FILES",
    "INPUT",
    "OUTPUT",
    "RATE",
    "Fit",
    "about",
    "give",
    "rate_hz_of",
    "read_columns",
    "read_record",
    "read_valid",
    "recorded",
]

FILE = click.argument("file", type=click.Path(path_type=Path))
FILES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
RATE = click.option("--rate-hz", type=REAL, help="Rows a second, where the file does not tell.")
INPUT = click.option("--input", "source", default="u", show_default=True, help="Input column.")
OUTPUT = click.option("--output", default="y", show_default=True, help="Output column.")


class Fit(Protocol):
    """What all fits have in common."""

    @property
    def status(self) -> str:
        """The word ok, or why there is no result."""

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""

    def answer(self) -> dict[str, Any]:
        """Keys of the public contract."""


def give(
    fit: Fit,
    files: Sequence[Path],
    as_json: bool,
    out: Path | None,
    more: Mapping[str, Any] | None = None,
) -> None:
    """Print the answer, and `more` keys; a fit without a result ends the command with code 3."""
    if not fit.succeeded:
        listed = " ".join(str(file) for file in files)
        if as_json:
            emit(fit.answer(), as_json=True, out=out)
        raise ResultError(f"{fit.status}: {listed}")
    emit({**fit.answer(), **(more or {})}, as_json=as_json, out=out)


@contextmanager
def about(*files: Path) -> Iterator[None]:
    """What is wrong with the columns of a file ends with the file's name."""
    try:
        yield
    except InputError as error:
        text = str(error)
        names = " ".join(str(file) for file in files)
        raise InputError(text if names in text else f"{text.rstrip('.')}: {names}") from error


def read_record(file: Path, columns: Sequence[str], rate_hz: float | None) -> Table:
    """Columns that were stored at even times; a column `time_s` with a gap is an `InputError`."""
    table = read_columns(file, columns)
    if table.rate_hz is None:
        time_s = times_in(file)
        if time_s is not None:
            _check_even(time_s, rate_hz, file)
    return table


def read_columns(file: Path, columns: Sequence[str]) -> Table:
    """Columns whose values fit the units in their names."""
    table = read_valid(file, columns)
    _check_units(table, columns)
    return table


def recorded(
    file: Path,
    columns: tuple[str, str],
    rate_hz: float | None,
    held_at_hz: float | None,
    *,
    hold: str = "zero",
    through: Path | None = None,
) -> tuple[list[Record], list[str]]:
    """The records of a file, and what was done about its times.

    Args:
        file: with the columns.
        columns: names of input and output.
        rate_hz: rows a second, where given.
        held_at_hz: update rate of the converter, where given.
        hold: the input between its updates.
        through: actuator file whose voltage map turns the input from V into strain.
    Raises:
        InputError: no rate, or nothing that can be used.
        LimitError: a voltage outside the voltage map.
    """
    table = read_columns(file, columns)
    if through is not None:
        to_volt = load_actuator(through).voltage_map()
        strain = to_volt.strain(table[columns[0]])
        table = replace(table, columns={**table.columns, columns[0]: strain})
    time_s = times_in(file) if table.rate_hz is None else None
    if time_s is not None and held_at_hz is None:
        axis = time_axis(time_s, file)
        if rate_hz is not None:
            check_rate(rate_hz, axis.rate_hz, time_s.size, "column time_s", file)
        records, notes = records_of(table, columns, axis, hold)
        if not records:
            raise InputError(
                "Every part between gaps of column time_s is too short or constant. Record without "
                f"gaps: {file}"
            )
        return records, notes
    rate = rate_hz_of(table, rate_hz, file)
    u, y = (table[name] for name in columns)
    return [Record.sampled(u, y, rate, hold=hold, held_at_hz=held_at_hz)], []


def read_valid(file: Path, columns: Sequence[str]) -> Table:
    """Columns without the rows that a column `valid` marks with 0; a note says how many."""
    table = read_table(file, columns)
    if table.left_out:
        click.echo(
            f"haselab: {table.left_out} rows with 0 in column valid are left out. {file}", err=True
        )
    return table


def _check_units(table: Table, columns: Sequence[str]) -> None:
    """Refuse a column whose name tells a unit that its values cannot have."""
    for name, other in zip(columns, reversed(columns), strict=True):
        if name.endswith("strain"):
            plausible_strain(table[name], other, table[other])
        elif name.endswith("_v"):
            plausible_voltage(table[name])


def _check_even(time_s: NDArray[np.float64], rate_hz: float | None, file: Path) -> None:
    """One line about the first gap or repeated time."""
    steps = np.diff(time_s)
    usual_s = float(np.median(steps)) if rate_hz is None else 1.0 / rate_hz
    uneven = np.flatnonzero(np.abs(steps - usual_s) > 0.5 * usual_s)
    if uneven.size == 0:
        return
    at = int(uneven[0])
    raise InputError(
        f"Column time_s goes on by {steps[at]:g} s after row {at + 1} ({uneven.size} such places); "
        f"allowed are even times, here {usual_s:g} s apart. Cut the file there and give the pieces "
        f"as several records: {file}"
    )


def rate_hz_of(table: Table, given: float | None, file: Path) -> float:
    """Rate of a table: as given, else as the file tells it; a contradiction is an `InputError`."""
    if table.left_out and table.rate_hz is None:
        raise InputError(
            f"Without the {table.left_out} rows that have 0 in column valid, the rows have no even "
            "times (column time_s). Cut the file there and give the parts as several records: "
            f"{file}"
        )
    if given is not None and 0.0 < given < float("inf"):
        rows = next(iter(table.columns.values())).size
        if table.rate_hz is not None:
            check_rate(given, table.rate_hz, rows, "the file's own rate", file)
        elif (time_s := times_in(file)) is not None:
            check_rate(given, time_axis(time_s, file).rate_hz, rows, "column time_s", file)
    rate_hz = table.rate_hz if given is None else given
    if rate_hz is None:
        raise InputError(
            "The file does not tell its rate. Give --rate-hz, add a line '# rate_hz = ...', "
            f"or add a column time_s: {file}"
        )
    if not 0.0 < rate_hz < float("inf"):
        raise InputError(f"--rate-hz = {rate_hz:g} Hz; allowed is above 0 Hz. Correct it.")
    return rate_hz
