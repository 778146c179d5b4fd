"""`haselab identify hyperelastic`, `regions`, `voltage-map` and `capacitance-map`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.columns import column_option, column_options, drive_of
from haselab.cli.common import INTEGER, REAL, actuator_option, answer_options
from haselab.cli.identify.actuator_maps import read_pairs, save_strain_map, save_voltage_map
from haselab.cli.identify.common import (
    CAPACITANCE,
    FILE,
    FILES,
    LOAD,
    MONITOR_SCALE,
    STRAIN,
    STRESS,
    STRETCH,
    VOLTAGE,
    emit_fit,
    read_quantities,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.statics.capacitance_map import CapacitanceMapFit, fit_capacitance_map
from haselab.identify.statics.columns import note_on_voltage
from haselab.identify.statics.hyperelastic import (
    HyperelasticFit,
    TensileTest,
    fit_hyperelastic_tests,
)
from haselab.identify.statics.regions import find_regions
from haselab.identify.statics.voltage_map import fit_voltage_map
from haselab.models import DEFORMATIONS, LAWS, Deformation
from haselab.models.actuator import ActuatorTables
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import read_table

__all__ = ["capacitance_map", "hyperelastic", "regions", "voltage_map"]

Floats = NDArray[np.float64]
_KINDS = {kind.replace("_", "-"): kind for kind in DEFORMATIONS}
_LOWEST = shared_option("--stretch-min", type=REAL, detail="Default: no limit.")
_HIGHEST = shared_option("--stretch-max", type=REAL, detail="Default: no limit.")


def _between(
    stretch: Floats, load: Floats, low: float | None, high: float | None, file: Path
) -> tuple[Floats, Floats]:
    """Stretch and load within the range of the options."""
    kept = np.ones(stretch.size, dtype=bool)
    kept &= stretch >= (-np.inf if low is None else low)
    kept &= stretch <= (np.inf if high is None else high)
    if not kept.any():
        raise InputError(
            f"The file has stretches from {stretch.min():g} to {stretch.max():g}, none of them "
            f"within --stretch-min and --stretch-max. Change these limits: {file}"
        )
    return stretch[kept], load[kept]


@click.command("hyperelastic")
@FILES
@column_option(STRETCH)
@column_option(STRESS)
@shared_option(
    "--model", type=click.Choice(["auto", *LAWS]), default="auto", show_default=True,
    metavar="LAW", detail=f"auto: the one that fits best; or {', '.join(LAWS)}.",
)  # fmt: skip
@_LOWEST
@_HIGHEST
@click.option(
    "--deformation",
    multiple=True,
    type=click.Choice(list(_KINDS)),
    help="State how the test deforms the sheet, once for all FILES or once for each. Default: "
    "prestretched with --prestretch, fixed-lateral with --lateral-stretch, else uniaxial.",
)
@click.option(
    "--lateral-stretch", type=REAL,
    help="State the stretch at which the width is clamped; 1 is pure shear. Default: not clamped.",
)  # fmt: skip
@click.option(
    "--prestretch", type=REAL,
    help="State the equibiaxial stretch before the test. The column of the stretch is 1 in this "
    "state. Default: none.",
)  # fmt: skip
@click.option(
    "--electrode-natural", type=REAL,
    help="Fit the spring of bonded electrodes too, which is free of force at this stretch. "
    "Default: no electrodes.",
)  # fmt: skip
@click.option("--electrode-stiffening", is_flag=True, help="Fit a cubic term of this spring too.")
@click.option(
    "--at-stretch", type=REAL, multiple=True,
    help="Compute the stress at this stretch. Repeat the option for more. Default: none.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def hyperelastic(
    files: tuple[Path, ...],
    model: str,
    stretch_min: float | None,
    stretch_max: float | None,
    electrode_natural: float | None,
    electrode_stiffening: bool,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **test: Any,
) -> None:
    """Fit a hyperelastic law to stretch and nominal stress.

    Several FILES are tests of one material, for example uniaxial, pure shear and equibiaxial. They
    are fitted together.
    """
    kinds = _deformations(len(files), test)
    tests = []
    for file, kind in zip(files, kinds, strict=True):
        wanted = {STRETCH: test["stretch_column"], STRESS: test["stress_column"]}
        stretch, stress = read_quantities(file, wanted, columns)
        stretch, stress = _between(stretch, stress, stretch_min, stretch_max, file)
        tests.append(TensileTest(stretch, stress, kind))
    fit = fit_hyperelastic_tests(
        tests, model, electrode_natural=electrode_natural, electrode_stiffening=electrode_stiffening
    )
    emit_fit(_WithStress(fit, np.asarray(test["at_stretch"])), files, as_json, out)
    save_plot(plot, fit.chart)


def _deformations(count: int, test: Mapping[str, Any]) -> list[Deformation]:
    """Kind of each file's test from the options."""
    lateral, prestretch = test["lateral_stretch"], test["prestretch"]
    implied = "prestretched" if prestretch else "fixed-lateral" if lateral else "uniaxial"
    kinds = list(test["deformation"]) or [implied]
    if len(kinds) not in (1, count):
        raise InputError(
            f"--deformation was given {len(kinds)} times for {count} files. Give it once, or once "
            "for each file in their order."
        )
    for kind, value, option in (
        ("fixed-lateral", lateral, "--lateral-stretch"),
        ("prestretched", prestretch, "--prestretch"),
    ):
        if (kind in kinds) != (value is not None):
            raise InputError(
                f"--deformation is {', '.join(kinds)} and {option} is {value}. Give {option} with "
                f"--deformation {kind}, and only with it."
            )
    made = [
        Deformation(
            _KINDS[kind],
            lateral_stretch=1.0 if lateral is None else lateral,
            prestretch=1.0 if prestretch is None else prestretch,
        )
        for kind in kinds
    ]
    return made * count if len(made) == 1 else made


@dataclass(frozen=True)
class _WithStress:
    """A fit whose answer includes the stress at given stretches."""

    fit: HyperelasticFit
    stretch: NDArray[np.float64]

    @property
    def status(self) -> str:
        return self.fit.status

    @property
    def succeeded(self) -> bool:
        return self.fit.succeeded

    def answer(self) -> dict[str, Any]:
        answer = self.fit.answer()
        if not self.stretch.size or not self.succeeded:
            return answer
        predicted = self.fit.predict(self.stretch)
        answer["asked"] = [
            {"stretch": float(x), "nominal_stress_pa": Estimate.normal(p, s, "Pa")}
            for x, p, s in zip(
                predicted.stretch, predicted.nominal_stress_pa, predicted.std_pa, strict=True
            )
        ]
        answer["notes"] = [*self.fit.notes, *predicted.notes]
        return answer


@click.command("regions")
@FILE
@column_option(STRETCH)
@column_option(LOAD)
@click.option(
    "--segments", type=INTEGER,
    help="Set the number of straight segments: at least 1, at most a third of the number of rows. "
    "Default: chosen by BIC, at most 6.",
)  # fmt: skip
@_LOWEST
@_HIGHEST
@column_options
@answer_options(plot=True)
def regions(
    file: Path,
    segments: int | None,
    stretch_min: float | None,
    stretch_max: float | None,
    stretch_column: str | None,
    load_column: str | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Find the linear regions of a force-stretch curve.

    The longest region comes first. FILE has the columns of stretch and force.
    """
    wanted = {STRETCH: stretch_column, LOAD: load_column}
    stretch, load_n = read_quantities(file, wanted, columns)
    stretch, load_n = _between(stretch, load_n, stretch_min, stretch_max, file)
    fit = find_regions(stretch, load_n, segments)
    emit_fit(fit, [file], as_json, out)
    save_plot(plot, fit.chart)


@click.command("voltage-map")
@FILE
@column_option(STRAIN)
@column_option(VOLTAGE)
@MONITOR_SCALE
@column_options
@actuator_option("The command writes [drive.voltage_map].")
@answer_options(plot=True)
def voltage_map(
    file: Path,
    strain_column: str | None,
    voltage_column: str | None,
    volt_per_monitor_volt: float | None,
    actuator: Path | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit the voltage as a function of strain.

    The map is a sum of two exponentials (eq. 4 of the paper). FILE has the columns of strain and
    voltage, in order of time.
    """
    known = None if actuator is None else load_actuator(actuator, to_write=True)
    strain, voltage_v = read_quantities(
        file, {STRAIN: strain_column, VOLTAGE: voltage_column}, columns, known
    )
    name = VOLTAGE.column(file, voltage_column)
    drive_v = drive_of(name, voltage_v, file, known, volt_per_monitor_volt)
    fit = fit_voltage_map(strain, drive_v)
    unknown = known is None or (known.drive.gain_v_per_v is None and known.drive.high_v is None)
    if fit.succeeded and unknown:
        fit = replace(fit, notes=(*fit.notes, *_voltage_notes(name, voltage_v, file, columns)))
    emit_fit(fit, [file], as_json, out, units={"hysteresis_width": "V"})
    if actuator is not None:
        save_voltage_map(actuator, fit, file)
    save_plot(plot, fit.chart)


def _voltage_notes(
    name: str, voltage_v: Floats, file: Path, columns: ColumnOptions
) -> tuple[str, ...]:
    """A note where neither the file nor the name of the column states the unit of the voltage."""
    notes = () if name.endswith("_v") else note_on_voltage(name, voltage_v)
    return notes if notes and read_table(file, [name], columns).units[name] is None else ()


@click.command("capacitance-map")
@FILE
@column_option(CAPACITANCE)
@column_option(STRAIN)
@click.option(
    "--strain-file", type=click.Path(path_type=Path),
    help="Read the strain from this file or session, recorded with the same clock. Default: FILE.",
)  # fmt: skip
@shared_option(
    "--experiment",
    detail="It selects what is read; needed if the session has several. Default: its only one.",
)
@column_options
@actuator_option("The command writes [sensing.strain_map]: the map from F, with its band.")
@answer_options(plot=True)
def capacitance_map(
    file: Path,
    capacitance_column: str | None,
    strain_column: str | None,
    strain_file: Path | None,
    actuator: Path | None,
    *,
    experiment: str | None,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit the strain as a function of capacitance.

    The map is a straight line (eq. 5 of the paper). FILE has the columns of capacitance and
    strain. The slope is per F for a capacitance in F, and per unit of relative capacitance
    otherwise. With --actuator, a polynomial of degree 1 to 3 is fitted and written; the line is
    then a comparison only.
    """
    known = None if actuator is None else load_actuator(actuator, to_write=True)
    files = [file] if strain_file is None else [file, strain_file]
    pairs = read_pairs(files, capacitance_column, strain_column, columns, known, experiment)
    fit = fit_capacitance_map(pairs.capacitance, pairs.strain)
    if pairs.in_farads and "slope" in fit.parameters:
        slope = replace(fit.parameters["slope"], unit="1/F")
        fit = replace(fit, parameters={**fit.parameters, "slope": slope})
    fit = replace(fit, notes=(*fit.notes, *_slope_notes(fit, known)))
    more: dict[str, object] = {}
    shown: dict[str, object] | None = None
    if actuator is not None and fit.succeeded:
        section = save_strain_map(actuator, pairs, files)
        found = {name: part for name, part in section.items() if part is not None}
        more, shown = {"strain_map": found}, _written(section, fit)
    emit_fit(fit, files, as_json, out, more, shown=shown)
    axis = "Capacitance (F)" if pairs.in_farads else "Capacitance (as in the file)"
    if pairs.column.startswith("relative"):
        axis = "Relative capacitance"
    save_plot(plot, lambda: fit.chart((axis, "Strain")))


def _written(section: Mapping[str, Any], fit: CapacitanceMapFit) -> dict[str, object]:
    """What the screen shows of a map that was written, with the line as a comparison only."""
    names = ("slope_per_f", "offset", "curvature_per_f2", "cubic_per_f3", "range_f")
    found = {name: section[name] for name in names if section.get(name) is not None}
    if section["band"] is not None:
        low, high = section["band"]
        found["band"] = (
            f"{100.0 * section['coverage']:.0f} % of strains within {low:+.2g} to {high:+.2g} of it"
        )
    line = (
        f"{fit.parameters['slope'].value:.4g} C {fit.parameters['offset'].value:+.4g}, r_squared "
        f"{fit.r_squared:.6g}"
    )
    answer = fit.answer()
    return {
        "[sensing.strain_map], written": found,
        "line, not written": line,
        "status": answer["status"],
        "notes": answer["notes"],
    }


def _slope_notes(fit: CapacitanceMapFit, known: ActuatorTables | None) -> tuple[str, ...]:
    """A note if the strain falls with the capacitance of a device that grows with it."""
    if known is None or known.actuator.kind != "planar-hasel" or not fit.succeeded:
        return ()
    if fit.parameters["slope"].ci95[1] >= 0.0:
        return ()
    return (
        "The strain falls as the capacitance rises, but a planar-hasel becomes longer as its "
        "capacitance rises. Check the sign of the strain and the columns. If the actuator is of "
        "another kind, state it: [actuator] kind.",
    )
