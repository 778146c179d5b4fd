"""The operating point: the baseline voltage that centres the strain in the linear region (S18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from haselab.base import Estimate, ResultError, table_at
from haselab.rig import RigDescription
from haselab.study.definition import Study
from haselab.study.fits.cycles import Cycles
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import POSITION_PX
from haselab.study.fits.static import GRAVITY_M_S2, Static

__all__ = ["Point", "find_point"]

_DIGIT_V = 0.01  # resolution of a baseline


@dataclass(frozen=True)
class Point:
    """The operating point of a study.

    Args:
        baseline_v: drive voltage of zero strain, in V.
        quantities: results by id.
        notes: by id, remarks for the reader.
        figures: part of the section `static` of analysis.json.
    """

    baseline_v: float
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: dict[str, float]


@dataclass(frozen=True)
class _Held:
    """Stretch at rest as a function of the held voltages, which it rises or falls with."""

    drive_v: tuple[float, ...]
    stretch: tuple[float, ...]

    @classmethod
    def of(cls, holds: Sequence[Observation], free_length_m: float) -> _Held:
        points = sorted(
            (float(seen.drive_v[-1]), float(seen.length_m.mean()) / free_length_m) for seen in holds
        )
        drive_v, stretch = zip(*points, strict=True)
        steps = np.diff(stretch)
        if not ((steps > 0.0).all() or (steps < 0.0).all()):
            shown = ", ".join(f"{value:.4f}" for value in stretch)
            raise ResultError(
                f"The stretch at rest must rise, or fall, with the voltage, but is {shown}. Check "
                "the amplifier and the hung mass, or increase static_load.settle_s."
            )
        return cls(drive_v, stretch)

    def reaches(self, stretch: float) -> bool:
        """Whether a voltage between the held ones gives this stretch."""
        return min(self.stretch) < stretch < max(self.stretch)

    def at(self, drive_v: float) -> float:
        """Stretch at a voltage, interpolated between the held ones; outside, the nearest."""
        inside = float(np.clip(drive_v, self.drive_v[0], self.drive_v[-1]))
        if len(self.drive_v) == 1:
            return self.stretch[0]
        return float(PchipInterpolator(self.drive_v, self.stretch)(inside))

    def centring_v(self, stretch: float) -> float:
        """Voltage of a stretch; the nearer end of the range if no voltage reaches it."""
        inside = float(np.clip(stretch, min(self.stretch), max(self.stretch)))
        stretches, drives_v = zip(
            *sorted(zip(self.stretch, self.drive_v, strict=True)), strict=True
        )
        return float(PchipInterpolator(stretches, drives_v)(inside))

    def slope_per_v(self, drive_v: float) -> float:
        """Stretch per volt."""
        at = float(np.clip(drive_v, self.drive_v[0], self.drive_v[-1]))
        return float(PchipInterpolator(self.drive_v, self.stretch).derivative()(at))


def _better_kg(held: _Held, static: Static, mass_kg: float) -> float | None:
    """The mass whose strain is centred at the middle one of the held voltages."""
    drawn = table_at(static.figures, "static")
    at_middle = held.at(0.5 * (held.drive_v[0] + held.drive_v[-1]))
    stretch, load_n = np.asarray(drawn["stretch"]), np.asarray(drawn["load_n"])
    loads = np.interp([static.centre.value, at_middle], stretch, load_n)
    better_kg = mass_kg + float(loads[0] - loads[1]) / GRAVITY_M_S2
    return float(f"{better_kg:.2g}") if better_kg > 0.0 else None


def find_point(
    holds: Sequence[Observation],
    cycles: Cycles,
    static: Static,
    study: Study,
    rig: RigDescription,
    played_v: float | None = None,
) -> Point:
    """Find the baseline that centres the strain, or use that of the study.

    The hung mass is the rig's. The strain is measured at rest, as in the static load test; in a
    triangle it lags.

    Args:
        holds: the rig's mass at rest at some voltages.
        cycles: of the triangle test, for the range on both sides.
        static: of the static load test.
        study: baseline.
        rig: hung mass, scale of the camera.
        played_v: baseline of another run that is repeated, instead of the one found here.
    Returns:
        Baseline, results S18; these always report the baseline found here.
    Raises:
        ResultError: the stretch turns with the voltage, or too few frames are near it.
    Source: reference study, row S18.
    """
    region, centre = static.region, static.centre
    held = _Held.of(holds, static.free_length_m)
    given = study.operating_point.baseline_v
    notes: dict[str, str] = {}
    better_kg: float | None = None
    std_v = 0.0
    if given is None:
        found_v = round(held.centring_v(centre.value) / _DIGIT_V) * _DIGIT_V
        slope = abs(held.slope_per_v(found_v))
        std_v = float(np.hypot(centre.std / slope, _DIGIT_V / np.sqrt(12.0)))
        notes["S18.baseline"] = f"centres the strain with {rig.mass_kg:g} kg"
        if not held.reaches(centre.value):
            std_v = _DIGIT_V / np.sqrt(12.0)  # an end of the range, not a result
            better_kg = _better_kg(held, static, rig.mass_kg)
            advice = "use a stiffer actuator" if better_kg is None else f"hang about {better_kg} kg"
            notes["S18.baseline"] = (
                f"the centre of the region, stretch {centre.value:.3f}, is out of reach with "
                f"{rig.mass_kg:g} kg and the range of the chirp; {advice}"
            )
    else:
        found_v = given
        notes["S18.baseline"] = "set with operating_point.baseline_v"
    played_v = found_v if played_v is None else played_v
    stretch = held.at(played_v)
    half = 0.5 * (region.high.value - region.low.value)
    zero_m = cycles.length_at(played_v)
    finest = np.sqrt(2.0) * POSITION_PX * rig.scale_m_per_px / zero_m
    lengths_m = cycles.seen.length_m[cycles.kept]
    for end, at in (("min", int(lengths_m.argmin())), ("max", int(lengths_m.argmax()))):
        time_s = float(cycles.seen.frame_time_s[cycles.kept][at])
        notes[f"S18.strain_{end}"] = (
            f"at {cycles.ramp_at(np.array([time_s]))[0]:.3g} V of the drive"
        )
    inside = region.low.value <= stretch <= region.high.value
    notes["S18.centre_offset"] = (
        f"stretch {stretch:.3f}, {'inside' if inside else 'outside'} the longest linear region of "
        f"{region.low.value:.3f} to {region.high.value:.3f}"
    )
    return Point(
        baseline_v=played_v,
        quantities={
            "S18.baseline": Estimate.normal(found_v, std_v, "V"),
            "S18.centre_offset": Estimate.normal(
                (stretch - centre.value) / half, centre.std / half, ""
            ),
            "S18.rest": Estimate.normal(stretch * static.free_length_m / zero_m - 1.0, finest, ""),
            "S18.strain_min": Estimate.normal(float(lengths_m.min()) / zero_m - 1.0, finest, ""),
            "S18.strain_max": Estimate.normal(float(lengths_m.max()) / zero_m - 1.0, finest, ""),
        },
        notes=notes,
        figures={"stretch": stretch, "load_n": rig.mass_kg * GRAVITY_M_S2}
        | ({} if better_kg is None else {"recommended_mass_kg": better_kg}),
    )
