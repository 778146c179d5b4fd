"""Loops with the physical model: steps, weights, beyond the linear region (S25, S27, S30)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.control.step_metrics import over_trials
from haselab.controllers import Measurement
from haselab.rig import RigDescription
from haselab.runtime.closed_loop import setting_on_rig
from haselab.runtime.loop import LoopSettings, RunningController
from haselab.study.experiment import Chart, Curve
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import POSITION_PX, ZERO_PX, with_resolution
from haselab.study.fits.trials import (
    ONE_TRIAL,
    Trials,
    collect_trials,
    normal_equivalent,
    with_camera_resolution,
)
from haselab.study.tables import ModelControl

__all__ = [
    "StepGroup",
    "mass_errors",
    "outer_results",
    "sensed_kg",
    "set_points",
    "step_results",
]

Floats = NDArray[np.float64]
_OUTER = (0.3, 0.6, 0.3)  # of the range that can be held with the outer mass
_PARTS = 4  # of the time after a step
_AT_REST = 1.0 / 3.0  # of a hold, at its end


@dataclass(frozen=True)
class StepGroup:
    """Step trials with one controller and one hung mass.

    Args:
        name: of the curve.
        rows: ids of its results without the name of the metric, such as `S25.{}_observer`.
        trials: recorded.
    """

    name: str
    rows: str
    trials: Sequence[Observation]


def set_points(settings: ModelControl, reach: tuple[float, float]) -> tuple[float, ...]:
    """Strains beyond the linear region: two of those that can be held, and the first one again.

    Args:
        settings: with the linear region.
        reach: lowest and highest strain that can be held with the outer mass.
    Returns:
        The strains; none if they are not beyond the linear region.
    """
    low, high = reach
    found = tuple(low + share * (high - low) for share in _OUTER)
    return found if min(found) > settings.linear_high else ()


def step_results(
    groups: Sequence[StepGroup], loop: LoopSettings, zero_m: float, settings: ModelControl,
    scale_m_per_px: float,
) -> tuple[dict[str, Estimate], dict[str, str], Chart]:  # fmt: skip
    """Rise time, overshoot and error of step trials, from the camera.

    Args:
        groups: trials by controller and mass.
        loop: with the map from capacitance to strain.
        zero_m: length at zero strain.
        settings: the step.
        scale_m_per_px: of the camera.
    Returns:
        Results by id, notes by id, and the figure.
    """
    found: dict[str, Estimate] = {}
    notes: dict[str, str] = {}
    curves = []
    for group in groups:
        seen = collect_trials(group.trials, zero_m, loop.strain_map, settings)
        metrics = {
            "rise": seen.metrics.raw_rise_time_s,
            "overshoot": seen.metrics.overshoot,
            "error": seen.metrics.steady_state_error,
        }
        for name, estimate in metrics.items():
            key = group.rows.format(name)
            found[key] = with_camera_resolution(
                normal_equivalent(estimate), settings, scale_m_per_px / zero_m,
                ZERO_PX if name == "error" else 0.0,
            )  # fmt: skip
            if len(group.trials) == 1:
                notes[key] = ONE_TRIAL
        curves.append(_curve(group.name, seen, settings))
    first = collect_trials(groups[0].trials, zero_m, loop.strain_map, settings)
    shown = _shown(first.time_s, settings)
    desired = Curve("desired", first.time_s[shown] - settings.zero_s, first.reference[shown])
    chart = Chart(
        "model-steps",
        "Steps with controllers of the physical model",
        "Camera strain, mean of the trials. observer knows the hung mass; hybrid weighs it with "
        "the actuator itself (S25, S27).",
        "time (s)",
        "strain",
        (desired, *curves),
    )
    return found, notes, chart


def _shown(time_s: Floats, settings: ModelControl) -> NDArray[np.bool_]:
    return np.asarray((time_s > settings.zero_s - 0.2) & (time_s < settings.zero_s + 1.0))


def _curve(name: str, seen: Trials, settings: ModelControl) -> Curve:
    shown = _shown(seen.time_s, settings)
    return Curve(name, seen.time_s[shown] - settings.zero_s, seen.strain.mean(axis=0)[shown])


def sensed_kg(
    seen: Observation, loop: LoopSettings, rig: RigDescription, carrier_hz: float
) -> Floats:
    """Hung mass as the controller of a recorded loop estimated it, update by update.

    The controller is started again and gets what it measured in the run.

    Args:
        seen: the recording.
        loop: that was closed.
        rig: nominal values of the bench.
        carrier_hz: frequency of the sensing signal.
    Returns:
        In kg. Shape `(B,)`.
    """
    running = RunningController(loop.controller, setting_on_rig(rig, carrier_hz, loop))
    ahead = loop.controller.kind.preview_steps(rig.block_s)
    wanted = (*seen.reference.tolist(), *[float(seen.reference[-1])] * ahead)
    least_f, most_f = loop.strain_map.usable_f
    found = np.full(len(seen.reference), np.nan)
    for k, farad in enumerate(seen.capacitance_f.tolist()):
        valid = least_f <= farad <= most_f
        measured = Measurement(
            strain=float(loop.strain_map.strain(farad)) if valid else math.nan,
            capacitance_f=farad,
            voltage_v=float(seen.drive_v[k]),
            time_s=float(seen.block_start_s[k]) + rig.block_s,
            valid=valid,
            in_range=bool(loop.strain_map.inside(farad)),
            preview=wanted[k + 1 : k + 1 + ahead],
        )
        running.step(wanted[k], measured)
        found[k] = getattr(running.controller, "estimated_load_kg", math.nan)
    return found


def mass_errors(
    by_mass: Mapping[str, Sequence[Observation]], loop: LoopSettings, rig: RigDescription,
    carrier_hz: float, from_s: float,
) -> dict[str, Estimate]:  # fmt: skip
    """Sensed minus hung mass, mean after the step.

    The interval is that of the means of a quarter of that time, longer than the estimate remembers.

    Args:
        by_mass: trials by the id of the result.
        loop: of the hybrid.
        rig: nominal values of the bench.
        carrier_hz: frequency of the sensing signal.
        from_s: where the mean begins, after the start of a trial.
    Returns:
        In kg, by id.
    """
    first = round(from_s / rig.block_s)
    found = {}
    for key, trials in by_mass.items():
        errors = [
            sensed_kg(seen, loop, rig, carrier_hz)[first:] - seen.mass_kg[-1] for seen in trials
        ]
        parts = np.concatenate([np.array_split(one, _PARTS) for one in errors]).mean(axis=1)
        found[key] = normal_equivalent(over_trials(parts, "kg"))
    return found


def outer_results(
    seen: Observation, points: tuple[float, ...], zero_m: float, settings: ModelControl,
    scale_m_per_px: float,
) -> tuple[dict[str, Estimate], Chart]:  # fmt: skip
    """Errors at rest and overshoots beyond the linear region, from the camera.

    Args:
        seen: the recording.
        points: strains, see `set_points`.
        zero_m: length at zero strain.
        settings: the linear region, the time of each strain.
        scale_m_per_px: of the camera.
    Returns:
        Results by id, and the figure.
    """
    time_s = seen.frame_time_s - seen.block_start_s[0]
    strain = seen.length_m / zero_m - 1.0
    resolution = math.hypot(POSITION_PX, ZERO_PX) * scale_m_per_px / zero_m
    errors, overshoots = [], []
    for k, point in enumerate(points):
        end_s = (k + 1) * settings.hold_s
        rest = strain[(time_s >= end_s - _AT_REST * settings.hold_s) & (time_s < end_s)]
        scatter = float(rest.std(ddof=1)) / math.sqrt(rest.size)
        error = Estimate.normal(point - float(rest.mean()), scatter, "")
        errors.append(with_resolution(error, resolution))
        if k == 0:  # the loop has just begun
            continue
        way = point - points[k - 1]
        during = strain[(time_s >= end_s - settings.hold_s) & (time_s < end_s)]
        past = float(((during - point) * math.copysign(1.0, way)).max()) / abs(way)
        overshoot = Estimate.normal(max(past, 0.0), 0.0, "")
        overshoots.append(with_resolution(overshoot, resolution / abs(way)))
    found = {
        "S30.lowest": _set(min(points)),
        "S30.highest": _set(max(points)),
        "S30.error": max(errors, key=_size),
        "S30.overshoot": max(overshoots, key=_size),
    }
    ends_s = settings.hold_s * np.arange(len(points) + 1.0)
    desired = Curve("desired", np.repeat(ends_s, 2)[1:-1], np.repeat(points, 2))
    edge = np.full(2, settings.linear_high)
    chart = Chart(
        "model-range",
        "Steps beyond the linear region",
        "Camera strain of one trial with hybrid and a heavy mass (S30). The linear region is that "
        "of the load-stretch curve (S17).",
        "time (s)",
        "strain",
        (desired, Curve("hybrid", time_s, strain),
         Curve("upper end of the linear region", ends_s[[0, -1]], edge)),
    )  # fmt: skip
    return found, chart


def _size(estimate: Estimate) -> float:
    return abs(estimate.value)


def _set(value: float) -> Estimate:
    """A strain that is requested, not measured."""
    return Estimate(value, 0.0, (value, value), "")
