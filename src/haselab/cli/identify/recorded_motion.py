"""Sessions and tables as motions, which a physical model is fitted to or predicts."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.cli.columns import Quantity, check_strain, refuse_beyond_drive
from haselab.cli.common import warn_unverified
from haselab.cli.identify.common import rate_hz_of, read_valid, unit_text
from haselab.identify.physical import MotionRecord
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.motion import motion_of_session
from haselab.pipelines.motion_table import motion_of_table
from haselab.pipelines.time_axis import check_rising
from haselab.rig.protocols import PLANAR_HASEL
from haselab.store.columns.reader import open_archive
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import Table
from haselab.store.session.opening import is_session
from haselab.store.session.reader import SessionReader, session_file

__all__ = ["TableOptions", "motion_of_file"]

Floats = NDArray[np.float64]
_VOLTAGE = Quantity("--input", ("u", "voltage_v", "voltage"), "V", "the voltage")
_LENGTHS, _CAPACITANCE = ("y", "length_m", "strain"), "capacitance_f"
_TABLES = (".csv", ".txt", ".mat", ".npz", ".npy", ".tdms", ".xlsx")
_GAP = 1.5  # usual steps, from which rows may be missing
_ENDINGS = {"strain": "1", "_m": "m", "_f": "F"}


@dataclass(frozen=True)
class TableOptions:
    """What the user states about tables; a session states all of it itself.

    Args:
        source: column of the voltage; None: by its name.
        outputs: columns of what was measured; none: by their names.
        rate_hz: sampling rate; None: that of the file.
        mass_kg: hung mass; None: that of the actuator file.
        gain_v_per_v: of the amplifier; None: that of the actuator file.
        zero_length_m: length at zero strain; None: that of the actuator file.
        columns: what the user states about the columns.
        unused: units, m or F, of columns that are used only if `outputs` names them.
    """

    source: str | None
    outputs: tuple[str, ...]
    rate_hz: float | None
    mass_kg: float | None
    gain_v_per_v: float | None
    zero_length_m: float | None
    columns: ColumnOptions
    unused: frozenset[str] = frozenset()

    def refuse_for_session(self, file: Path) -> None:
        """Refuse these options for a session.

        Raises:
            InputError: one of them is given.
        """
        given = {
            "--mass-kg": self.mass_kg,
            "--gain-v-per-v": self.gain_v_per_v,
            "--zero-length-m": self.zero_length_m,
            "--input": self.source,
            "--output": self.outputs or None,
            "--rate-hz": self.rate_hz,
        }
        wrong = [name for name, value in given.items() if value is not None]
        if wrong:
            raise InputError(
                f"{', '.join(wrong)} is for tables, but a session states this itself. Leave it "
                f"out. {file}"
            )


def motion_of_file(
    file: Path,
    options: TableOptions,
    known: ActuatorTables,
    *,
    unverified: bool = False,
    std: Mapping[str, float] | None = None,
) -> tuple[MotionRecord, float]:
    """Read a session, a folder of a run or a table as one motion.

    Args:
        file: to read.
        options: what the user states about a table.
        known: the actuator file, for what the user does not state.
        unverified: read a session whose checksum does not match.
        std: standard deviation of measured values of a table, by their unit; None: estimated.
    Returns:
        The motion, and the gain of the amplifier in V/V.
    Raises:
        InputError: not readable, or something that the motion needs is not known.
    """
    _refuse_folder_of_tables(file)
    if file.is_dir() or is_session(file):
        options.refuse_for_session(file)
        with SessionReader(file, unverified=unverified) as reader:
            warn_unverified(reader.doubt, file)
            rig = reader.header["rig"]
            _warn_of_kind(rig.get("actuator_kind", PLANAR_HASEL), known.actuator.kind, file)
            gain_v_per_v = float(rig["amplifier_gain"])
            motion = motion_of_session(reader, session_file(file))
            # all sessions have the same file name, so messages quote the path that the user typed
            return replace(motion, name=str(file)), gain_v_per_v
    return _table(file, options, known, std or {})


def _refuse_folder_of_tables(folder: Path) -> None:
    if not folder.is_dir() or session_file(folder).exists():
        return
    tables = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in _TABLES)
    if tables:
        raise InputError(
            f"This folder has no session.h5, but {len(tables)} files such as {tables[0]}. If they "
            f"are tables, name each: {folder / tables[0]}"
        )


def _warn_of_kind(recorded: str, stated: str, file: Path) -> None:
    if recorded != stated:
        click.echo(
            f"haselab: warning: the rig of this session states a {recorded}, but [actuator] kind "
            f"is {stated}. File: {file}",
            err=True,
        )


def _table(
    file: Path, options: TableOptions, known: ActuatorTables, std: Mapping[str, float]
) -> tuple[MotionRecord, float]:
    source = _VOLTAGE.column(file, options.source)
    outputs = list(options.outputs) or _usual_outputs(file, options.unused)
    table = read_valid(file, (source, *outputs), options.columns, may_lack=outputs)
    stated = table.units[source]
    if stated is not None and stated.si != "V":
        raise InputError(
            f"Column {source} is {unit_text(stated.si)}, but the physical model needs a voltage. "
            f"Name its column with --input. {file}"
        )
    time_s = table.time_s
    if time_s is None or options.rate_hz is not None:
        time_s = np.arange(table[source].size) / rate_hz_of(table, options.rate_hz, file)
    check_rising(time_s, file, table.time_name or "time_s")
    _warn_of_gaps(time_s, file)
    mass_kg = options.mass_kg if options.mass_kg is not None else known.actuator.mass_kg
    if mass_kg is None:
        raise InputError(
            "The hung mass of this table is not known. State it with --mass-kg, or add mass_kg to "
            f"[actuator]. {file}"
        )
    gain_v_per_v = options.gain_v_per_v or known.drive.gain_v_per_v
    if gain_v_per_v is None:
        raise InputError(
            f"The gain from column {source} to the actuator's voltage is not known. State it with "
            "--gain-v-per-v (1 if the column is the voltage of the actuator), or add gain_v_per_v "
            f"to [drive]. {file}"
        )
    if known.drive.gain_v_per_v is not None:
        drive_v = table[source] * (gain_v_per_v / known.drive.gain_v_per_v)
        refuse_beyond_drive(source, drive_v, file, known, scale="--gain-v-per-v S")
    measured: dict[str, Floats] = {}
    for output in outputs:
        if np.isnan(table[output]).all():
            raise InputError(
                f"Column {output} has no values. Name another one with --output. {file}"
            )
        si, values = _values(table, output, options, known, file)
        if si in measured:
            raise InputError(
                f"--output names two columns {unit_text(si)}, but a motion has one. Leave out "
                f"{output}. {file}"
            )
        measured[si] = values
    record = motion_of_table(
        file.name, time_s, gain_v_per_v * table[source], mass_kg=mass_kg,
        length_m=measured.get("m"), capacitance_f=measured.get("F"),
        length_std_m=std.get("m"), capacitance_std_f=std.get("F"),
    )  # fmt: skip
    return record, gain_v_per_v


def _usual_outputs(file: Path, unused: Collection[str]) -> list[str]:
    """The column of the lengths and that of the capacitances, as far as a file has them."""
    with open_archive(file) as archive:
        found = [name for name in (*_LENGTHS, _CAPACITANCE) if archive.locate(name) is not None]
    length = next((name for name in found if name in _LENGTHS), None)
    if length is None or length == _LENGTHS[0]:  # y can be either
        return found[:1] or [_LENGTHS[0]]
    both = [length, *found[-1:]] if found[-1] == _CAPACITANCE else [length]
    wanted = [name for name in both if ("F" if name == _CAPACITANCE else "m") not in unused]
    return wanted or both[:1]


def _warn_of_gaps(time_s: Floats, file: Path) -> None:
    steps_s = np.diff(time_s)
    if steps_s.size and (long := steps_s > _GAP * np.median(steps_s)).any():
        at = int(steps_s.argmax())
        click.echo(
            f"haselab: warning: {long.sum()} steps of the times are longer than the usual "
            f"{np.median(steps_s):g} s, the longest is {steps_s[at]:g} s, after row {at + 1}. The "
            "voltage before a step is assumed to act until its end. If the voltage changed, add "
            f"these rows with it; what was not measured may be empty (nan). File: {file}",
            err=True,
        )


def _values(
    table: Table, output: str, options: TableOptions, known: ActuatorTables, file: Path
) -> tuple[str, Floats]:
    """Unit, m or F, and values of a measured column."""
    values, unit = table[output], table.units[output]
    si = unit.si if unit is not None else _unit_of_name(output)
    if si == "1":
        check_strain(output, values, unit, file, known)
        zero_m = options.zero_length_m or known.actuator.geometry.zero_length_m
        if zero_m is None:
            raise InputError(
                f"Column {output} is a strain, but the length at zero strain is not known. State "
                f"it with --zero-length-m, or add zero_length_m to [actuator.geometry]. {file}"
            )
        values, si = zero_m * (1.0 + values), "m"
    if si not in ("m", "F"):
        raise InputError(
            f"Column {output} is {unit_text(si) if si else 'without a unit'}, but the physical "
            "model has lengths, strains and capacitances. Name one with --output, or state "
            f"the unit with --unit. {file}"
        )
    return si, values


def _unit_of_name(name: str) -> str:
    return next((si for ending, si in _ENDINGS.items() if name.endswith(ending)), "")
