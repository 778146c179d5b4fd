"""Static load test: effective Arruda-Boyce law, linear regions, operating point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, ResultError
from haselab.identify.hyperelastic import HyperelasticFit, fit_hyperelastic
from haselab.identify.regions import Region, find_regions
from haselab.rig import RigDescription
from haselab.study.definition import LEAST_LOADS, Study
from haselab.study.observe import Observation
from haselab.study.resolution import POSITION_PX, with_resolution

__all__ = ["Static", "fit_static"]

_GRAVITY_M_S2 = 9.81


Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Static:
    """What the static load test gives.

    Args:
        free_length_m: between the clamps without load.
        quantities: results by id.
        notes: by id, what the reader should know.
        figures: section of analysis.json.
    """

    free_length_m: float
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: dict[str, Any]


def fit_static(
    seen: Observation, study: Study, rig: RigDescription, zero_length_m: float
) -> Static:
    """Load against elongation of the whole actuator.

    The stretch is told from the free length: at it, the shell is stretched by 1/sqrt(lateral).

    Args:
        seen: the static load test.
        study: number of straight pieces, operating point.
        rig: cross-section and lateral stretch of the shell.
        zero_length_m: length at zero strain, for the operating point.
    Returns:
        Results S16 and S17, data for figure 4.
    Raises:
        ResultError: fewer than seven loads were seen, or the law could not be fitted.
    Source: reference study, rows S16 to S18.
    """
    masses_kg = np.unique(seen.mass_kg)
    if masses_kg.size < LEAST_LOADS:
        raise ResultError(
            f"{masses_kg.size} loads in the static test; at least {LEAST_LOADS} are needed."
        )
    levels = [seen.mass_kg == mass for mass in masses_kg]
    length_m = np.array([seen.length_m[level].mean() for level in levels])
    load_n = masses_kg * _GRAVITY_M_S2
    free_length_m = float(length_m[0])
    stretch = length_m / free_length_m
    shell_stretch = stretch / np.sqrt(rig.lateral_stretch)
    law = fit_hyperelastic(
        shell_stretch[1:],
        load_n[1:] / rig.shell_area_m2,
        "arruda-boyce-series",
        deformation="fixed_lateral",
        lateral_stretch=rig.lateral_stretch,
        electrode_natural=1.0 / np.sqrt(rig.lateral_stretch),
    )
    if not law.succeeded:
        raise ResultError(f"Static load test: {law.status}")
    regions = find_regions(stretch, load_n, pieces=study.static_load.pieces)
    chosen = regions.regions[regions.chosen]
    grid = np.linspace(1.0, stretch[-1], 150)
    point = zero_length_m / free_length_m
    inside = chosen.low.value <= point <= chosen.high.value
    finest = POSITION_PX * rig.scale_m_per_px / free_length_m
    return Static(
        free_length_m=free_length_m,
        quantities={
            "S16.mu": law.best.estimates["mu_pa"],
            "S16.lambda_m": law.best.estimates["lambda_m"],
            "S17.region_low": with_resolution(chosen.low, finest * chosen.low.value),
            "S17.region_high": with_resolution(chosen.high, finest * chosen.high.value),
        },
        notes={
            "S16.mu": "of the shell, the electrodes' spring fitted beside it",
            "S17.region_high": f"operating point at stretch {point:.3f}, "
            f"{'inside' if inside else 'outside'} the longest linear region",
        },
        figures={
            "static": {
                "stretch": stretch,
                "load_n": load_n,
                "load_std_n": np.zeros_like(load_n),
                "fit_stretch": grid,
                "fit_load_n": _fitted_load_n(law, grid, rig),
                "regions": [
                    {
                        "stretch": [r.low.value, r.high.value],
                        "load_n": _line(r, stretch, load_n - regions.residuals),
                    }
                    for r in regions.regions
                ],
                "chosen": regions.chosen,
                "operating_point": {
                    "stretch": point,
                    "load_n": rig.mass_kg * _GRAVITY_M_S2,
                },
            }
        },
    )


def _fitted_load_n(law: HyperelasticFit, stretch: Floats, rig: RigDescription) -> Floats:
    """Load of shell and electrodes together over the stretch from the free length."""
    natural = 1.0 / np.sqrt(rig.lateral_stretch)
    e = natural * (stretch - 1.0)
    spring_pa = law.best.estimates["electrode_spring_pa"].value
    stress_pa = law.law.nominal_stress_pa(natural * stretch, rig.lateral_stretch)
    return np.asarray(rig.shell_area_m2 * (stress_pa + spring_pa * e))


def _line(region: Region, stretch: Floats, fitted_n: Floats) -> list[float]:
    """Load at both ends of a straight piece."""
    slope_n = region.slope_n.value
    inside = (stretch >= region.low.value - 1e-9) & (stretch <= region.high.value + 1e-9)
    offset_n = float(np.mean(fitted_n[inside] - slope_n * stretch[inside]))
    return [offset_n + slope_n * end for end in (region.low.value, region.high.value)]
