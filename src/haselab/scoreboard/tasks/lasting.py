"""T6: hold for ten minutes after a large step. T7: periodic work, ten iterations and more."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import mean_error
from haselab.scoreboard.devices import drawn, find_device
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.measures import smoothed, tracking_error
from haselab.scoreboard.play import Scenario, Trace
from haselab.scoreboard.tasks.task import (
    Metric,
    Task,
    no_bounds,
    sensed_noise,
    staircase,
    tracking_limit,
)
from haselab.scoreboard.tasks.tracking import TRACKING_LIMIT, trapezoid

__all__ = ["LASTING_TASKS"]

Floats = NDArray[np.float64]
_HOLD_S, _AFTER_S, _MEAN_S = 600.0, 10.0, 1.0
_SIZE = 0.10
_PERIODS, _CENTRE, _AMPLITUDE = 11, 0.03, 0.03


def _hold(device: str) -> Callable[[KnownActuator, np.random.Generator], Scenario]:
    """Scenario of a large step and ten minutes, on a device."""

    def scenario(known: KnownActuator, rng: np.random.Generator) -> Scenario:
        return Scenario(find_device(device), known.zero_length_m, _HOLD_S,
                        staircase(((-math.inf, 0.0), (0.0, _SIZE))))  # fmt: skip

    return scenario


def _score_hold(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    time_s, strain = trace.between(_AFTER_S, _HOLD_S)
    if time_s.size < round(0.99 * (_HOLD_S - _AFTER_S) / 1e-3):
        return {}
    means = smoothed(strain, _MEAN_S)
    return {
        "error": float(np.abs(means - _SIZE).max()),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


# ---- a drive of both signs, against retained charge ----------------------------------------------

_HELD_AT, _CHARGED_S, _BACK_S, _LOW = 0.06, 120.0, 20.0, -0.03
_AFTER_BACK_S = (0.5, 1.5)  # when the error after the way back is a mean


def _charged(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    points = ((-math.inf, 0.0), (0.0, _HELD_AT), (_CHARGED_S, _LOW))
    return Scenario(find_device("bipolar-retention"), known.zero_length_m, _CHARGED_S + _BACK_S,
                    staircase(points))  # fmt: skip


def _score_charged(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    time_s, strain = trace.between(_AFTER_S, _CHARGED_S)
    first, last = (_CHARGED_S + after_s for after_s in _AFTER_BACK_S)
    _, back = trace.between(first, last)
    if back.size < round(0.99 * (last - first) / 1e-3):
        return {}
    return {
        "error": float(np.abs(smoothed(strain, _MEAN_S) - _HELD_AT).max()),
        "noise_at_rest": float(strain[time_s > 0.5 * _CHARGED_S].std()),
        "error_after_return": abs(float(back.mean()) - _LOW),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _gait(time_s: Floats) -> Floats:
    wave = trapezoid(np.maximum(time_s, 0.0), 1.0, _AMPLITUDE)
    return np.asarray(_CENTRE + np.where(time_s >= 0.0, wave, 0.0))


def _periodic(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    return Scenario(find_device("hz"), known.zero_length_m, float(_PERIODS), _gait)


def _periodic_drawn(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    device = drawn(rng, senses_alike=True)
    return Scenario(device, known.zero_length_m, float(_PERIODS), _gait)


def _score_periodic(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    wanted = scenario.reference(trace.time_s)
    errors = [tracking_error(trace, wanted, float(k), k + 1.0) for k in range(_PERIODS)]
    return {
        "error_first": errors[0],
        "error_after_ten": errors[-1],
        "left": errors[-1] / errors[0],
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def _bounds_hold(known: KnownActuator, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    noise = sensed_noise(known, scenario, loop, _SIZE)
    return {"error": mean_error([noise], _AFTER_S / loop.period_s)} if noise > 0.0 else {}


def _bounds_periodic(
    known: KnownActuator, scenario: Scenario, loop: LoopClass
) -> Mapping[str, float]:
    limit = tracking_limit(known, scenario, loop, 1.0)
    return {} if limit is None else {"error_first": limit, "error_after_ten": limit}


_FIELD = Metric("peak_field_v_per_m", "V/m", "largest field")
_HELD = (
    Metric("error", "", "largest error of a mean over 1 s, from 10 s on (strain)",
           "noise alone: the mean of all measurements before, one constant unknown"),
    _FIELD,
)  # fmt: skip
_CHARGED = (
    Metric("error", "", "largest error of a mean over 1 s at 6 % strain, from 10 s on (strain)"),
    Metric("noise_at_rest", "", "standard deviation in the second half of the hold (strain)"),
    Metric("error_after_return", "", "mean error from 0.5 to 1.5 s after the way back (strain)"),
    _FIELD,
)
_REPEATED = (
    Metric("error_first", "", "rms error over peak-to-peak in the first period", TRACKING_LIMIT),
    Metric("error_after_ten", "", "rms error over peak-to-peak after ten periods", TRACKING_LIMIT),
    Metric("left", "", "error after ten periods over that in the first period"),
    _FIELD,
)

LASTING_TASKS = (
    Task("T6", "hold for 10 min after a step of 10 % strain", "hz", _HELD, _hold("hz"), _score_hold,
         _bounds_hold, classes=("host-100hz",)),
    Task("T6-retention", "the same with a fifth of the voltage acting late", "hz", _HELD,
         _hold("retention"), _score_hold, _bounds_hold, classes=("host-100hz",)),
    Task("T6-bipolar", "hold for 2 min, then back, retention on a drive of both signs", "bipolar",
         _CHARGED, _charged, _score_charged, no_bounds, classes=("host-100hz",)),
    Task("T7", "a trapezoid gait at 1 Hz, eleven times", "hz", _REPEATED, _periodic,
         _score_periodic, _bounds_periodic),
    Task("T7-drawn", "the same on devices drawn about hz that sense alike", "hz", _REPEATED,
         _periodic_drawn, _score_periodic, _bounds_periodic, drawn=True),
)  # fmt: skip
