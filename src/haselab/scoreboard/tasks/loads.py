"""T4: changes of the load while a strain is held. T5: an unknown weight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import fastest_step, least_peak, weight_error_kg
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.measures import (
    load_response,
    smoothed,
    step_response,
    variation_v_per_s,
)
from haselab.scoreboard.play import Scenario, Trace
from haselab.scoreboard.tasks.steps import RISE
from haselab.scoreboard.tasks.task import Metric, Task, no_bounds, sensed_noise, staircase

__all__ = ["LOAD_TASKS"]

_LAST_S = 3.0
_LOW = -0.03  # strain at which a fifth more weight leaves nothing for the drive to do
_ADDED, _LARGE = 0.1, 0.2  # of the mass
_PEAK_LIMIT = (
    "the voltage stays for one update and the delay of the output, then goes to its extreme value "
    "until the motion has stopped. Law known, no noise"
)


def _scenario(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    mass, t = known.mass_kg, _LAST_S
    loads = (
        (0.0, (1.0 + _ADDED) * mass), (t, mass), (2.0 * t, (1.0 - _ADDED) * mass), (3.0 * t, mass),
        (5.0 * t, (1.0 + _LARGE) * mass), (6.0 * t, mass),
    )  # fmt: skip
    points = ((-math.inf, 0.0), (4.0 * t, _LOW))
    return Scenario(find_device("hz"), known.zero_length_m, 7.0 * t, staircase(points), loads=loads)


def _score(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    changes = [load_response(trace, at_s, _LAST_S) for at_s, _ in scenario.loads]
    return {
        "peak": changes[0][0],
        "recovery_s": changes[0][1],
        "worst_peak": float(np.max([peak for peak, _ in changes[:4]])),
        "worst_recovery_s": float(np.max([back_s for _, back_s in changes[:4]])),
        "recovery_saturated_s": _after_saturation(trace, scenario.loads[5][0]),
        "drive_variation_v_per_s": variation_v_per_s(trace),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _after_saturation(trace: Trace, at_s: float) -> float:
    """Time until the strain is back once the drive can hold it again."""
    _, strain = trace.between(at_s, at_s + _LAST_S)
    if strain.size < round(0.9 * _LAST_S / 1e-3):
        return math.nan
    outside = np.flatnonzero(np.abs(smoothed(strain) - _LOW) > 2e-3)
    back = int(outside[-1]) + 1 if outside.size else 0
    return back * 1e-3 if back < 0.9 * strain.size else math.nan


def _bounds(known: KnownActuator, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    added_kg = _ADDED * known.mass_kg
    peaks = [least_peak(known, 0.0, sign * added_kg, loop.dead_s) for sign in (1.0, -1.0)]
    return {"peak": peaks[0], "worst_peak": max(peaks)}


# ---- an unknown weight ---------------------------------------------------------------------------

_WEIGHT_LIMIT = (
    "Cramer-Rao bound of a weight whose change is the only unknown, with white noise of the sensed "
    "length; as the median of the absolute error. Law, motion before and drives known"
)
_GRAMS_KG = 0.025
_WEIGHED_S, _STEP_S, _STEP = 4.0, 8.0, 0.04
_LIGHTEST, _HEAVIEST = 0.7, 1.6  # of the known mass
_SHARE = 0.3  # of the new mass's own range, where the step begins


def _weights(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    mass = known.mass_kg
    new_kg = mass * float(rng.uniform(_LIGHTEST, _HEAVIEST))
    low, high = known.reachable(new_kg)
    before = low + _SHARE * (high - low)
    points = ((-math.inf, 0.0), (_WEIGHED_S, before), (_STEP_S, before + _STEP))
    loads = ((0.0, mass + _GRAMS_KG), (_WEIGHED_S, new_kg))
    events = ((_STEP_S, before, before + _STEP),)
    return Scenario(find_device("hz"), known.zero_length_m, _STEP_S + _LAST_S,
                    staircase(points), loads=loads, events=events)  # fmt: skip


def _score_weights(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    new_kg = scenario.loads[1][1]

    def estimate(at_s: float) -> float:
        """Mean over the 20 ms before."""
        first, last = np.searchsorted(trace.update_s, [at_s - 0.02, at_s - 1e-9])
        return float(trace.estimated_kg[first:last].mean()) if last > first else math.nan

    before_kg, (at_s, before, after) = estimate(0.0), scenario.events[0]
    step = step_response(trace, at_s, _LAST_S, before, after)
    return {
        "change_error_0p2s_kg": abs(estimate(0.2) - before_kg - _GRAMS_KG),
        "change_error_1s_kg": abs(estimate(1.0) - before_kg - _GRAMS_KG),
        "mass_error": abs(estimate(_STEP_S) / new_kg - 1.0),
        "rise_s": step.rise_s,
        "overshoot": step.overshoot,
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _bounds_weights(
    known: KnownActuator, scenario: Scenario, loop: LoopClass
) -> Mapping[str, float]:
    (at_s, before, after), new_kg = scenario.events[0], scenario.loads[1][1]
    heavy = replace(known, mass_kg=new_kg)
    found = {"rise_s": fastest_step(heavy, before, after).rise_s}
    sensed_s = loop.period_s * np.arange(1.0, at_s / loop.period_s) - loop.sensed_before_s

    def limit(held: KnownActuator, strain: float, until_s: float) -> float:
        noise = sensed_noise(held, scenario, loop, strain)
        return weight_error_kg(held, strain, noise, sensed_s[sensed_s < until_s])

    if sensed_noise(known, scenario, loop, 0.0) > 0.0:
        found |= {
            "change_error_0p2s_kg": limit(known, 0.0, 0.2),
            "change_error_1s_kg": limit(known, 0.0, 1.0),
            # where it hangs then: a heavier weight moves the actuator more for each gram
            "mass_error": limit(heavy, before, at_s - _WEIGHED_S) / new_kg,
        }
    return found


# ---- weights over the whole range ----------------------------------------------------------------

_WIDE_S = 3.0  # of each set-point
_NEAR = 2e-3  # strain
_REST = 0.2  # of the time at a set-point, at its end
_LIGHT, _HEAVY = (0.5, 0.7), (1.6, 2.0)  # of the known mass
_WIDE = (  # part of the weights, desired strain: some of them out of reach
    ("known", 0.03), ("light", 0.0), ("light", 0.2), ("known", 0.1), ("heavy", 0.1),
    ("heavy", 0.25), ("heavy", 0.55), ("known", 0.03),
)  # fmt: skip


def _wide(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    mass = known.mass_kg
    weights = {"known": mass, "light": mass * float(rng.uniform(*_LIGHT)),
               "heavy": mass * float(rng.uniform(*_HEAVY))}  # fmt: skip
    steps = [(k * _WIDE_S, weights[name], strain) for k, (name, strain) in enumerate(_WIDE)]
    points = ((-math.inf, 0.03), *((at_s, strain) for at_s, _, strain in steps))
    loads = tuple((at_s, mass_kg) for at_s, mass_kg, _ in steps)
    events = tuple((at_s, math.nan, strain) for at_s, _, strain in steps)
    return Scenario(find_device("hz"), known.zero_length_m, _WIDE_S * len(steps),
                    staircase(points), loads=loads, events=events)  # fmt: skip


def _score_wide(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    """Of the set-points that the true device can hold with the weight."""
    true = true_actuator(scenario.device)
    errors, times_s, beyond = [], [], []
    for (at_s, mass_kg), (_, _, wanted) in zip(scenario.loads, scenario.events, strict=True):
        low, high = true.reachable(mass_kg)
        _, strain = trace.between(at_s, at_s + _WIDE_S)
        if strain.size < round(0.9 * _WIDE_S / 1e-3):
            return {}
        if low < wanted < high:
            strain = smoothed(strain)
            away, start = np.abs(strain - wanted), float(strain[0])
            errors.append(float(away[-round(_REST * away.size) :].mean()))
            outside = np.flatnonzero(away > _NEAR)
            times_s.append((int(outside[-1]) + 1 if outside.size else 0) * 1e-3)
            beyond.append(float(strain.max()) - max(start, wanted))
            beyond.append(min(start, wanted) - float(strain.min()))
    return {
        "error_at_rest": max(errors),
        "slowest_s": max(times_s) if max(times_s) < 0.9 * _WIDE_S else math.nan,
        "beyond": max(beyond),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


LOAD_TASKS = (
    Task(
        "T5", "an unknown weight, then a step", "hz",
        (
            Metric("change_error_0p2s_kg", "kg",
                   "error of the estimated change by 25 g after 0.2 s", _WEIGHT_LIMIT),
            Metric("change_error_1s_kg", "kg", "error of the estimated change by 25 g after 1 s",
                   _WEIGHT_LIMIT),
            Metric("mass_error", "", "relative error of the estimated weight after 4 s",
                   _WEIGHT_LIMIT),
            Metric("rise_s", "s", "rise time of a step of 4 % strain with this weight", RISE.limit),
            Metric("overshoot", "", "overshoot of this step, as a fraction of the step"),
            Metric("peak_field_v_per_m", "V/m", "largest field"),
        ),
        _weights, _score_weights, _bounds_weights,
    ),
    Task(
        "T5-wide", "half to twice the weight, set-points out of reach", "hz",
        (
            Metric("error_at_rest", "",
                   "largest mean error at the end of a set-point that can be held (strain)"),
            Metric("slowest_s", "s",
                   "longest time until the strain stays within 0.2 % of such a set-point"),
            Metric("beyond", "",
                   "largest strain beyond the range between the start and such a set-point"),
            Metric("peak_field_v_per_m", "V/m", "largest field"),
        ),
        _wide, _score_wide, no_bounds,
    ),
    Task(
        "T4", "changes of the load", "hz",
        (
            Metric("peak", "", "largest deviation after 10 % more weight (strain)", _PEAK_LIMIT),
            Metric("recovery_s", "s", "time until it stays within 0.1 % strain"),
            Metric("worst_peak", "", "largest deviation of four changes by 10 % (strain)",
                   _PEAK_LIMIT),
            Metric("worst_recovery_s", "s", "longest time of these four until within 0.1 % strain"),
            Metric("recovery_saturated_s", "s", "time until within 0.2 % strain after saturation"),
            Metric("drive_variation_v_per_s", "V/s", "sum of the changes of the drive, per second"),
            Metric("peak_field_v_per_m", "V/m", "largest field"),
        ),
        _scenario, _score, _bounds,
    ),
)  # fmt: skip
