"""Further closed-loop trials: the paper's sensing chain, extra delay, saturation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from haselab.base import Estimate, InputError
from haselab.control import StepNumbers, over_trials
from haselab.signals import constant
from haselab.study.definition import Study
from haselab.study.experiment import ExperimentResult
from haselab.study.fits.loops import Loops
from haselab.study.fits.maps import Maps
from haselab.study.fits.observe import Observation
from haselab.study.fits.trials import ONE_TRIAL, Trials, collect_trials, with_camera_resolution
from haselab.study.tables import Steps

__all__ = ["further_trials", "rows_without", "saturating_reference"]

_UPDATE_HZ = 100.0  # one new output per block, row S5
_SATURATED_PART = 0.4  # of step_s, at the strain that saturates
_AT_LIMIT_V = 1e-3  # distance from the voltage of the upper limit
_SATURATED_ROWS = ("S22.saturated_fraction", "S22.recovery_time")
_ROWS = {"printed": ("S10", "printed_chain"), "late": ("S24", "delayed")}


def saturating_reference(steps: Steps) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Desired strain of a trial that saturates, one value per block: zero, too much, the step."""
    much_s = _SATURATED_PART * steps.step_s
    return np.concatenate(
        [
            constant(0.0, steps.zero_s, _UPDATE_HZ),
            constant(steps.saturating_step, much_s, _UPDATE_HZ),
            constant(steps.step, steps.step_s - much_s, _UPDATE_HZ),
        ]
    )


def further_trials(
    observed: Mapping[str, Sequence[Observation]],
    pi: Trials | None,
    maps: Maps,
    loops: Loops,
    study: Study,
    scale_m_per_px: float,
) -> ExperimentResult:
    """Results S10, S22 and S24 of the further trials, and data for figure 14.

    Args:
        observed: by group, `printed`, `late` and `saturating`; groups without trials are left out.
        pi: the paper's trials, whose scatter is used for a single trial; None: not played.
        maps: zero strain, strain to voltage.
        loops: the saturation.
        study: the steps.
        scale_m_per_px: of the camera.
    """
    steps = study.steps
    strain_per_px = scale_m_per_px / maps.length_m
    quantities: dict[str, Estimate] = {}
    notes: dict[str, str] = {}
    drawn: dict[str, Any] = {}
    missing: dict[str, str] = {}
    for group, (row, name) in _ROWS.items():
        if not observed.get(group):
            continue
        try:
            trials = collect_trials(observed[group], maps.length_m, maps.strain_map, steps)
        except InputError as refusal:
            why = f"step trials {group!r}: {refusal}"
            missing |= {f"{row}.rise_{name}": why, f"{row}.error_{name}": why}
            continue
        known = trials if pi is None else pi
        rise, error = (
            _like(trials.metrics.trials, known.metrics.trials, which)
            for which in ("rise_time_s", "steady_state_error")
        )
        quantities |= {
            f"{row}.rise_{name}": with_camera_resolution(rise, steps, strain_per_px),
            f"{row}.error_{name}": with_camera_resolution(
                error, steps, strain_per_px, maps.zero_px
            ),
        }
        note = _scatter_note(len(trials.strain), 0 if pi is None else len(pi.strain))
        notes |= {f"{row}.rise_{name}": note, f"{row}.error_{name}": note}
        drawn[group] = {
            "time_s": trials.time_s - steps.zero_s,
            "desired": trials.reference,
            "strain": trials.strain.mean(axis=0),
        }
    if observed.get("saturating"):
        seen = observed["saturating"][0]
        quantities |= _saturation(seen, maps, loops, study)
        drawn["saturating"] = {
            "time_s": seen.frame_time_s - seen.block_start_s[0] - steps.zero_s,
            "desired": np.interp(seen.frame_time_s, seen.block_start_s, seen.reference),
            "strain": seen.length_m / maps.length_m - 1.0,
            "drive_v": np.interp(seen.frame_time_s, seen.block_start_s, seen.drive_v),
            "limit_v": _limit_v(maps, loops, study),
        }
    figures = {"further": drawn} if drawn else {}
    return ExperimentResult(quantities, notes, figures=figures, missing=missing)


def rows_without(lost: Mapping[str, str]) -> dict[str, str]:
    """Why results of further trials are missing, by id.

    Args:
        lost: why trials were not recorded, by group.
    """
    found: dict[str, str] = {}
    for group, (row, name) in _ROWS.items():
        if group in lost:
            found |= dict.fromkeys((f"{row}.rise_{name}", f"{row}.error_{name}"), lost[group])
    if "saturating" in lost:
        found |= dict.fromkeys(_SATURATED_ROWS, lost["saturating"])
    return found


def _scatter_note(trials: int, pi_trials: int) -> str:
    """Note about the interval of a few trials."""
    counted = "one trial" if trials == 1 else f"{trials} trials"
    if pi_trials > 1:
        return f"{counted}; scatter taken from the {pi_trials} PI trials"
    return (
        ONE_TRIAL
        if trials == 1
        else f"{counted}; the interval only includes the camera's resolution"
    )


def _like(trials: Sequence[StepNumbers], pi: Sequence[StepNumbers], name: str) -> Estimate:
    """Mean of a few trials, with the scatter of the paper's trials, which are more."""
    values, known = (
        np.array([getattr(numbers, name) for numbers in some]) for some in (trials, pi)
    )
    return over_trials(values, "s" if name.endswith("_s") else "", known)


def _limit_v(maps: Maps, loops: Loops, study: Study) -> float:
    """Drive at the limit towards which the saturating step goes, in V."""
    limits = loops.setting.saturation
    strain = limits.high if study.steps.saturating_step > 0.0 else limits.low
    return float(maps.voltage_map.voltage_v(strain))


def _saturation(seen: Observation, maps: Maps, loops: Loops, study: Study) -> dict[str, Estimate]:
    """Time of the output at its limit, and time to leave it after the reference returned."""
    limit_v = _limit_v(maps, loops, study)
    at_limit = seen.drive_v >= limit_v - _AT_LIMIT_V
    reference = saturating_reference(study.steps)
    much = np.flatnonzero(reference == study.steps.saturating_step)
    back = much[-1] + 1
    stood = np.flatnonzero(at_limit[much])
    share = float(stood[-1] - stood[0] + 1) / much.size if stood.size else 0.0
    block_s = 1.0 / _UPDATE_HZ
    free = np.flatnonzero(~at_limit[back:])
    left_s = (float(free[0]) if free.size else math.nan) * block_s
    return {
        # From the first block at the limit to the last one; each end is known to one block.
        "S22.saturated_fraction": Estimate.normal(share, math.sqrt(2.0) / much.size, ""),
        "S22.recovery_time": Estimate(
            left_s + 0.5 * block_s, block_s / math.sqrt(12.0), (left_s, left_s + block_s), "s"
        ),
    }
