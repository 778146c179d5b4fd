"""Automatic design of the observer with inverse dynamics, and its kind."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.actuators import GRAVITY_M_S2
from haselab.base import ResultError
from haselab.controllers.kind import ControllerKind, Parameter
from haselab.controllers.linear_loop import UNSTABLE, Demands, cost
from haselab.controllers.observer import ObserverController
from haselab.controllers.protocol import ControllerSetting

__all__ = ["OBSERVER", "design_observer"]

Floats = NDArray[np.float64]
_PREVIEW_S = 0.05
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
_SPREAD = ((1.1, 0.0), (0.9, 2e-3))  # stiffness, later_s
_SHAKEN = 0.04  # of the highest drive, by noise
_CHANGED = 0.7  # of the highest change of the drive in one update, by noise
_SENSITIVITY = 2.3
_MOVED = 1.5
_SHAKE, _RESERVE = 0.01, 0.15


def design_observer(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose bandwidth and expected load so that a change of load is rejected best.

    Minimises the sum of squared errors after a step of the load, over three strains of the
    reachable range, with the stiffness 10 % lower and higher and the delay 2 ms longer. In each
    case the peak sensitivity is at most 2.3, and noise moves the actuator by at most 1.5 times the
    noise of the sensed length, the drive by at most 4 % of its range and from one update to the
    next by at most 0.7 of what the loop allows (standard deviations).

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `ObserverController`.
    Raises:
        ResultError: No parameters keep the loop stable.
    """
    OBSERVER.check(setting)
    known = setting.actuator
    assert known is not None
    low, high = known.reachable()
    strains = [low + share * (high - low) for share in _POINTS]
    weight_n = known.mass_kg * GRAVITY_M_S2
    delay_s = (setting.delay_s or 0.0) + 0.5 * setting.period_s
    allowed_v = setting.highest_rate_per_s * setting.period_s

    def of(values: Floats) -> float:
        bandwidth, load_n = np.exp(values).tolist()
        if bandwidth * delay_s > 1.0:  # beyond, limits of the drive hide what it does
            return 2.0 * UNSTABLE * bandwidth * delay_s
        controller = ObserverController(bandwidth, load_n, _SHAKE, _RESERVE)
        controller.start(setting)
        total = 0.0
        for strain in strains:
            demands = Demands(known.length_noise_m(strain), _SHAKEN * known.high_v, _SENSITIVITY,
                              _MOVED, _CHANGED * allowed_v)  # fmt: skip
            for stiffness, later_s in _SPREAD:
                loop = controller.linear_loop(strain, stiffness, later_s)
                total += cost(loop, setting.period_s, demands)
        return total

    start = np.log([0.4 / delay_s, 0.3 * weight_n])
    found = minimize(of, start, method="Nelder-Mead",
                     options={"maxfev": 60, "xatol": 0.02, "fatol": 1e-9})  # fmt: skip
    if found.fun > UNSTABLE:
        raise ResultError(
            f"No gains of the observer are stable with a delay of {setting.delay_s or 0.0:g} s. "
            "Shorten the delay."
        )
    bandwidth, load_n = np.exp(found.x).tolist()
    return {"bandwidth_rad_s": float(f"{bandwidth:.4g}"), "load_n": float(f"{load_n:.4g}"),
            "shake_m_s2": _SHAKE, "reserve": _RESERVE}  # fmt: skip


OBSERVER = ControllerKind(
    "observer",
    ObserverController,
    (
        Parameter("bandwidth_rad_s", "rad/s", None, 1e-3, 1e4),
        Parameter("load_n", "N", None, 1e-9, 1e6),
        Parameter("shake_m_s2", "m/s^2", _SHAKE, 1e-9, 1e6),
        Parameter("reserve", "", _RESERVE, 0.0, 0.9),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_observer,
    preview_s=_PREVIEW_S,
)
