"""Fit and write the maps of an actuator file: capacitance to strain, strain to voltage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.cli.actuator_file import save_section
from haselab.cli.columns import check_strain, check_unit
from haselab.cli.identify.common import CAPACITANCE, STRAIN, read_valid
from haselab.identify.statics.voltage_map import VoltageMapFit
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.actuator.tables import strain_map_section, voltage_map_section
from haselab.sensing.strain import fit_strain_map
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import Table

__all__ = ["Pairs", "read_pairs", "save_strain_map", "save_voltage_map"]

_LEAST_ROWS = 32

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pairs:
    """Capacitance and strain at the same times, in order of time.

    Args:
        capacitance: in F, or relative. Shape `(N,)`.
        strain: shape `(N,)`.
        column: of the capacitance.
        in_farads: whether the file, or the name of the column, states the unit F.
    """

    capacitance: Floats
    strain: Floats
    column: str
    in_farads: bool


def read_pairs(
    files: Sequence[Path],
    capacitance_column: str | None,
    strain_column: str | None,
    columns: ColumnOptions,
    known: ActuatorTables | None = None,
) -> Pairs:
    """Read capacitances and strains from one file, or from two with the same clock.

    Args:
        files: the one with the capacitance, and the one with the strain if it is another one.
        capacitance_column: that the user named, or None.
        strain_column: that the user named, or None.
        columns: what the user states about the columns.
        known: the actuator's file, with which strains are compared.
    Returns:
        Both; rows outside the other file's times are left out.
    Raises:
        InputError: a column is missing, its unit belongs to another quantity, strains without a
            unit are probably in per cent, or the times of the files hardly overlap.
    """
    file, strain_file = files[0], files[-1]
    name = CAPACITANCE.column(file, capacitance_column)
    strain_name = STRAIN.column(strain_file, strain_column)
    options = [CAPACITANCE.option, STRAIN.option]
    if len(files) == 1:
        table = other = read_valid(file, [name, strain_name], columns, options)
        capacitance, strain = table[name], table[strain_name]
    else:
        table = read_valid(file, [name], columns, options[:1])
        other = read_valid(strain_file, [strain_name], columns, options[1:])
        time_s = _times(table, file, columns)
        known_s = _times(other, strain_file, columns)
        inside = _common(time_s, known_s, file, strain_file)
        capacitance = table[name][inside]
        strain = np.interp(time_s[inside], known_s, other[strain_name])
    unit = table.units[name]
    strain_unit = other.units[strain_name]
    check_unit(strain_name, strain_unit, STRAIN, strain_file)
    check_strain(strain_name, other[strain_name], strain_unit, strain_file, known)
    in_farads = name == "capacitance_f" if unit is None else unit.si == "F"
    return Pairs(capacitance, strain, name, in_farads)


def _times(table: Table, file: Path, columns: ColumnOptions) -> Floats:
    """The column of times, even if the file also states its rate."""
    if table.time_s is not None:
        return table.time_s
    name = columns.time or "time_s"
    return read_valid(file, [name], columns, ["--time"])[name]


def _common(time_s: Floats, known_s: Floats, file: Path, strain_file: Path) -> NDArray[np.bool_]:
    """Select the rows within the times of the strain."""
    if not (np.diff(known_s) > 0.0).all():
        raise InputError(f"The times do not increase everywhere. Sort the rows: {strain_file}")
    inside = (time_s >= known_s[0]) & (time_s <= known_s[-1])
    if inside.sum() < _LEAST_ROWS:
        raise InputError(
            f"Only {int(inside.sum())} rows of {file} lie within the times of the strain, "
            f"{known_s[0]:g} to {known_s[-1]:g} s, but {_LEAST_ROWS} are needed. Record both with "
            f"one clock: {strain_file}"
        )
    return np.asarray(inside, dtype=np.bool_)


def save_strain_map(actuator: Path, pairs: Pairs, files: Sequence[Path]) -> Mapping[str, object]:
    """Fit the map that loops use, and write `[sensing.strain_map]`.

    Args:
        actuator: the actuator file.
        pairs: capacitance and strain, in order of time.
        files: that were read.
    Returns:
        The section.
    Raises:
        InputError: the capacitance is not in F, or there are too few rows.
        ResultError: the strain does not follow the capacitance, or the map turns.
    """
    if not pairs.in_farads:
        raise InputError(
            "--actuator needs the capacitance in F, as in the column capacitance_f of haselab "
            f"sense, but {pairs.column} states no such unit. Name another column with "
            f"--capacitance, or state its unit with --unit: {files[0]}"
        )
    section = strain_map_section(fit_strain_map(pairs.capacitance, pairs.strain))
    fields = StrainMap.__dataclass_fields__
    save_section(actuator, "sensing.strain_map", section, files, list(fields))
    return section


def save_voltage_map(actuator: Path, fit: VoltageMapFit, file: Path) -> None:
    """Write `[drive.voltage_map]`."""
    section = voltage_map_section(fit.map)
    save_section(actuator, "drive.voltage_map", section, [file], list(section))
