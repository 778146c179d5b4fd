"""Automatic design of the H-infinity loop shaping, its robustness, and its kind."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.base import LimitError, ResultError
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.linear_loop import (
    UNSTABLE,
    Demands,
    LinearLoop,
    penalty,
    refuse_missed,
    shares_of,
    timed_error,
)
from haselab.controllers.model_based.coprime import guaranteed_margins
from haselab.controllers.model_based.h_infinity import (
    HInfinityController,
    Synthesis,
    synthesis,
)
from haselab.controllers.observer_design import RESERVE
from haselab.controllers.protocol import ControllerSetting
from haselab.controllers.sampled_point import SampledPoint, sampled_point

__all__ = ["H_INFINITY", "design_h_infinity", "loop_of", "robustness_of"]

Floats = NDArray[np.float64]
_NAMES = ("gain_n_per_m", "integral_rad_s", "lead_rad_s")
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
# stiffness; longer delay, of the stated one; peak sensitivity
_SPREAD = ((1.1, 0.0, 2.5), (0.9, 0.2, 2.5), (1.0, 0.5, 5.0))
_LEAST_EPSILON = 0.25
_MOVED, _SHAKEN, _CHANGED = 1.5, 0.04, 1.0  # see `design_observer`
_COUNTED_S = 0.5
_EVALUATIONS = 120


def design_h_infinity(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose the weight that rejects a change of load best, with a stability margin of 0.25.

    Minimises the integral of time times the squared error after a step of the load, over three
    strains of the reachable range. The stability margin in the middle of the range is at least
    0.25, which guarantees a gain margin of 4.4 dB and a phase margin of 29 degrees. The peak
    sensitivity is at most 2.5 with the stiffness 10 % higher, and with it 10 % lower and the delay
    a fifth longer; at most 5 with the delay longer by half. Noise does at most what `observer`
    permits.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `HInfinityController`.
    Raises:
        ResultError: No weight keeps the loop stable, or all demands.
    """
    H_INFINITY.check(setting)
    known = setting.actuator
    assert known is not None
    points = _points(setting)
    inertia = known.mass_kg + known.added_inertia_kg + known.law.moving_mass_kg
    fast = 0.5 / _dead_s(setting)

    def cost(logs: Floats) -> float:
        values = dict(zip(_NAMES, np.exp(logs).tolist(), strict=True))
        try:
            found = synthesis(setting, values)
        except ResultError:
            return math.inf
        missed, total = max(_LEAST_EPSILON / found.epsilon - 1.0, 0.0), 0.0
        for point, peak in points:
            loop = loop_of(point, found)
            factor = penalty(loop, setting.period_s, _demands(setting, point, peak), missed)
            if factor > UNSTABLE:
                return factor
            total += factor * timed_error(loop, setting.period_s, _COUNTED_S)
        return total

    start = np.log([0.7 * inertia * fast**2, 0.3 * fast, fast])
    best = minimize(cost, start, method="Nelder-Mead",
                    options={"maxfev": _EVALUATIONS, "xatol": 0.02, "fatol": 1e-9})  # fmt: skip
    if not best.fun < UNSTABLE:
        raise ResultError(
            f"No weight of the loop shaping gives a stable loop with a dead time of "
            f"{_dead_s(setting):g} s (delay and half an update). Shorten the delay."
        )
    found = {name: float(f"{value:.4g}")
             for name, value in zip(_NAMES, np.exp(best.x).tolist(), strict=True)}  # fmt: skip
    designed = synthesis(setting, found)
    shares = [
        shares_of(loop_of(point, designed), setting.period_s, _demands(setting, point, peak))
        for point, peak in points
    ]
    refuse_missed(
        [*shares, {"the inverse of the stability margin": _LEAST_EPSILON / designed.epsilon}],
        "weights of the loop shaping", setting.period_s,
        "Use the controller 'observer', or shorten the delay.",
    )  # fmt: skip
    return {**found, "reserve": RESERVE}


def robustness_of(setting: ControllerSetting, values: Mapping[str, float]) -> Mapping[str, float]:
    """Stability margin of the designed loop, and the margins that it guarantees.

    Args:
        setting: timing of the loop, and the actuator.
        values: parameters of the controller.
    Returns:
        `stability_margin` (epsilon), `guaranteed_gain_margin_db`, `guaranteed_phase_margin_deg`.
    Raises:
        ResultError: The equations have no solution.
    """
    epsilon = synthesis(setting, values).epsilon
    factor, phase_rad = guaranteed_margins(epsilon)
    return {
        "stability_margin": epsilon,
        "guaranteed_gain_margin_db": 20.0 * math.log10(factor),
        "guaranteed_phase_margin_deg": math.degrees(phase_rad),
    }


def loop_of(point: SampledPoint, found: Synthesis) -> LinearLoop:
    """The closed loop about a strain; the drive is the square of the voltage.

    Args:
        point: actuator.
        found: designed weight and controller.
    """
    k, per_v2 = found.feedback, point.pull_per_v2
    direct = (k.d - point.volt2 * point.pull_per_v2_m) / per_v2
    size, states = point.b.size, k.b.size
    drive = np.r_[direct * point.c, k.c / per_v2]
    a = np.zeros((size + states,) * 2)
    a[:size, :size] = point.a
    a[:size] += np.outer(point.b, drive)
    a[size:, :size], a[size:, size:] = np.outer(k.b, point.c), k.a
    none = np.zeros(states)
    return LinearLoop(
        a, np.r_[point.load, none], np.r_[direct * point.b, k.b], np.r_[point.b, none],
        np.r_[point.c, none], drive, direct,
    )  # fmt: skip


def _points(setting: ControllerSetting) -> list[tuple[SampledPoint, float]]:
    known = setting.actuator
    assert known is not None
    low, high = known.reachable()
    found = []
    for share in _POINTS:
        for stiffness, longer, peak in _SPREAD:
            try:
                point = sampled_point(
                    setting, low + share * (high - low), stiffness=stiffness,
                    later_s=longer * _dead_s(setting),
                )  # fmt: skip
            except LimitError:  # a strain near the end of the range
                continue
            found.append((point, peak))
    if not found:
        raise ResultError("The actuator has no equilibrium within its reachable range.")
    return found


def _dead_s(setting: ControllerSetting) -> float:
    return (setting.delay_s or 0.0) + 0.5 * setting.period_s


def _demands(setting: ControllerSetting, point: SampledPoint, peak: float) -> Demands:
    known = setting.actuator
    assert known is not None
    per_v2 = 0.5 / math.sqrt(point.volt2) / known.gain_v_per_v  # V of drive per V^2
    allowed_v = setting.highest_rate_per_s * setting.period_s
    return Demands(
        known.length_noise_m(point.strain), _SHAKEN * known.high_v / per_v2, peak, _MOVED,
        _CHANGED * allowed_v / per_v2,
    )  # fmt: skip


H_INFINITY = ControllerKind(
    "h-infinity",
    HInfinityController,
    (
        Parameter("gain_n_per_m", "N/m", None, 1e-9, 1e9),
        Parameter("integral_rad_s", "rad/s", None, 1e-6, 1e5),
        Parameter("lead_rad_s", "rad/s", None, 1e-3, 1e5),
        Parameter("reserve", "", RESERVE, 0.0, 0.9),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_h_infinity,
    robustness=robustness_of,
    preview_s=0.05,
)
