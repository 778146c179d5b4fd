"""The operating point: the baseline voltage that centres the strain in the linear region (S18)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.study.cycles import Cycles
from haselab.study.definition import Study
from haselab.study.resolution import POSITION_PX
from haselab.study.static import GRAVITY_M_S2, Static

__all__ = ["Point", "find_point"]

_DIGIT_V = 0.01  # to which a baseline is set
_HALVINGS = 40
_SLOPE_V = 0.05


@dataclass(frozen=True)
class Point:
    """The operating point of a study.

    Args:
        baseline_v: drive voltage of zero strain, in V.
        quantities: results by id.
        notes: by id, what the reader should know.
        figures: part of the section `static` of analysis.json.
    """

    baseline_v: float
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: dict[str, float]


def _room(study: Study, rig: RigDescription) -> tuple[float, float]:
    """Lowest and highest baseline with room for the chirp in the triangle and the drive's limits.

    Raises:
        ResultError: there is none.
    """
    t, limits = study.triangle, rig.drive_limits
    low = max(t.low_v, limits.low) + study.chirp.amplitude_v
    high = min(t.high_v, limits.high) - study.chirp.amplitude_v
    if not low <= high:
        raise ResultError(
            f"A chirp of ±{study.chirp.amplitude_v:g} V has no room between {t.low_v:g} and "
            f"{t.high_v:g} V. Lower chirp.amplitude_v, or give operating_point.baseline_v."
        )
    return low, high


def _centring_v(cycles: Cycles, length_m: float, room: tuple[float, float]) -> float:
    """Voltage at which the mean of both edges has a length; the nearer limit where none has."""
    low, high = room
    if cycles.length_at(low) >= length_m:
        return low
    if cycles.length_at(high) <= length_m:
        return high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if cycles.length_at(middle) < length_m:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _advice(cycles: Cycles, static: Static, room: tuple[float, float], mass_kg: float) -> str:
    """About the mass whose strain would be centred half-way between the limits of the baseline."""
    drawn = static.figures["static"]
    at_middle = cycles.length_at(0.5 * sum(room)) / static.free_length_m
    loads = np.interp([static.centre.value, at_middle], drawn["stretch"], drawn["load_n"])
    better_kg = mass_kg + float(loads[0] - loads[1]) / GRAVITY_M_S2
    return f"hang about {better_kg:.2g} kg" if better_kg > 0.0 else "take a stiffer actuator"


def find_point(
    cycles: Cycles, static: Static, study: Study, rig: RigDescription, played_v: float | None = None
) -> Point:
    """The baseline that the study gives, or the one that centres the strain.

    The weight is the rig's. About the baseline the chirp keeps its room on both sides.

    Args:
        cycles: of the triangle test.
        static: of the static load test.
        study: baseline, chirp and triangle.
        rig: drive limits and weight.
        played_v: baseline of another run that is repeated, instead of the one found here.
    Returns:
        Baseline, results S18; the one found here stays in the results.
    Raises:
        ResultError: too few frames near a voltage, or no room for the chirp.
    Source: reference study, row S18.
    """
    region, centre = static.region, static.centre
    given = study.operating_point.baseline_v
    notes: dict[str, str] = {}
    if given is None:
        room = _room(study, rig)
        exact_v = _centring_v(cycles, centre.value * static.free_length_m, room)
        baseline_v = float(np.clip(round(exact_v / _DIGIT_V) * _DIGIT_V, *room))
        notes["S18.baseline"] = f"centres the strain with {rig.mass_kg:g} kg"
        if exact_v in room:
            notes["S18.baseline"] = (
                f"the centre of the region, stretch {centre.value:.3f}, is out of reach with "
                f"{rig.mass_kg:g} kg and room for the chirp; "
                f"{_advice(cycles, static, room, rig.mass_kg)}"
            )
    else:
        baseline_v = given
        notes["S18.baseline"] = "as the study gives it"
    played_v = baseline_v if played_v is None else played_v
    stretch = cycles.length_at(played_v) / static.free_length_m
    rise = cycles.length_at(played_v + _SLOPE_V) - cycles.length_at(played_v - _SLOPE_V)
    slope_per_v = rise / (2.0 * _SLOPE_V * static.free_length_m)
    half = 0.5 * (region.high.value - region.low.value)
    length_m = static.free_length_m * stretch
    finest = np.sqrt(2.0) * POSITION_PX * rig.scale_m_per_px / length_m
    lengths = cycles.seen.length_m[cycles.kept]
    inside = region.low.value <= stretch <= region.high.value
    notes["S18.centring"] = (
        f"stretch {stretch:.3f}, {'inside' if inside else 'outside'} the longest linear region of "
        f"{region.low.value:.3f} to {region.high.value:.3f}"
    )
    std_v = float(np.hypot(centre.std / slope_per_v, _DIGIT_V / np.sqrt(12.0)))
    return Point(
        baseline_v=played_v,
        quantities={
            "S18.baseline": Estimate.normal(baseline_v, std_v if given is None else 0.0, "V"),
            "S18.centring": Estimate.normal((stretch - centre.value) / half, centre.std / half, ""),
            "S18.room_low": Estimate.normal(float(lengths.min()) / length_m - 1.0, finest, ""),
            "S18.room_high": Estimate.normal(float(lengths.max()) / length_m - 1.0, finest, ""),
        },
        notes=notes,
        figures={"stretch": stretch, "load_n": rig.mass_kg * GRAVITY_M_S2},
    )
