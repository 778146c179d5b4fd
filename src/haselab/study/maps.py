"""Triangle test to maps: voltage from strain (eq. 4), strain from capacitance (eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, ResultError
from haselab.identify.capacitance_map import fit_capacitance_map
from haselab.identify.voltage_map import fit_voltage_map
from haselab.models.maps import VoltageMap
from haselab.rig import RigDescription
from haselab.runtime.runner import StrainMap
from haselab.study.definition import Study
from haselab.study.observe import Observation

__all__ = ["Maps", "drive_at", "fit_maps"]

_NEAR_V = 0.06  # about the baseline, where length against voltage is a straight line


@dataclass(frozen=True)
class Maps:
    """What the triangle test gives.

    Args:
        length_m: of zero strain.
        voltage_map: corrected strain to drive voltage, eq. 4.
        strain_map: capacitance (F) to strain, with its bend: for the loop.
        quantities: results by id.
        figures: sections of analysis.json.
    """

    length_m: float
    voltage_map: VoltageMap
    strain_map: StrainMap
    quantities: dict[str, Estimate]
    figures: dict[str, Any]


def drive_at(
    seen: Observation, time_s: NDArray[np.float64], rig: RigDescription
) -> NDArray[np.float64]:
    """Drive voltage in effect at given times: the staircase, delayed by the output's delay."""
    starts_s = seen.block_start_s + rig.switch_sample / rig.rate_hz
    index = np.searchsorted(starts_s, time_s, side="right") - 1
    return np.asarray(seen.drive_v[np.clip(index, 0, None)])


def _baseline_length(
    length_m: NDArray[np.float64], drive_v: NDArray[np.float64], baseline_v: float
) -> float:
    """Mean over both edges of the length at the baseline voltage."""
    at_baseline = []
    rising = np.gradient(drive_v) > 0.0
    for edge in (rising, ~rising):
        near = edge & (np.abs(drive_v - baseline_v) < _NEAR_V)
        if near.sum() < 8:
            raise ResultError(
                f"Only {int(near.sum())} frames near the baseline of {baseline_v:g} V, 8 are "
                "needed. Record faster, or a triangle that crosses the baseline."
            )
        line = np.polynomial.Polynomial.fit(drive_v[near] - baseline_v, length_m[near], 1)
        at_baseline.append(float(line(0.0)))
    return float(np.mean(at_baseline))


def fit_maps(seen: Observation, study: Study, rig: RigDescription) -> Maps:
    """Both maps from one triangle test, its first cycles left out.

    Args:
        seen: the triangle test.
        study: which cycles count, the baseline voltage.
        rig: for the output's delay.
    Returns:
        Maps, results S14 and S15, data for figure 3.
    Raises:
        ResultError: too few frames, or a fit without a result.
    Source: reference study, rows S13 to S15.
    """
    t = study.triangle
    period_s = 1.0 / t.frequency_hz
    end_s = seen.block_start_s[-1] + rig.block_s
    from_s = end_s - (t.cycles - t.left_out_cycles) * period_s
    kept = (seen.frame_time_s >= from_s) & (seen.frame_time_s <= end_s)
    drive_v = drive_at(seen, seen.frame_time_s, rig)
    length_m = _baseline_length(
        seen.length_m[kept], _ramp_at(seen, seen.frame_time_s[kept], rig),
        study.operating_point.baseline_v,
    )  # fmt: skip
    strain = seen.length_m / length_m - 1.0
    to_volt = fit_voltage_map(strain[kept], drive_v[kept])
    if not to_volt.succeeded:
        raise ResultError(f"Voltage map: {to_volt.status}")
    inside = (seen.sensed_s >= from_s) & np.isfinite(seen.capacitance_f)
    strain_sensed = np.interp(seen.sensed_s, seen.frame_time_s, strain)
    line = fit_capacitance_map(seen.relative_capacitance[inside], strain_sensed[inside])
    bend, slope, offset = np.polyfit(seen.capacitance_f[inside], strain_sensed[inside], 2)
    maps = Maps(
        length_m=length_m,
        voltage_map=to_volt.map,
        strain_map=StrainMap(float(slope), float(offset), float(bend)),
        quantities={
            **{f"S14.{key}": to_volt.estimates[f"{key}_v" if key[0] == "a" else key]
               for key in ("a1", "b1", "a2", "b2")},
            "S15.slope": line.estimates["slope"],
            "S15.offset": line.estimates["offset"],
        },
        figures={},
    )  # fmt: skip
    maps.figures.update(_figures(seen, strain, kept, drive_v, maps))
    return maps


def _ramp_at(
    seen: Observation, time_s: NDArray[np.float64], rig: RigDescription
) -> NDArray[np.float64]:
    """The straight line behind the staircase: the triangle without its steps."""
    middle_s = seen.block_start_s + rig.switch_sample / rig.rate_hz + 0.5 * rig.block_s
    return np.interp(time_s, middle_s, seen.drive_v)


def _figures(
    seen: Observation,
    strain: NDArray[np.float64],
    kept: NDArray[np.bool_],
    drive_v: NDArray[np.float64],
    maps: Maps,
) -> dict[str, Any]:
    thin = slice(None, None, max(1, len(strain) // 2000))
    at_block = np.interp(seen.sensed_s, seen.frame_time_s, strain)
    grid = np.linspace(strain[kept].min(), strain[kept].max(), 120)
    paper = VoltageMap(1.324, 3.124, -0.2805, -26.92)
    relative = seen.relative_capacitance
    line = maps.quantities["S15.slope"].value, maps.quantities["S15.offset"].value
    ends = np.array([np.nanmin(relative), np.nanmax(relative)])
    start_s = seen.block_start_s[0]
    blocks = slice(None, None, max(1, len(relative) // 1000))
    return {
        "triangle": {
            "time_s": seen.frame_time_s[thin] - start_s,
            "drive_v": drive_v[thin],
            "strain": strain[thin],
            "strain_std": seen.length_std_m[thin] / maps.length_m,
            "relative_capacitance": np.interp(seen.frame_time_s[thin], seen.sensed_s, relative),
            "capacitance_f": np.interp(seen.frame_time_s[thin], seen.sensed_s, seen.capacitance_f),
        },
        "voltage_map": {
            "strain": strain[kept][thin],
            "voltage_v": drive_v[kept][thin],
            "fit_strain": grid,
            "fit_voltage_v": maps.voltage_map.voltage_v(grid),
            "paper_voltage_v": paper.voltage_v(grid),
        },
        "capacitance_map": {
            "relative_capacitance": relative[blocks],
            "strain": at_block[blocks],
            "fit_relative_capacitance": ends,
            "fit_strain": line[0] * ends + line[1],
            "time_s": seen.sensed_s[blocks] - start_s,
            "strain_time": at_block[blocks],
            "reconstructed_strain": maps.strain_map.strain(seen.capacitance_f[blocks]),
        },
    }
