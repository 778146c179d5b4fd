"""`haselab identify hyperelastic`, `regions`, `voltage-map` and `capacitance-map`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.app.common import answer_options
from haselab.app.identify_common import FILE, give
from haselab.base import InputError
from haselab.identify.capacitance_map import fit_capacitance_map
from haselab.identify.hyperelastic import fit_hyperelastic
from haselab.identify.regions import find_regions
from haselab.identify.voltage_map import fit_voltage_map
from haselab.models import LAWS
from haselab.store.tables import Table, read_table

__all__ = ["capacitance_map", "hyperelastic", "regions", "voltage_map"]

_LOWEST = click.option("--stretch-min", type=float, help="Leave out lower stretches.")
_HIGHEST = click.option("--stretch-max", type=float, help="Leave out higher stretches.")


def _between(
    table: Table, load: str, low: float | None, high: float | None, file: Path
) -> tuple[Any, Any]:
    """Stretch and load inside the asked range."""
    stretch = table["stretch"]
    kept = np.ones(stretch.size, dtype=bool)
    kept &= stretch >= (-np.inf if low is None else low)
    kept &= stretch <= (np.inf if high is None else high)
    if not kept.any():
        raise InputError(
            f"No stretch of the file lies in the asked range; it has [{stretch.min():g}, "
            f"{stretch.max():g}]. Widen --stretch-min and --stretch-max: {file}"
        )
    return stretch[kept], table[load][kept]


@click.command("hyperelastic")
@FILE
@click.option("--model", type=click.Choice(["auto", *LAWS]), default="auto", show_default=True)
@_LOWEST
@_HIGHEST
@click.option(
    "--lateral-stretch", type=float, help="The width is clamped at this stretch; 1 is pure shear."
)
@click.option(
    "--electrode-natural", type=float, help="Fit electrodes too, natural at this stretch."
)
@answer_options
def hyperelastic(
    file: Path,
    model: str,
    stretch_min: float | None,
    stretch_max: float | None,
    lateral_stretch: float | None,
    electrode_natural: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Hyperelastic law from the columns stretch and nominal_stress_pa."""
    table = read_table(file, ["stretch", "nominal_stress_pa"])
    stretch, stress_pa = _between(table, "nominal_stress_pa", stretch_min, stretch_max, file)
    fit = fit_hyperelastic(
        stretch,
        stress_pa,
        model,
        deformation="uniaxial" if lateral_stretch is None else "fixed_lateral",
        lateral_stretch=1.0 if lateral_stretch is None else lateral_stretch,
        electrode_natural=electrode_natural,
    )
    give(fit, [file], as_json, out)


@click.command("regions")
@FILE
@click.option("--pieces", type=int, help="Number of pieces; chosen by BIC when not given.")
@_LOWEST
@_HIGHEST
@answer_options
def regions(
    file: Path,
    pieces: int | None,
    stretch_min: float | None,
    stretch_max: float | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Linear regions, the longest first, from the columns stretch and load_n."""
    table = read_table(file, ["stretch", "load_n"])
    stretch, load_n = _between(table, "load_n", stretch_min, stretch_max, file)
    give(find_regions(stretch, load_n, pieces), [file], as_json, out)


@click.command("voltage-map")
@FILE
@answer_options
def voltage_map(file: Path, *, as_json: bool, out: Path | None) -> None:
    """Voltage from strain (eq. 4) from the columns strain and voltage_v, in order of time."""
    table = read_table(file, ["strain", "voltage_v"])
    give(fit_voltage_map(table["strain"], table["voltage_v"]), [file], as_json, out)


@click.command("capacitance-map")
@FILE
@answer_options
def capacitance_map(file: Path, *, as_json: bool, out: Path | None) -> None:
    """Strain from capacitance (eq. 5) from the columns relative_capacitance and strain."""
    table = read_table(file, ["relative_capacitance", "strain"])
    give(fit_capacitance_map(table["relative_capacitance"], table["strain"]), [file], as_json, out)
