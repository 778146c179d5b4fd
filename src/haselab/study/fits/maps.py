"""Maps from the triangle test: voltage of strain (eq. 4), strain of capacitance (eq. 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError
from haselab.identify.noise import coloured_covariance
from haselab.identify.statics.capacitance_map import fit_capacitance_map
from haselab.identify.statics.voltage_map import VoltageMapFit, fit_voltage_map
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap, allow_start
from haselab.sensing.strain import fit_strain_map
from haselab.study.fits.cycles import Cycles, drive_at, repeatability
from haselab.study.paper.paper_check import EQ_4

__all__ = ["Maps", "fit_maps", "require_open_steps"]

_SAME_V = 1e-9  # rounding of a voltage from the map
_COMPARED = (-0.05, 0.10)  # range of the printed saturation, where two maps are compared
_INSEPARABLE = (
    "not identifiable alone, because this loop does not separate the two exponentials: use no "
    "coefficient by itself. Its interval, if there is one, only serves the comparison with the "
    "noise-free fit. The curve of all four is well determined (S14.zero, figure 3)"
)

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Maps:
    """Results of the triangle test.

    Args:
        length_m: of zero strain.
        voltage_map: corrected strain to drive voltage, eq. 4.
        strain_map: capacitance (F) to strain with its band, for the loops.
        quantities: results by id.
        notes: by id, remarks for the reader.
        figures: sections of analysis.json.
        zero_px: standard deviation of the length of zero strain against the lengths of the study,
            in px: 0 if the same session gives both.
    """

    length_m: float
    voltage_map: VoltageMap
    strain_map: StrainMap
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: JsonObject
    zero_px: float = 0.0


def fit_maps(cycles: Cycles, baseline_v: float) -> Maps:
    """Fit both maps to one triangle test, without its first cycles.

    Args:
        cycles: of the triangle test.
        baseline_v: drive voltage of zero strain.
    Returns:
        Maps, results S13 to S15, data for figure 3.
    Raises:
        ResultError: there are too few frames, or a fit has no result.
    Source: reference study, rows S13 to S15.
    """
    seen, kept = cycles.seen, cycles.kept
    drive_v = drive_at(seen, seen.frame_time_s, cycles.rig)
    length_m = cycles.length_at(baseline_v)
    strain = seen.length_m / length_m - 1.0
    to_volt = fit_voltage_map(strain[kept], drive_v[kept])
    if not to_volt.succeeded:
        raise ResultError(f"Voltage map: {to_volt.status}")
    inside = (seen.sensed_s >= cycles.from_s) & np.isfinite(seen.capacitance_f)
    strain_sensed = np.interp(seen.sensed_s, seen.frame_time_s, strain)
    at_strain = fit_capacitance_map(seen.relative_capacitance[inside], strain_sensed[inside])
    in_time = _Edges.of(cycles, strain_sensed)
    to_strain = fit_strain_map(seen.capacitance_f[inside], strain_sensed[inside])
    curve, note = _curve(to_volt, drive_v[kept])
    maps = Maps(
        length_m=length_m,
        voltage_map=to_volt.map,
        strain_map=to_strain,
        quantities={
            **repeatability(cycles, length_m),
            **{f"S14.{key.removesuffix('_v')}": found
               for key, found in to_volt.linear_coefficients().items()},
            "S14.rms_difference": curve,
            "S14.zero": Estimate.normal(
                float(to_volt.map.voltage_v(0.0)), float(to_volt.curve_std(0.0)), "V"
            ),
            **in_time.quantities,
            "S15.slope_at_strain": at_strain.parameters["slope"],
            "S15.offset_at_strain": at_strain.parameters["offset"],
        },
        notes={"S14.rms_difference": note} | {
            f"S14.{key.removesuffix('_v')}": _INSEPARABLE
            for key, found in to_volt.parameters.items() if math.isnan(found.value)
        },
        figures={},
    )  # fmt: skip
    maps.figures.update(_figures(cycles, strain, drive_v, maps, in_time))
    return maps


def _curve(fit: VoltageMapFit, drive_v: Floats) -> tuple[Estimate, str]:
    """Rms difference of fitted and printed map as a fraction of the drive range, and a note."""
    low = max(_COMPARED[0], fit.map.strain_low)
    high = min(_COMPARED[1], fit.map.strain_high)
    strain = np.linspace(low, high, 151)
    fitted_v = fit.map.voltage_v(strain)
    off_v = fitted_v - EQ_4.voltage_v(strain)
    rms_v = float(np.sqrt(np.mean(off_v**2)))
    # To first order: all points move together, each by the standard deviation of the curve.
    std_v = float(np.mean(np.abs(off_v) * fit.curve_std(strain)) / max(rms_v, 1e-12))
    span_v = float(np.ptp(drive_v))
    note = f"rms difference over strains of {low:g} to {high:g}, as a fraction of {span_v:g} V"
    seen = (fitted_v >= drive_v.min()) & (fitted_v <= drive_v.max())
    if seen.any() and not seen.all():
        part = float(np.sqrt(np.mean(off_v[seen] ** 2))) / span_v
        note += (
            f"; {part:.3g} over {strain[seen][0]:.3g} to {strain[seen][-1]:.3g}, where the fitted "
            "map is within the voltages of the triangle"
        )
    return Estimate.normal(rms_v / span_v, std_v / span_v, ""), note


@dataclass(frozen=True)
class _Edges:
    """Mean of the rising and the falling edge at equal times from the peak, as in the paper.

    Args:
        relative_capacitance: means, shape `(cycles, half)`, NaN for a lost block.
        strain: means, the same shape.
        quantities: the straight line through the means.
    """

    relative_capacitance: Floats
    strain: Floats
    quantities: dict[str, Estimate]

    @classmethod
    def of(cls, cycles: Cycles, strain: Floats) -> _Edges:
        """Average each fitted cycle about its peak.

        Args:
            cycles: of the triangle test.
            strain: measured by the camera at each capacitance, shape `(B,)`.
        """
        seen = cycles.seen
        half_s = 0.5 * float(np.mean(np.diff(cycles.starts_s)))
        after_s = (np.arange(round(half_s / cycles.rig.block_s)) + 0.5) * cycles.rig.block_s
        lag_s = cycles.rig.switch_sample / cycles.rig.rate_hz
        means = []
        for start_s in cycles.starts_s[cycles.left_out : -1] + lag_s:
            times_s = start_s + after_s, start_s + 2.0 * half_s - after_s
            means.append(
                [
                    np.mean([np.interp(t, seen.sensed_s, values) for t in times_s], axis=0)
                    for values in (seen.relative_capacitance, strain)
                ]
            )
        c, e = np.array(means).transpose(1, 0, 2)
        good = np.isfinite(c) & np.isfinite(e)
        if good.sum() < 16:
            raise ResultError(
                f"Only {int(good.sum())} means of both edges have a capacitance, but 16 are needed."
            )
        middle, size = float(c[good].mean()), 0.5 * float(np.ptp(c[good]))
        columns = np.column_stack([(c[good] - middle) / size, np.ones(int(good.sum()))])
        factors = np.linalg.lstsq(columns, e[good], rcond=None)[0]
        residuals = e[good] - columns @ factors
        about_zero = np.array([[1.0 / size, 0.0], [-middle / size, 1.0]])
        covariance = about_zero @ coloured_covariance([columns], [residuals], 2) @ about_zero.T
        slope, offset = about_zero @ factors
        std = np.sqrt(np.diag(covariance))
        return cls(
            c,
            e,
            {
                "S15.slope": Estimate.normal(float(slope), float(std[0]), ""),
                "S15.offset": Estimate.normal(float(offset), float(std[1]), ""),
            },
        )


def _figures(
    cycles: Cycles, strain: Floats, drive_v: Floats, maps: Maps, edges: _Edges
) -> dict[str, Any]:
    seen, kept = cycles.seen, cycles.kept
    thin = slice(None, None, max(1, len(strain) // 2000))
    at_block = np.interp(seen.sensed_s, seen.frame_time_s, strain)
    grid = np.linspace(strain[kept].min(), strain[kept].max(), 120)
    relative = seen.relative_capacitance
    line = maps.quantities["S15.slope"].value, maps.quantities["S15.offset"].value
    ends = np.array([np.nanmin(relative), np.nanmax(relative)])
    start_s = seen.block_start_s[0]
    blocks = slice(None, None, max(1, len(relative) // 1000))
    counted = np.flatnonzero(seen.sensed_s >= cycles.from_s)[blocks]
    sensed_f = seen.capacitance_f[counted]
    farad = np.linspace(np.nanmin(sensed_f), np.nanmax(sensed_f), 120)
    return {
        "triangle": {
            "time_s": seen.frame_time_s[thin] - start_s,
            "drive_v": drive_v[thin],
            "strain": strain[thin],
            "strain_std": seen.spread_m[thin] / maps.length_m,
            "relative_capacitance": np.interp(seen.frame_time_s[thin], seen.sensed_s, relative),
            "capacitance_f": np.interp(seen.frame_time_s[thin], seen.sensed_s, seen.capacitance_f),
        },
        "voltage_map": {
            "strain": strain[kept][thin],
            "voltage_v": drive_v[kept][thin],
            "fit_strain": grid,
            "fit_voltage_v": maps.voltage_map.voltage_v(grid),
            "paper_voltage_v": EQ_4.voltage_v(grid),
        },
        "capacitance_map": {
            "relative_capacitance": edges.relative_capacitance.ravel(),
            "strain": edges.strain.ravel(),
            "each_relative_capacitance": relative[counted],
            "each_strain": at_block[counted],
            "fit_relative_capacitance": ends,
            "fit_strain": line[0] * ends + line[1],
            "each_capacitance_f": sensed_f,
            "map_capacitance_f": farad,
            "map_strain": maps.strain_map.strain(farad),
            "time_s": seen.sensed_s[blocks] - start_s,
            "strain_time": at_block[blocks],
            "reconstructed_strain": maps.strain_map.strain(seen.capacitance_f[blocks]),
            "reconstructed_band": maps.strain_map.band,
        },
    }


def require_open_steps(
    to_volt: VoltageMap, step: float, low_v: float, high_v: float, closed: str = ""
) -> None:
    """Refuse open-loop steps that the drive does not reach through the voltage map.

    Args:
        to_volt: strain to drive voltage.
        step: strain after the step; each trial starts at zero strain, or at the end of the drive if
            zero strain is just outside, see `allow_start`.
        low_v: lowest drive, in V.
        high_v: highest drive, in V.
        closed: what the message says of the closed loop.
    Raises:
        InputError: the voltage of zero strain, or of the step, is not within the drive.
    """
    ends = f"the drive is limited to {low_v:g} to {high_v:g} V"
    zero_v, step_v = (float(to_volt.voltage_v(strain)) for strain in (0.0, step))
    reach = to_volt.reach((to_volt.strain_low, to_volt.strain_high), low_v, high_v)
    starts = reach is not None and allow_start(reach)
    if not starts and not low_v - _SAME_V <= zero_v <= high_v + _SAME_V:
        raise InputError(
            f"A step trial starts at zero strain, which needs {zero_v:.4g} V by the voltage map, "
            f"but {ends}. Change the limits of the drive, or define zero strain as the length at a "
            "drive within these limits (zero_length_m) and fit the maps and the model again."
        )
    if low_v - _SAME_V <= step_v <= high_v + _SAME_V:
        return
    reach = to_volt.reach((min(step, 0.0), max(step, 0.0)), low_v, high_v) or (0.0, 0.0)
    farthest = reach[0] if step < 0.0 else reach[1]
    fitted = to_volt.strain_low <= step <= to_volt.strain_high
    beyond = "" if fitted else (
        f" (extrapolated: the map is for strains of {to_volt.strain_low:.3g} to "
        f"{to_volt.strain_high:.3g})"
    )  # fmt: skip
    raise InputError(
        f"step = {step:g} in [steps] is a strain that needs {step_v:.4g} V by the voltage map"
        f"{beyond}, but {ends}. Choose a step between 0 and {farthest:.3g}"
        f"{' for the trials in open loop' * bool(closed)}.{f' {closed}' * bool(closed)}"
    )
