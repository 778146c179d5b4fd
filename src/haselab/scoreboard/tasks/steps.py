"""T1: steps at three bias voltages, and a large one from 0 V. T8: steps of other devices."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from haselab.base import ResultError
from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import fastest_step
from haselab.scoreboard.devices import Device, drawn, find_device
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.measures import step_response, variation_v_per_s
from haselab.scoreboard.play import Scenario, Trace
from haselab.scoreboard.tasks.task import Metric, Task, staircase

__all__ = ["RISE", "STEP_TASKS"]

_STEP = 0.04
_LARGE = 0.14
_SIZES = (0.02, 0.04, 0.10, -0.02, -0.04, -0.10)
_BIASES_V = (0.8, 1.04, 1.4)  # before the amplifier
_HOLD_S = 2.0
_FIRST_S = 3.0  # of each hold at a bias
_MARGIN = 0.005  # from the ends of the reachable range
_OTHER = 0.12  # step of another device, of its reachable range
_SLOW_S = 6.0

_FASTEST = (
    "time-optimal from rest to rest on the true law: full voltage, then 0 V. No dead time, no noise"
)
RISE = Metric("rise_s", "s", "rise time (10 to 90 %) of a step of 4 % strain at strain 0", _FASTEST)
OVERSHOOT = Metric(
    "overshoot", "", "overshoot of this step beyond the desired strain, as a fraction of the step"
)
SETTLING = Metric(
    "settling_s", "s",
    "time after which this step stays within 2 % of the step around the desired strain", _FASTEST,
)  # fmt: skip
_ALL = (
    RISE,
    OVERSHOOT,
    SETTLING,
    Metric("rise_from_zero_s", "s", "rise time of a step of 14 % strain from 0 V", _FASTEST),
    Metric("worst_overshoot", "", "largest overshoot of all steps, as a fraction of the step"),
    Metric(
        "iae",
        "s",
        "integral of the absolute error during a step, divided by the size of the step; "
        "mean of all steps",
    ),
    Metric("drive_variation_v_per_s", "V/s", "sum of the changes of the drive, per second"),
    Metric("peak_field_v_per_m", "V/m", "largest field"),
)


def _plan(known: KnownActuator) -> list[tuple[float, float, float]]:
    """Time, strain before and strain after of each step; the large one from 0 V comes first."""
    low, high = known.reachable()
    at_s, found = 0.0, [(0.0, low, low + _LARGE)]
    at_s += 2.0 * _HOLD_S
    for bias_v in _BIASES_V:
        bias = _static_strain(known, bias_v)
        at_s += _FIRST_S
        for size in _SIZES:
            if low + _MARGIN <= bias + size <= high - _MARGIN:
                found += [(at_s, bias, bias + size), (at_s + _HOLD_S, bias + size, bias)]
                at_s += 2.0 * _HOLD_S
    return found


def _static_strain(known: KnownActuator, drive_v: float) -> float:
    """Strain that a drive holds."""
    strains = np.linspace(*known.reachable(), 400)
    drives_v = np.array([known.static_drive_v(float(strain)) for strain in strains])
    return float(np.interp(drive_v, drives_v, strains))


def _scenario(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    steps = _plan(known)
    points = [(-math.inf, steps[0][1])]
    for at_s, before, after in steps:
        if points[-1][1] != before:
            points.append((at_s - _FIRST_S, before))
        points.append((at_s, after))
    duration_s = steps[-1][0] + _HOLD_S
    return Scenario(
        find_device("hz"), known.zero_length_m, duration_s, staircase(tuple(points)),
        events=tuple(steps),
    )  # fmt: skip


def _score(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    found = [
        (before, after, step_response(trace, at_s, _HOLD_S, before, after))
        for at_s, before, after in scenario.events
    ]
    chosen = next(
        score for before, after, score in found[1:]
        if abs(before) < 1e-2 and abs(after - before - _STEP) < 1e-9
    )  # fmt: skip
    error = np.abs(trace.strain - scenario.reference(trace.time_s))
    iae = []
    for at_s, before, after in scenario.events:
        first, last = np.searchsorted(trace.time_s, [at_s, at_s + _HOLD_S])
        iae.append(float(error[first:last].sum()) * 1e-3 / abs(after - before))
    return {
        "rise_s": chosen.rise_s,
        "overshoot": chosen.overshoot,
        "settling_s": chosen.settling_s,
        "rise_from_zero_s": found[0][2].rise_s,
        "worst_overshoot": float(np.max([score.overshoot for _, _, score in found])),
        "iae": float(np.mean(iae)),
        "drive_variation_v_per_s": variation_v_per_s(trace),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _bounds(known: KnownActuator, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    step = fastest_step(known, 0.0, _STEP)
    low, _ = known.reachable()
    return {
        "rise_s": step.rise_s,
        "settling_s": step.time_s,
        "rise_from_zero_s": fastest_step(known, low, low + _LARGE).rise_s,
    }


# ---- other devices -------------------------------------------------------------------------------


def _size(known: KnownActuator) -> float:
    """Step of another device, away from the strain without drive."""
    low, high = known.reachable()
    return (1.0 if known.elongates else -1.0) * _OTHER * (high - low)


def _other(name: str, hold_s: float) -> Callable[[KnownActuator, np.random.Generator], Scenario]:
    """Scenario of a step and back, on the device of this name or on a drawn one."""

    def scenario(known: KnownActuator, rng: np.random.Generator) -> Scenario:
        device: Device = drawn(rng) if name == "drawn" else find_device(name)
        size = _size(known)
        events = ((0.0, 0.0, size), (hold_s, size, 0.0))
        return Scenario(
            device, known.zero_length_m, 2.0 * hold_s,
            staircase(((-math.inf, 0.0), (0.0, size), (hold_s, 0.0))), events=events,
        )  # fmt: skip

    return scenario


def _score_other(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    (at_s, before, after), (back_s, _, _) = scenario.events
    score = step_response(trace, at_s, back_s - at_s, before, after)
    return {
        "rise_s": score.rise_s,
        "overshoot": score.overshoot,
        "settling_s": score.settling_s,
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _bounds_other(known: KnownActuator, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    try:
        step = fastest_step(known, 0.0, _size(known))
    except ResultError:
        return {}
    return {"rise_s": step.rise_s, "settling_s": step.time_s}


def _task(name: str, title: str, device: str, played: str, hold_s: float) -> Task:
    metrics = (
        Metric("rise_s", "s", "rise time (10 to 90 %) of a step of 12 % of the range", _FASTEST),
        OVERSHOOT,
        SETTLING,
        Metric("peak_field_v_per_m", "V/m", "largest field"),
    )
    return Task(name, title, device, metrics, _other(played, hold_s), _score_other, _bounds_other,
                drawn=played == "drawn")  # fmt: skip


STEP_TASKS = (
    Task("T1", "steps at three bias voltages", "hz", _ALL, _scenario, _score, _bounds),
    _task("T8-rad", "step with 9.3 kg of inertia", "rad", "rad", _SLOW_S),
    _task("T8-retention", "step with charge that acts late", "hz", "retention", _HOLD_S),
    _task("T8-hysteresis", "step with rate-independent hysteresis", "hz", "hysteresis", _HOLD_S),
    _task("T8-warming", "step while the permittivity drifts", "hz", "warming", _HOLD_S),
    _task("T8-resonance", "step with a second resonance", "hz", "second-resonance", _HOLD_S),
    _task("T8-stack", "step of a dielectric elastomer stack", "dea-stack", "dea-stack", _HOLD_S),
    _task("T8-peano", "step of a Peano-HASEL", "peano-hasel", "peano-hasel", _HOLD_S),
    _task("T8-drawn", "step of devices drawn about hz", "hz", "drawn", _HOLD_S),
)
