"""The maps of an actuator file from records: capacitance to strain, strain to voltage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from haselab.base import InputError
from haselab.cli.actuator_file import save_section
from haselab.cli.identify.common import read_valid
from haselab.identify.statics.voltage_map import VoltageMapFit
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.actuator.tables import strain_map_section, voltage_map_section
from haselab.sensing.strain import fit_strain_map
from haselab.store.columns.table import Table, read_table

__all__ = ["farads", "save_strain_map", "save_voltage_map", "with_strain"]

_LEAST_ROWS = 32


def farads(file: Path) -> str:
    """The column of capacitance: in F, or the relative one where there is no other."""
    try:
        read_table(file, ["capacitance_f"])
    except InputError:
        return "relative_capacitance"
    return "capacitance_f"


def with_strain(file: Path, column: str, strain_file: Path) -> Table:
    """Capacitances with the strain of another file at the same times.

    Args:
        file: of `haselab sense`: capacitance and `time_s`.
        column: of the capacitance.
        strain_file: columns `time_s` and `strain`, by the same clock.
    Returns:
        Both columns; rows outside of the other file's times are left out.
    Raises:
        InputError: a column is missing, or the files have hardly any time in common.
    """
    table = read_valid(file, [column, "time_s"])
    other = read_valid(strain_file, ["strain", "time_s"])
    time_s, known_s = table["time_s"], other["time_s"]
    if not (np.diff(known_s) > 0.0).all():
        raise InputError(f"Column time_s does not rise everywhere. Sort the rows: {strain_file}")
    inside = (time_s >= known_s[0]) & (time_s <= known_s[-1])
    if inside.sum() < _LEAST_ROWS:
        raise InputError(
            f"Only {int(inside.sum())} rows of {file} lie within the times of the strain, "
            f"{known_s[0]:g} to {known_s[-1]:g} s, but {_LEAST_ROWS} are needed. Record both by "
            f"one clock: {strain_file}"
        )
    strain = np.interp(time_s[inside], known_s, other["strain"])
    return replace(table, columns={column: table[column][inside], "strain": strain})


def save_strain_map(
    actuator: Path, table: Table, column: str, files: Sequence[Path]
) -> Mapping[str, object]:
    """Fit the map that loops use, and write `[sensing.strain_map]`.

    Args:
        actuator: the actuator file.
        table: capacitance and strain, in order of time.
        column: of the capacitance.
        files: that were read.
    Returns:
        The section.
    Raises:
        InputError: the capacitance is not in F, or too few rows.
        ResultError: the strain does not rise with the capacitance.
    """
    if column != "capacitance_f":
        raise InputError(
            "--actuator needs a column capacitance_f, in F, as haselab sense writes it. Name a "
            f"file with one: {files[0]}"
        )
    section = strain_map_section(fit_strain_map(table[column], table["strain"]))
    fields = StrainMap.__dataclass_fields__
    save_section(actuator, "sensing.strain_map", section, files, list(fields))
    return section


def save_voltage_map(actuator: Path, fit: VoltageMapFit, file: Path) -> None:
    """Write `[drive.voltage_map]`."""
    section = voltage_map_section(fit.map)
    save_section(actuator, "drive.voltage_map", section, [file], list(section))
