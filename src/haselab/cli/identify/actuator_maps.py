"""Fit and write the maps of an actuator file: capacitance to strain, strain to voltage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.cli.actuator_file import save_section
from haselab.cli.columns import options_of_each, strains_of
from haselab.cli.identify.common import CAPACITANCE, STRAIN, name_files_in_errors, read_valid
from haselab.identify.statics.columns import plausible_capacitance
from haselab.identify.statics.voltage_map import VoltageMapFit
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.actuator.tables import strain_map_section, voltage_map_section
from haselab.pipelines.sensing.series import derived_series
from haselab.sensing.strain import fit_strain_map
from haselab.store.columns.selection import ColumnOptions, check_assumed_seconds
from haselab.store.columns.table import Table
from haselab.store.session.opening import is_session
from haselab.store.session.reader import SessionReader, session_file

__all__ = ["Pairs", "read_pairs", "save_strain_map", "save_voltage_map"]

_LEAST_ROWS = 32
_KEPT = ("feedthrough", "feedthrough_std")  # a new map does not determine them
_FEW = 0.05  # share of the samples, and of the strains, that a limited map may leave out unnoticed

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
    experiment: str | None = None,
) -> Pairs:
    """Read capacitances and strains from one file, or from two with the same clock.

    Args:
        files: the one with the capacitance, and the one with the strain if it is another one.
        capacitance_column: that the user named, or None.
        strain_column: that the user named, or None.
        columns: what the user states about the columns.
        known: the actuator's file, with which strains are compared.
        experiment: of a session that has the strain; None: its only one.
    Returns:
        Both; rows outside the other file's times are left out.
    Raises:
        InputError: a column is missing, its unit belongs to another quantity, times or strains
            without a unit are probably in another one, or the times of the files hardly overlap.
    """
    file, strain_file = files[0], files[-1]
    name = CAPACITANCE.column(file, capacitance_column)
    if len(files) == 2 and (strain_file.is_dir() or is_session(strain_file)):
        table = read_valid(file, [name], columns, [CAPACITANCE.option])
        time_s = _times(table, file, columns)
        known_s, strains = _strain_of_session(strain_file, experiment, known)
        inside = _common(time_s, known_s, file, strain_file)
        strain = np.interp(time_s[inside], known_s, strains)
        return Pairs(table[name][inside], strain, name, _in_farads(table, name))
    if experiment is not None:
        raise InputError(
            f"--experiment is for a session as --strain-file, but this is a table. Leave it out. "
            f"{strain_file}"
        )
    strain_name = STRAIN.column(strain_file, strain_column)
    options = [CAPACITANCE.option, STRAIN.option]
    if len(files) == 1:
        table = other = read_valid(file, [name, strain_name], columns, options)
    else:
        own, others = options_of_each(files, columns)
        table = read_valid(file, [name], own, options[:1])
        other = read_valid(strain_file, [strain_name], others, options[1:])
    strain = strains_of(
        strain_name, other[strain_name], other.units[strain_name], strain_file, known
    )
    capacitance = table[name]
    if len(files) == 2:
        time_s = _times(table, file, own)
        known_s = _times(other, strain_file, others)
        inside = _common(time_s, known_s, file, strain_file)
        capacitance = capacitance[inside]
        strain = np.interp(time_s[inside], known_s, strain)
    if in_farads := _in_farads(table, name):
        with name_files_in_errors(file):
            plausible_capacitance(name, capacitance)
    return Pairs(capacitance, strain, name, in_farads)


def _in_farads(table: Table, name: str) -> bool:
    unit = table.units[name]
    return name == "capacitance_f" if unit is None else unit.si == "F"


def _strain_of_session(
    path: Path, experiment: str | None, known: ActuatorTables | None
) -> tuple[Floats, Floats]:
    """Times and strains of the frames of an experiment."""
    zero_m = None if known is None else known.actuator.geometry.zero_length_m
    with SessionReader(session_file(path)) as reader:
        if experiment is None and len(reader.names) != 1:
            raise InputError(
                f"The session has the experiments {', '.join(reader.names)}. Name the one that "
                f"shows the strain with --experiment. {path}"
            )
        name = experiment or reader.names[0]
        if name not in reader.names:
            raise InputError(
                f"The session has no experiment {name!r}, only {', '.join(reader.names)}. {path}"
            )
        stated = reader.states("rig", "zero_length_px")
        seen = derived_series(reader, name, zero_length_m=None if stated else zero_m).get("strain")
    if seen is None or "strain" not in seen:
        raise InputError(
            f"The experiment {name!r} has {'no tracks' if seen is None else 'no zero strain'}. "
            "Import it with --strain, or with --length and --zero-length-m; for a run, add "
            f"zero_length_m to [actuator.geometry] of the actuator file. {path}"
        )
    good = np.isfinite(seen["strain"])
    return seen["time_s"][good], seen["strain"][good]


def _times(table: Table, file: Path, columns: ColumnOptions) -> Floats:
    """The column of times, even if the file also states its rate."""
    if table.time_s is not None:
        if table.assumed_seconds and (whole_s := float(np.ptp(table.time_s))) > 0.0:
            rate_hz = (table.time_s.size - 1) / whole_s
            check_assumed_seconds(table.time_name or "time_s", rate_hz, file)
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
    found = fit_strain_map(pairs.capacitance, pairs.strain)
    if found.limits_f is not None and found.range_f is not None:
        c, e = pairs.capacitance, pairs.strain
        low_f, high_f = found.range_f
        inside = (c >= low_f) & (c <= high_f)
        beyond = float(np.mean(~inside))
        few = beyond < _FEW and np.ptp(e[inside]) > (1.0 - _FEW) * np.ptp(e)
        why = (
            f"in the {100.0 * beyond:.2g} % of the samples outside, the strain hardly changes: "
            "noise of the capacitance, or a strain that has reached its end"
            if few
            else "no line, parabola or cubic follows the strain over the whole record, which "
            "hardly changes with the capacitance there, or turns"
        )
        click.echo(
            f"haselab: the map is limited to {1e12 * low_f:.4g} to {1e12 * high_f:.4g} pF of "
            f"{1e12 * c.min():.4g} to {1e12 * c.max():.4g} pF: {why}. File: {files[0]}",
            err=True,
        )
    section = strain_map_section(found)
    fields = [name for name in StrainMap.__dataclass_fields__ if name not in _KEPT]
    save_section(actuator, "sensing.strain_map", section, files, fields)
    return section


def save_voltage_map(actuator: Path, fit: VoltageMapFit, file: Path) -> None:
    """Write `[drive.voltage_map]`."""
    section = voltage_map_section(fit.map)
    save_section(actuator, "drive.voltage_map", section, [file], list(section))
