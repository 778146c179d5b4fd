"""`haselab identify hyperelastic`, `regions`, `voltage-map` and `capacitance-map`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.columns import column_option, column_options
from haselab.cli.common import INTEGER, REAL, actuator_option, answer_options
from haselab.cli.identify.actuator_maps import read_pairs, save_strain_map, save_voltage_map
from haselab.cli.identify.common import (
    CAPACITANCE,
    FILE,
    FILES,
    LOAD,
    STRAIN,
    STRESS,
    STRETCH,
    VOLTAGE,
    give,
    read_quantities,
)
from haselab.cli.plot import save_plot
from haselab.identify.statics.capacitance_map import fit_capacitance_map
from haselab.identify.statics.hyperelastic import HyperelasticFit, SheetTest, fit_hyperelastic_tests
from haselab.identify.statics.regions import find_regions
from haselab.identify.statics.voltage_map import fit_voltage_map
from haselab.models import DEFORMATIONS, LAWS, Deformation
from haselab.store.columns.selection import ColumnOptions

__all__ = ["capacitance_map", "hyperelastic", "regions", "voltage_map"]

Floats = NDArray[np.float64]
_KINDS = {kind.replace("_", "-"): kind for kind in DEFORMATIONS}
_LOWEST = click.option("--stretch-min", type=REAL, help="Leave out lower stretches.")
_HIGHEST = click.option("--stretch-max", type=REAL, help="Leave out higher stretches.")


def _between(
    stretch: Floats, load: Floats, low: float | None, high: float | None, file: Path
) -> tuple[Floats, Floats]:
    """Stretch and load inside the asked range."""
    kept = np.ones(stretch.size, dtype=bool)
    kept &= stretch >= (-np.inf if low is None else low)
    kept &= stretch <= (np.inf if high is None else high)
    if not kept.any():
        raise InputError(
            f"No stretch of the file lies in the asked range; it has [{stretch.min():g}, "
            f"{stretch.max():g}]. Widen --stretch-min and --stretch-max: {file}"
        )
    return stretch[kept], load[kept]


@click.command("hyperelastic")
@FILES
@column_option(STRETCH)
@column_option(STRESS)
@click.option("--model", type=click.Choice(["auto", *LAWS]), default="auto", show_default=True)
@_LOWEST
@_HIGHEST
@click.option(
    "--deformation",
    multiple=True,
    type=click.Choice(list(_KINDS)),
    help="What the test does to the width; once for all FILES, or once for each.",
)
@click.option(
    "--lateral-stretch", type=REAL, help="The width is clamped at this stretch; 1 is pure shear."
)
@click.option(
    "--prestretch", type=REAL, help="Both ways, before the test; stretch counts from there."
)
@click.option("--electrode-natural", type=REAL, help="Fit electrodes too, natural at this stretch.")
@click.option("--electrode-stiffening", is_flag=True, help="Fit their cubic term too.")
@click.option("--at-stretch", type=REAL, multiple=True, help="Tell the stress here; repeat it.")
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
    """Hyperelastic law from the columns of stretch and nominal stress.

    Several FILES are tests of one material, for example uniaxial, pure shear and equibiaxial; they
    are fitted together.
    """
    kinds = _deformations(len(files), test)
    tests = []
    for file, kind in zip(files, kinds, strict=True):
        wanted = {STRETCH: test["stretch_column"], STRESS: test["stress_column"]}
        stretch, stress = read_quantities(file, wanted, columns)
        stretch, stress = _between(stretch, stress, stretch_min, stretch_max, file)
        tests.append(SheetTest(stretch, stress, kind))
    fit = fit_hyperelastic_tests(
        tests, model, electrode_natural=electrode_natural, electrode_stiffening=electrode_stiffening
    )
    give(_Asked(fit, np.asarray(test["at_stretch"])), files, as_json, out)
    save_plot(plot, fit.chart)


def _deformations(count: int, test: Mapping[str, Any]) -> list[Deformation]:
    """Kind of each file's test from the options."""
    lateral, prestretch = test["lateral_stretch"], test["prestretch"]
    implied = "prestretched" if prestretch else "fixed-lateral" if lateral else "uniaxial"
    kinds = list(test["deformation"]) or [implied]
    if len(kinds) not in (1, count):
        raise InputError(
            f"--deformation was given {len(kinds)} times for {count} files; allowed is once, or "
            "once for each file in their order. Correct the options."
        )
    for kind, value, option in (
        ("fixed-lateral", lateral, "--lateral-stretch"),
        ("prestretched", prestretch, "--prestretch"),
    ):
        if (kind in kinds) != (value is not None):
            raise InputError(
                f"--deformation = {', '.join(kinds)}, {option} = {value}; allowed is {option} with "
                f"{kind} and only with it. Correct the options."
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
class _Asked:
    """A fit, and the stress that was asked of it."""

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
        told = self.fit.predict(self.stretch)
        answer["asked"] = [
            {"stretch": float(x), "nominal_stress_pa": Estimate.normal(p, s, "Pa")}
            for x, p, s in zip(told.stretch, told.nominal_stress_pa, told.std_pa, strict=True)
        ]
        answer["notes"] = [*answer["notes"], *told.notes]
        return answer


@click.command("regions")
@FILE
@column_option(STRETCH)
@column_option(LOAD)
@click.option("--pieces", type=INTEGER, help="Number of pieces; chosen by BIC when not given.")
@_LOWEST
@_HIGHEST
@column_options
@answer_options(plot=True)
def regions(
    file: Path,
    pieces: int | None,
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
    """Linear regions, the longest first, from the columns of stretch and force."""
    wanted = {STRETCH: stretch_column, LOAD: load_column}
    stretch, load_n = read_quantities(file, wanted, columns)
    stretch, load_n = _between(stretch, load_n, stretch_min, stretch_max, file)
    fit = find_regions(stretch, load_n, pieces)
    give(fit, [file], as_json, out)
    save_plot(plot, fit.chart)


@click.command("voltage-map")
@FILE
@column_option(STRAIN)
@column_option(VOLTAGE)
@column_options
@actuator_option("[drive.voltage_map] is written.")
@answer_options(plot=True)
def voltage_map(
    file: Path,
    strain_column: str | None,
    voltage_column: str | None,
    actuator: Path | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Voltage from strain (eq. 4) from the columns of strain and voltage, in order of time."""
    if actuator is not None:
        load_actuator(actuator)
    strain, voltage_v = read_quantities(
        file, {STRAIN: strain_column, VOLTAGE: voltage_column}, columns
    )
    fit = fit_voltage_map(strain, voltage_v)
    give(fit, [file], as_json, out)
    if actuator is not None:
        save_voltage_map(actuator, fit, file)
    save_plot(plot, fit.chart)


@click.command("capacitance-map")
@FILE
@column_option(CAPACITANCE)
@column_option(STRAIN)
@click.option(
    "--strain-file", type=click.Path(path_type=Path),
    help="Take the strain from this file, whose times are by the same clock.",
)  # fmt: skip
@column_options
@actuator_option("[sensing.strain_map] is written: the map in F with its band.")
@answer_options(plot=True)
def capacitance_map(
    file: Path,
    capacitance_column: str | None,
    strain_column: str | None,
    strain_file: Path | None,
    actuator: Path | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Strain from capacitance (eq. 5) from the columns of capacitance and strain.

    A capacitance in F gives a slope per F, relative capacitance a slope per its unit.
    """
    if actuator is not None:
        load_actuator(actuator)
    files = [file] if strain_file is None else [file, strain_file]
    pairs = read_pairs(files, capacitance_column, strain_column, columns)
    fit = fit_capacitance_map(pairs.capacitance, pairs.strain)
    more: dict[str, object] = {}
    if actuator is not None and fit.succeeded:
        section = save_strain_map(actuator, pairs, files)
        more = {"strain_map": {name: part for name, part in section.items() if part is not None}}
    give(fit, files, as_json, out, more)
    save_plot(plot, fit.chart)
