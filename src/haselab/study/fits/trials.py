"""Step trials: strain from the camera and from self-sensing, rise times and errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, JsonObject
from haselab.base.estimate import Z95
from haselab.control import StepMetrics, step_metrics
from haselab.models.actuator.strain_map import StrainMap
from haselab.study.definition import Study
from haselab.study.fits.maps import Maps
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import POSITION_PX, with_resolution
from haselab.study.own_controller import OWN, own_note, own_quantities
from haselab.study.tables import StepTimes

__all__ = [
    "ONE_TRIAL",
    "Comparison",
    "Trials",
    "collect_trials",
    "compare_trials",
    "make_comparison",
    "normal_equivalent",
    "with_camera_resolution",
]

_LONGEST_GAP_S, _GAP_FRAMES = 0.25, 10  # without a value, whichever is longer
_UNUSED_S = 0.1  # at the end of a trial
ONE_TRIAL = "one trial: the interval only includes the camera's resolution, not the scatter"


@dataclass(frozen=True)
class Trials:
    """One group of step trials on a common clock.

    Args:
        time_s: from the start of a trial, shape `(N,)`.
        strain: measured by the camera, shape `(trials, N)`.
        sensed: by self-sensing, shape `(trials, N)`.
        reference: desired strain, shape `(N,)`.
        metrics: of the camera's strain.
    """

    time_s: NDArray[np.float64]
    strain: NDArray[np.float64]
    sensed: NDArray[np.float64]
    reference: NDArray[np.float64]
    metrics: StepMetrics


def normal_equivalent(estimate: Estimate) -> Estimate:
    """Replace the standard deviation by that of a normal error with the same interval.

    With few trials the standard deviation itself is uncertain; Student's interval includes this.
    """
    low, high = estimate.ci95
    return Estimate(estimate.value, (high - low) / (2.0 * Z95), estimate.ci95, estimate.unit)


def _require_covered(seen: Observation, steps: StepTimes) -> None:
    """Refuse a trial in which camera or self-sensing found nothing for too long."""
    start_s = seen.block_start_s[0]
    ends_s = np.array([start_s, start_s + steps.zero_s + steps.step_s - _UNUSED_S])
    longest_s = max(_LONGEST_GAP_S, _GAP_FRAMES / steps.frame_rate_hz)
    sensed_s = seen.sensed_s[np.isfinite(seen.capacitance_f)]
    for what, time_s in (("camera frame", seen.frame_time_s), ("capacitance", sensed_s)):
        times_s = np.sort(np.concatenate([ends_s, time_s]))
        gap_s = float(np.diff(times_s).max())
        if time_s.size < 2 or gap_s > longest_s:
            raise InputError(
                f"{seen.name!r} has no valid {what} for {gap_s:.3g} s (at most {longest_s:.3g} s). "
                "Check the light, the points and the monitors, then play it again."
            )


def collect_trials(
    trials: Sequence[Observation],
    zero_length_m: float,
    to_strain: StrainMap,
    steps: StepTimes,
) -> Trials:
    """Collect the trials of one group at the frame times of the first one, with their metrics.

    Args:
        trials: as they were recorded.
        zero_length_m: of the sheet at zero strain.
        to_strain: of the capacitance.
        steps: their times.
    Raises:
        InputError: a trial without camera frames or capacitance for a while, or one that moves in
            the wrong direction.
    """
    for seen in trials:
        _require_covered(seen, steps)
    count = round((steps.zero_s + steps.step_s - _UNUSED_S) * steps.frame_rate_hz)
    # At the frame times: interpolation half-way between frames at 20 frames/s attenuates ringing of
    # 5 Hz by a third.
    first_s = (trials[0].frame_time_s[0] - trials[0].block_start_s[0]) % (1.0 / steps.frame_rate_hz)
    time_s = first_s + np.arange(count, dtype=np.float64) / steps.frame_rate_hz
    strain, sensed = [], []
    for seen in trials:
        start_s = seen.block_start_s[0]
        camera = seen.length_m / zero_length_m - 1.0
        strain.append(np.interp(time_s, seen.frame_time_s - start_s, camera))
        good = np.isfinite(seen.capacitance_f)
        sensed.append(
            np.interp(
                time_s,
                seen.sensed_s[good] - start_s,
                to_strain.strain(seen.capacitance_f[good]),
            )
        )
    reference = np.where(time_s < steps.zero_s, 0.0, steps.step)
    metrics = step_metrics(time_s, np.array(strain), reference)
    return Trials(time_s, np.array(strain), np.array(sensed), reference, metrics)


@dataclass(frozen=True)
class Comparison:
    """Rows S24 and S25.

    Args:
        groups: trials by group: "open loop", "PI", "PID".
        quantities: results by id.
        figures: sections of analysis.json.
        sensing_error: rms difference of self-sensed and camera strain, fraction of the span.
        notes: by id, remarks for the reader.
        failed: by group, why its trials give no result.
    """

    groups: dict[str, Trials]
    quantities: dict[str, Estimate]
    figures: JsonObject
    sensing_error: float
    notes: dict[str, str] = field(default_factory=dict)
    failed: Mapping[str, str] = field(default_factory=dict)

    def reason(self, key: str) -> str:
        """Why there is no result of this id; empty if there is one, or if no trial is the cause."""
        return "" if key in self.quantities else self.failed.get(_group_of(key), "")


def compare_trials(
    observed: Mapping[str, Sequence[Observation]], maps: Maps, study: Study, scale_m_per_px: float
) -> Comparison:
    """Compare open loop and closed loop.

    Args:
        observed: trials by group: "open loop", and, if they were played, "PI", "PID" and `OWN`.
        maps: zero strain, capacitance to strain.
        study: the step.
        scale_m_per_px: of the camera, for its resolution.
    Returns:
        Results S24 and S25, data for figure 6 and for the comparison of self-sensing and camera.
        A closed loop whose trials cannot be evaluated costs its own results alone.
    Raises:
        InputError: the trials in open loop, or all trials, cannot be evaluated.
    Source: reference study, rows S24 and S25.
    """
    groups: dict[str, Trials] = {}
    failed: dict[str, str] = {}
    for name, trials in observed.items():
        if not trials:
            failed[name] = "not played (steps.open_trials = 0)"
            continue
        try:
            groups[name] = collect_trials(trials, maps.length_m, maps.strain_map, study.steps)
        except InputError as error:
            if name == "open loop":
                raise
            shown = f"the controller {study.control.kind!r}" if name == OWN else name
            failed[name] = f"step trials with {shown}: {error}"
    if not groups:
        raise InputError("; ".join(failed.values()))
    quantities: dict[str, Estimate] = {}
    if "open loop" in groups:
        opened = groups["open loop"].metrics
        quantities |= {
            "S24.rise_open": opened.rise_time_s,
            "S24.rise_open_raw": opened.raw_rise_time_s,
            "S24.error_open": opened.steady_state_error,
        }
    if "PI" in groups:
        closed = groups["PI"].metrics
        quantities |= {
            "S24.rise_closed": closed.rise_time_s,
            "S24.rise_closed_raw": closed.raw_rise_time_s,
            "S24.error_closed": closed.steady_state_error,
            "S24.overshoot_closed": closed.ring_averaged_overshoot,
        }
    if "PID" in groups:
        pid = groups["PID"].metrics
        quantities |= {
            "S25.rise_pid": pid.rise_time_s,
            "S25.overshoot_pid": pid.overshoot,
            "S25.error_pid": pid.steady_state_error,
        }
    if OWN in groups:
        own = groups[OWN].metrics
        quantities |= own_quantities(own.rise_time_s, own.overshoot, own.steady_state_error)
    notes = {
        key: ONE_TRIAL for key in quantities if len(groups[_group_of(key)].strain) == 1
    }  # fmt: skip
    for key in (key for key in quantities if _group_of(key) == OWN):
        note = own_note(study.control)
        notes[key] = f"{note}; {notes[key]}" if key in notes else note
    named = {str(study.control.kind) if name == OWN else name: g for name, g in groups.items()}
    shown = "PI" if "PI" in named else list(named)[-1]
    strain_per_px = scale_m_per_px / maps.length_m
    found = make_comparison(named, quantities, study.steps, strain_per_px, shown, maps.zero_px)
    return replace(found, notes=notes, failed=failed)


def _group_of(key: str) -> str:
    """The trials that a result comes from."""
    if key.startswith("S25."):
        return OWN if key.endswith("_own") else "PID"
    if not key.startswith("S24."):
        return ""  # of the further trials
    return "open loop" if "_open" in key else "PI"


def with_camera_resolution(
    estimate: Estimate, steps: StepTimes, strain_per_px: float, zero_px: float = 0.0
) -> Estimate:
    """Add the camera's resolution to a metric, a time or a fraction of the step.

    Args:
        estimate: in s, or dimensionless.
        steps: the step, rate of the frames.
        strain_per_px: of the camera.
        zero_px: standard deviation of the length of zero strain, in px, for a metric that depends
            on it.
    Returns:
        The estimate with the resolution in its interval, which for a time does not begin before 0;
        unchanged if it has no value.
    """
    if math.isnan(estimate.value):
        return estimate
    if estimate.unit == "s":
        found = with_resolution(estimate, math.sqrt(2.0 / 12.0) / steps.frame_rate_hz)
        return replace(found, ci95=(max(found.ci95[0], 0.0), found.ci95[1]))
    place_px = math.hypot(POSITION_PX, zero_px)
    return with_resolution(estimate, place_px * strain_per_px / abs(steps.step))


def make_comparison(
    groups: dict[str, Trials],
    quantities: dict[str, Estimate],
    steps: StepTimes,
    strain_per_px: float,
    shown: str,
    zero_px: float,
) -> Comparison:
    """Add the camera's resolution to the results, and make the figures.

    Args:
        groups: trials by group.
        quantities: results by id, of metrics.
        steps: the step.
        strain_per_px: of the camera.
        shown: the group whose first trial is used to compare self-sensing and camera.
        zero_px: standard deviation of the length of zero strain, on which errors depend, in px.
    """

    def seen(estimate: Estimate, zero_px: float = 0.0) -> Estimate:
        return with_camera_resolution(normal_equivalent(estimate), steps, strain_per_px, zero_px)

    quantities = {
        key: seen(value, zero_px if ".error" in key else 0.0) for key, value in quantities.items()
    }
    camera = np.concatenate([g.strain.ravel() for g in groups.values()])
    sensed = np.concatenate([g.sensed.ravel() for g in groups.values()])
    error = float(np.sqrt(np.mean((sensed - camera) ** 2)) / np.ptp(camera))
    # The same interval in the table of results and below a figure.
    metrics = {
        name: {
            "rise_time_s": seen(g.metrics.rise_time_s),
            "overshoot": seen(g.metrics.overshoot),
            "peak_excess": seen(g.metrics.peak_excess, zero_px),
            "error": seen(g.metrics.steady_state_error, zero_px),
            "settling_time_s": seen(g.metrics.settling_time_s),
        }
        for name, g in groups.items()
    }
    figures = _figures(groups, steps, shown)
    figures["steps"]["metrics"] = metrics
    return Comparison(groups, quantities, figures, error)


def _figures(groups: dict[str, Trials], steps: StepTimes, shown: str) -> dict[str, Any]:
    first = groups[shown]
    drawn = {
        name: {
            "mean": g.strain.mean(axis=0),
            "std": g.strain.std(axis=0, ddof=1) if len(g.strain) > 1 else 0.0 * g.strain[0],
            "trials": g.strain,
            "sensed_mean": g.sensed.mean(axis=0),
        }
        for name, g in groups.items()
    }
    return {
        "steps": {
            "time_s": first.time_s - steps.zero_s,
            "desired": first.reference,
            "groups": drawn,
        },
        "sensing": {
            "time_s": first.time_s - steps.zero_s,
            "camera_strain": first.strain[0],
            "sensed_strain": first.sensed[0],
        },
    }
