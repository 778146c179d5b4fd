"""Static load test: law of the planar HASEL's shell, linear regions (rows S16 and S17)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2
from haselab.base import Estimate, JsonObject, ResultError
from haselab.identify.statics.hyperelastic import HyperelasticFit, fit_hyperelastic
from haselab.identify.statics.regions import Region, RegionsFit, find_regions
from haselab.rig import RigDescription
from haselab.rig.protocols import PLANAR_HASEL
from haselab.study.definition import Study
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import POSITION_PX, with_resolution
from haselab.study.tables import LEAST_LOADS

__all__ = ["GRAVITY_M_S2", "Static", "fit_static"]

_SHELL_NOTE = "of the shell; the electrodes are fitted in parallel, with a cubic term"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Static:
    """Results of the static load test.

    Args:
        free_length_m: between the clamps without load.
        region: the longest linear region.
        segments: number of regions.
        quantities: results by id.
        notes: by id, remarks for the reader.
        figures: section of analysis.json.
    """

    free_length_m: float
    region: Region
    segments: int
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: JsonObject

    @property
    def centre(self) -> Estimate:
        """Stretch at the middle of the longest linear region."""
        low, high = self.quantities["S17.region_low"], self.quantities["S17.region_high"]
        middle = 0.5 * (low.value + high.value)
        return Estimate.normal(middle, 0.5 * float(np.hypot(low.std, high.std)), "")


def fit_static(
    seen: Observation, study: Study, rig: RigDescription, near: Static | None = None
) -> Static:
    """Fit the load as a function of the elongation of the whole actuator.

    Stretch counts from the free length, where the shell itself is stretched by 1/sqrt(lateral).
    Only a planar HASEL has that shell; for other kinds there are no results S16, nor where the fit
    of its law has none.

    Args:
        seen: the static load test.
        study: number of straight segments; None: chosen by BIC.
        rig: kind of the actuator, cross-section and lateral stretch of the shell.
        near: results of almost the same observation, whose number of segments is taken.
    Returns:
        Results S16 and S17, data for figure 4.
    Raises:
        ResultError: fewer than seven loads.
    Source: reference study, rows S16 and S17.
    """
    masses_kg = np.unique(seen.mass_kg)
    if masses_kg.size < LEAST_LOADS:
        raise ResultError(
            f"The static test has {masses_kg.size} loads, but needs at least {LEAST_LOADS}."
        )
    levels = [seen.length_m[seen.mass_kg == mass] for mass in masses_kg]
    length_m = np.array([level.mean() for level in levels])
    spread_m = np.array([level.std(ddof=1) if level.size > 1 else 0.0 for level in levels])
    load_n = masses_kg * GRAVITY_M_S2
    free_length_m = float(length_m[0])
    stretch = length_m / free_length_m
    shell, left_out = None, ""
    if rig.actuator_kind == PLANAR_HASEL:
        try:
            shell = _fit_shell(stretch, load_n, rig)
        except ResultError as error:
            left_out = str(error)
    segments = study.static_load.segments if near is None else near.segments
    regions = find_regions(stretch, load_n, segments=segments)
    chosen = regions.regions[regions.chosen]
    finest = POSITION_PX * rig.scale_m_per_px / free_length_m
    return Static(
        free_length_m=free_length_m,
        region=chosen,
        segments=len(regions.regions),
        quantities={
            **({} if shell is None else shell.quantities),
            "S17.region_low": with_resolution(chosen.low, finest * chosen.low.value),
            "S17.region_high": with_resolution(chosen.high, finest * chosen.high.value),
        },
        notes={
            **({} if shell is None else {"S16.mu": _SHELL_NOTE}),
            "S17.region_low": _segments_note(regions, study),
        },
        figures={
            "static": {
                "stretch": stretch,
                "stretch_std": spread_m / free_length_m,
                "load_n": load_n,
                **({} if shell is None else shell.curve),
                **({"left_out": left_out} if left_out else {}),
                "regions": [
                    {
                        "stretch": [r.low.value, r.high.value],
                        "load_n": _line(r, stretch, load_n - regions.residuals[0]),
                    }
                    for r in regions.regions
                ],
                "chosen": regions.chosen,
            }
        },
    )


@dataclass(frozen=True)
class _Shell:
    """Arruda-Boyce law of the planar HASEL's shell.

    Args:
        quantities: results S16.
        curve: fitted load against stretch, for figure 4.
    """

    quantities: dict[str, Estimate]
    curve: dict[str, Floats]


def _fit_shell(stretch: Floats, load_n: Floats, rig: RigDescription) -> _Shell:
    shell_stretch = stretch / np.sqrt(rig.lateral_stretch)
    law = fit_hyperelastic(
        shell_stretch[1:],
        load_n[1:] / rig.shell_area_m2,
        "arruda-boyce-series",
        deformation="fixed_lateral",
        lateral_stretch=rig.lateral_stretch,
        electrode_natural=1.0 / np.sqrt(rig.lateral_stretch),
        electrode_stiffening=True,
    )
    if not law.succeeded:
        raise ResultError(f"the shell's law has {law.status}.")
    grid = np.linspace(1.0, stretch[-1], 150)
    found = law.best.parameters
    return _Shell(
        {"S16.mu": found["mu_pa"], "S16.lambda_m": found["lambda_m"]},
        {"fit_stretch": grid, "fit_load_n": _fitted_load_n(law, grid, rig)},
    )


def _segments_note(regions: RegionsFit, study: Study) -> str:
    count = len(regions.regions)
    if study.static_load.segments is not None:
        return f"{count} straight segments, as set in the study"
    return " ".join([f"{count} straight segments, chosen by BIC.", *regions.notes]).rstrip(".")


def _fitted_load_n(law: HyperelasticFit, stretch: Floats, rig: RigDescription) -> Floats:
    """Load of shell and electrodes as a function of the stretch from the free length."""
    natural = 1.0 / np.sqrt(rig.lateral_stretch)
    e = natural * (stretch - 1.0)
    spring, cubic = (
        law.best.numbers[name] for name in ("electrode_spring_pa", "electrode_cubic_pa")
    )
    stress_pa = law.law.nominal_stress_pa(natural * stretch, rig.lateral_stretch)
    return np.asarray(rig.shell_area_m2 * (stress_pa + spring * e + cubic * e**3))


def _line(region: Region, stretch: Floats, fitted_n: Floats) -> list[float]:
    """Load at both ends of a straight segment."""
    slope_n = region.slope_n.value
    inside = (stretch >= region.low.value - 1e-9) & (stretch <= region.high.value + 1e-9)
    offset_n = float(np.mean(fitted_n[inside] - slope_n * stretch[inside]))
    return [offset_n + slope_n * end for end in (region.low.value, region.high.value)]
