"""T2: a staircase over the reachable range. T3: sines and a trapezoid gait."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import mean_error
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.measures import step_response, tracking_error
from haselab.scoreboard.play import Scenario, Trace
from haselab.scoreboard.tasks.task import (
    Metric,
    Task,
    sensed_noise,
    staircase,
    tracking_limit,
)

__all__ = ["GAIT", "TRACKING_LIMIT", "TRACKING_TASKS", "trapezoid"]

Floats = NDArray[np.float64]
_LOW, _HIGH, _STAIRS = -0.03, 0.21, 8
_STAIR_S = 3.0
_REST_S = 1.0  # at the end of a stair, whose mean error counts

_CENTRE = 0.03
_SINES = ((0.1, 0.03, 15.0), (1.0, 0.03, 6.0), (3.0, 0.03, 4.0), (5.0, 0.03, 4.0),
          (10.0, 0.015, 3.0))  # fmt: skip  # frequency, amplitude, duration
_FIRST_S = 1.0  # of each part, which does not count
_PAUSE_S = 1.0
TRACKING_LIMIT = (
    "least squares over a period with a force that is constant between updates and within the "
    "limits of the drive along the reference. Law and future known, no noise; at 100 Hz only"
)
GAIT = ((1.0, 6.0), (2.0, 6.0))  # frequency, duration


def _stairs() -> list[tuple[float, float, float]]:
    """Time, strain before and after of each stair, up and down."""
    up = np.linspace(_LOW, _HIGH, _STAIRS + 1).tolist()
    values = up + up[-2::-1]
    return [(_STAIR_S * k, values[k], values[k + 1]) for k in range(len(values) - 1)]


def _staircase(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    stairs = _stairs()
    points = ((-math.inf, _LOW), *((at_s, after) for at_s, _, after in stairs))
    return Scenario(
        find_device("hz"), known.zero_length_m, _STAIR_S * len(stairs), staircase(points),
        events=tuple(stairs),
    )  # fmt: skip


def _score_staircase(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    errors, noises, overshoots = [], [], []
    for at_s, before, after in scenario.events:
        _, rest = trace.between(at_s + _STAIR_S - _REST_S, at_s + _STAIR_S)
        whole = rest.size >= round(0.9 * _REST_S / 1e-3)
        errors.append(abs(float(rest.mean()) - after) if whole else math.nan)
        noises.append(float(rest.std()) if whole else math.nan)
        overshoots.append(step_response(trace, at_s, _STAIR_S, before, after).overshoot)
    return {
        "error_at_rest": float(np.max(errors)),
        "noise_at_rest": float(np.median(noises)),
        "overshoot": float(np.max(overshoots)),
        "peak_field_v_per_m": trace.peak_field_v_per_m,
    }


def trapezoid(time_s: Floats, frequency_hz: float, amplitude: float, ramp: float = 0.15) -> Floats:
    """A periodic trapezoid that begins at 0 and rises.

    Args:
        time_s: Shape `(N,)`.
        frequency_hz: of it.
        amplitude: half of its peak-to-peak value.
        ramp: duration of a ramp from one level to the other, in periods.
    Returns:
        Values. Shape `(N,)`.
    """
    phase = (time_s * frequency_hz + 0.5 * ramp) % 1.0
    corners = (0.0, ramp, 0.5, 0.5 + ramp, 1.0)
    return np.asarray(np.interp(phase, corners, amplitude * np.array([-1.0, 1.0, 1.0, -1.0, -1.0])))


def _parts() -> list[tuple[str, float, float, float, float]]:
    """Metric, beginning, duration, frequency and amplitude of each part; the gait has none."""
    found, at_s = [], 0.0
    for frequency_hz, amplitude, duration_s in _SINES:
        name = f"sine_{frequency_hz:g}hz".replace(".", "p")
        found.append((name, at_s, duration_s, frequency_hz, amplitude))
        at_s += duration_s + _PAUSE_S
    for frequency_hz, duration_s in GAIT:
        found.append((f"gait_{frequency_hz:g}hz", at_s, duration_s, frequency_hz, 0.03))
        at_s += duration_s + _PAUSE_S
    return found


def _waves(time_s: Floats) -> Floats:
    value = np.full(time_s.shape, _CENTRE)
    for name, at_s, duration_s, frequency_hz, amplitude in _parts():
        inside = (time_s >= at_s) & (time_s < at_s + duration_s)
        t = time_s[inside] - at_s
        gait = name.startswith("gait")
        value[inside] += (
            trapezoid(t, frequency_hz, amplitude) if gait
            else amplitude * np.sin(2.0 * np.pi * frequency_hz * t)
        )  # fmt: skip
    return value


def _tracking(known: KnownActuator, rng: np.random.Generator) -> Scenario:
    last = _parts()[-1]
    return Scenario(find_device("hz"), known.zero_length_m, last[1] + last[2], _waves)


def _score_tracking(trace: Trace, scenario: Scenario) -> Mapping[str, float]:
    wanted = scenario.reference(trace.time_s)
    found = {
        name: tracking_error(trace, wanted, at_s + _FIRST_S, at_s + duration_s)
        for name, at_s, duration_s, _, _ in _parts()
    }
    return found | {"peak_field_v_per_m": trace.peak_field_v_per_m}


def _bounds_staircase(
    known: KnownActuator, scenario: Scenario, loop: LoopClass
) -> Mapping[str, float]:
    noises = [sensed_noise(known, scenario, loop, strain) for _, _, strain in scenario.events]
    if min(noises) == 0.0:
        return {}
    return {"error_at_rest": mean_error(noises, _STAIR_S / loop.period_s)}


def _bounds_tracking(
    known: KnownActuator, scenario: Scenario, loop: LoopClass
) -> Mapping[str, float]:
    found = {}
    for name, at_s, _, frequency_hz, _ in _parts():
        if frequency_hz >= 1.0:
            limit = tracking_limit(known, scenario, loop, at_s + _FIRST_S)
            if limit is not None:
                found[name] = limit
    return found


TRACKING_TASKS = (
    Task(
        "T2", "staircase from -3 to 21 % strain", "hz",
        (
            Metric("error_at_rest", "", "largest error of the mean at the end of a stair (strain)",
                   "noise alone: the mean of all measurements of a stair, one constant unknown; "
                   "the median of the largest of all stairs"),
            Metric("noise_at_rest", "",
                   "standard deviation at the end of a stair, median of all (strain)"),
            Metric("overshoot", "", "largest overshoot of all stairs, as a fraction of the stair"),
            Metric("peak_field_v_per_m", "V/m", "largest field"),
        ),
        _staircase, _score_staircase, _bounds_staircase,
    ),
    Task(
        "T3", "sines of 0.1 to 10 Hz, gait at 1 and 2 Hz", "hz",
        (
            *(
                Metric(name, "", f"rms error over peak-to-peak, {name.partition('_')[0]} of "
                       f"{frequency_hz:g} Hz",
                       TRACKING_LIMIT if frequency_hz >= 1.0 else "")
                for name, _, _, frequency_hz, _ in _parts()
            ),
            Metric("peak_field_v_per_m", "V/m", "largest field"),
        ),
        _tracking, _score_tracking, _bounds_tracking,
    ),
)  # fmt: skip
