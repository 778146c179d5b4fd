"""Automatic design of the observer with inverse dynamics, and its kind."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from haselab.actuators import GRAVITY_M_S2
from haselab.base import ResultError
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
from haselab.controllers.observer import ObserverController
from haselab.controllers.observer_law import ObserverLaw
from haselab.controllers.protocol import ControllerSetting

__all__ = [
    "OBSERVER",
    "RESERVE",
    "SHAKE_M_S2",
    "best_parameters",
    "design_observer",
    "linear_loop",
]

Floats = NDArray[np.float64]
_PREVIEW_S = 0.05
_FREE = -math.inf, math.inf
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
# stiffness; longer delay, of the stated one; peak sensitivity
_SPREAD = ((1.1, 0.0, 2.5), (0.9, 0.2, 2.5), (1.0, 0.5, 5.0))
_SPEEDS = (0.1, 0.3, 0.8)  # of the delay: bandwidths from which the search starts
_SHAKEN = 0.04  # of the highest drive, by noise
_COUNTED_S = 0.5  # after a change of the load
_CHANGED = 1.0  # of the highest change of the drive in one update, by noise
_MOVED = 1.5
SHAKE_M_S2, RESERVE = 0.01, 0.15


def design_observer(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose bandwidth and expected load so that a change of load is rejected best.

    Minimises the integral of time times the squared error after a step of the load, over three
    strains of the reachable range. The peak sensitivity is at most 2.5 with the stiffness 10 %
    higher, and with it 10 % lower and the delay a fifth longer; at most 5 with the delay longer
    by half. Noise moves the actuator by at most 1.5 times the noise of the sensed length, the drive
    by at most 4 % of its range and from one update to the next by at most what the loop allows
    (standard deviations).

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `ObserverController`.
    Raises:
        ResultError: No parameters keep the loop stable, or meet all demands within 5 %.
    """
    OBSERVER.check(setting)
    return dict(_design(setting))


@functools.lru_cache(maxsize=8)  # kinds with an inner observer take the same design
def _design(setting: ControllerSetting) -> Mapping[str, float]:
    known = setting.actuator
    assert known is not None
    low, high = known.reachable()
    strains = [low + share * (high - low) for share in _POINTS]
    delay_s = (setting.delay_s or 0.0) + 0.5 * setting.period_s
    allowed_v = setting.highest_rate_per_s * setting.period_s

    any_law = ObserverLaw(setting, 1.0 / delay_s, known.mass_kg * GRAVITY_M_S2, SHAKE_M_S2)
    motions: _Motions = {}

    def loops(bandwidth: float, load_n: float) -> Iterator[tuple[LinearLoop, Demands]]:
        law, known_steps = any_law.tuned(bandwidth, load_n), _Steps({}, motions)
        for strain in strains:
            noise_m = known.length_noise_m(strain)
            for stiffness, longer, peak in _SPREAD:
                demands = Demands(
                    noise_m, _SHAKEN * known.high_v, peak, _MOVED, _CHANGED * allowed_v
                )
                other = stiffness, longer * delay_s
                yield linear_loop(law, setting, strain, other, known_steps), demands

    # beyond, limits of the drive hide what the feedback does
    return best_parameters(loops, setting, evaluations=60, fastest_rad_s=1.0 / delay_s)


def best_parameters(
    loops: Callable[[float, float], Iterable[tuple[LinearLoop, Demands]]],
    setting: ControllerSetting,
    *,
    evaluations: int,
    fastest_rad_s: float = math.inf,
) -> Mapping[str, float]:
    """Search bandwidth and expected load of an observer.

    Args:
        loops: by both, all that must keep their demands and reject a load.
        setting: timing of the loop, and the actuator.
        evaluations: at most.
        fastest_rad_s: highest bandwidth.
    Raises:
        ResultError: No parameters keep the loop stable, or meet all demands within 5 %.
    """
    known = setting.actuator
    assert known is not None
    delay_s = (setting.delay_s or 0.0) + 0.5 * setting.period_s

    def cost(logarithms: Floats) -> float:
        bandwidth, load_n = np.exp(logarithms).tolist()
        if bandwidth > fastest_rad_s:
            return float(2.0 * UNSTABLE * bandwidth / fastest_rad_s)
        total = 0.0
        for loop, demands in loops(bandwidth, load_n):
            factor = penalty(loop, setting.period_s, demands)
            if factor > UNSTABLE:
                return factor
            total += factor * timed_error(loop, setting.period_s, _COUNTED_S)
        return total

    load_n = 0.1 * known.mass_kg * GRAVITY_M_S2
    slow, *fast = [np.log([speed / delay_s, load_n]) for speed in _SPEEDS]
    options = {"maxfev": evaluations, "xatol": 0.02, "fatol": 1e-9}
    found = minimize(cost, slow, method="Nelder-Mead", options=options)
    faster_cost, faster = min((cost(one), one.tolist()) for one in fast)
    if faster_cost < found.fun:  # the search was caught in a local minimum
        found = minimize(cost, faster, method="Nelder-Mead", options=options)
    if found.fun > UNSTABLE:
        raise ResultError(
            f"No gains of the observer are stable with a delay of {setting.delay_s or 0.0:g} s. "
            "Shorten the delay."
        )
    bandwidth, load_n = np.exp(found.x).tolist()
    refuse_missed(
        [shares_of(loop, setting.period_s, demands) for loop, demands in loops(bandwidth, load_n)],
        "parameters of the observer", setting.period_s,
        "Shorten the delay, or use a sensor with less noise.",
    )  # fmt: skip
    return {"bandwidth_rad_s": float(f"{bandwidth:.4g}"), "load_n": float(f"{load_n:.4g}"),
            "shake_m_s2": SHAKE_M_S2, "reserve": RESERVE}  # fmt: skip


# by what they depend on
_Updates = dict[tuple[float, ...], tuple[list[float], float]]
_Motions = dict[tuple[float, ...], list[float]]


@dataclass(frozen=True)
class _Steps:
    """Steps that were computed before, since the loops of a design share many.

    Args:
        updates: of one law: state of the observer and new drive.
        motions: of one actuator, whatever the law: its state after an update.
    """

    updates: _Updates
    motions: _Motions


class _Joint:
    """Actuator and observer as one system, about the rest at a strain.

    Args:
        law: of observer and feedback.
        setting: of the loop.
        strain: held.
        other: stiffness of the actuator over the identified one; delay beyond the stated one, s.
        known_steps: of other loops with this law or this actuator.
    """

    def __init__(
        self, law: ObserverLaw, setting: ControllerSetting, strain: float,
        other: tuple[float, float], known_steps: _Steps,
    ) -> None:  # fmt: skip
        known, period_s = setting.actuator, setting.period_s
        assert known is not None
        self._law, self._length_m = law, known.length_m(strain)
        self._steps, self._case = known_steps, (strain, *other)
        drive_v = known.static_drive_v(strain)
        self._plant = law.model.stiffened(self._length_m, other[0])
        rest = law.model.at_rest(self._length_m, drive_v)
        self._whole = int((law.delay_s + other[1]) / period_s + 1e-9)
        self._late_s = law.delay_s + other[1] - self._whole * period_s
        self._period_s, self._load_n = period_s, rest[-1]
        self.size = len(rest)
        self.waiting = max(self._whole, law.whole) + 2
        self.start = np.array([*rest[:-1], *rest, *[drive_v] * self.waiting])

    def after(self, change: Floats, load_n: float, noise_m: float, added_v: float) -> Floats:
        """The states after one update, from a change of those at rest."""
        moved, size = (self.start + change).tolist(), self.size
        true = [*moved[: size - 1], self._load_n + load_n]
        seen, past_v = moved[size - 1 : 2 * size - 1], moved[2 * size - 1 :]
        seen, new_v = self._updated(seen, past_v, true[0] + noise_m)
        past_v = [new_v, *past_v[:-1]]
        before_v, after_v = (past_v[self._whole + k] + added_v for k in (1, 0))
        return np.array([*self._moved(true, before_v, after_v)[:-1], *seen, *past_v])

    def _updated(
        self, seen: list[float], past_v: list[float], sensed_m: float
    ) -> tuple[list[float], float]:
        """State of the observer after an update, and the new drive."""
        law, updates = self._law, self._steps.updates
        used_v = past_v[: law.whole + 2]
        key = (self._length_m, sensed_m, *seen, *used_v)
        if key not in updates:
            found = law.observed(seen, used_v, sensed_m)
            ahead = law.ahead(found, used_v)
            updates[key] = found, law.drive_v(ahead, (self._length_m, 0.0, 0.0), _FREE)
        return updates[key]

    def _moved(self, true: list[float], before_v: float, after_v: float) -> list[float]:
        """State of the actuator after an update, during which the drive changes."""
        motions, late_s = self._steps.motions, self._late_s
        key = (*self._case, *true, before_v, after_v)
        if key not in motions:
            begun = self._plant.moved(true, before_v, late_s)
            motions[key] = self._plant.moved(begun, after_v, self._period_s - late_s)
        return motions[key]


def linear_loop(
    law: ObserverLaw,
    setting: ControllerSetting,
    strain: float,
    other: tuple[float, float],
    known_steps: _Steps | None = None,
) -> LinearLoop:
    """The closed loop where it holds a strain, by central differences, its rate limit apart.

    Args:
        law: of observer and feedback.
        setting: of the loop.
        strain: held.
        other: stiffness of the actuator over the identified one; delay beyond the stated one, s.
        known_steps: of other loops with this law or this actuator, which are added to; None: none.
    """
    joint = _Joint(law, setting, strain, other, known_steps or _Steps({}, {}))
    small = [1e-7, 1e-5, *[1e-4] * (joint.size - 3)]  # m, m/s, N
    scales = [*small, *small, 1e-4, *[1e-5] * joint.waiting]
    none = np.zeros(len(scales))

    def slope(change: Floats, scale: float, *inputs: float) -> Floats:
        ends = [joint.after(k * change, *(k * value for value in inputs)) for k in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]) / (2.0 * scale))

    a = np.stack(
        [
            slope(np.where(np.arange(none.size) == k, scale, 0.0), scale, 0.0, 0.0, 0.0)
            for k, scale in enumerate(scales)
        ],
        axis=1,
    )
    noise = slope(none, 1e-7, 0.0, 1e-7, 0.0)
    newest, length = 2 * joint.size - 1, none.copy()
    length[0] = 1.0
    return LinearLoop(
        a, slope(none, 1e-4, 1e-4, 0.0, 0.0), noise, slope(none, 1e-5, 0.0, 0.0, 1e-5), length,
        a[newest].copy(), float(noise[newest]),
    )  # fmt: skip


OBSERVER = ControllerKind(
    "observer",
    ObserverController,
    (
        Parameter("bandwidth_rad_s", "rad/s", None, 1e-3, 1e4),
        Parameter("load_n", "N", None, 1e-9, 1e6),
        Parameter("shake_m_s2", "m/s^2", SHAKE_M_S2, 1e-9, 1e6),
        Parameter("reserve", "", RESERVE, 0.0, 0.9),
    ),
    output="voltage",
    needs_actuator=True,
    design=design_observer,
    preview_s=_PREVIEW_S,
)
