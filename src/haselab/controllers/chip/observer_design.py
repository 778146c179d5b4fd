r"""Gains of the observer in integers, chosen on linear loops of the same law.

With lengths, times and forces in units of the tables, one update of the core is linear about a
rest, apart from its limits: it corrects $(\hat x, \hat v, \hat\Delta)$ by
$e = y - (\hat x - \lambda\hat v + \tfrac12\lambda^2\hat a)$ for the lag $\lambda$ of a
measurement, and puts out the square of the drive for the acceleration
$\hat a = -k_p\hat x - k_d\hat v$.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from haselab.base import ResultError
from haselab.controllers.chip.motion_record import MotionRecord, lag_of, motion_record
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.linear_loop import Demands, LinearLoop
from haselab.controllers.observer_design import RESERVE, SHAKE_M_S2, best_parameters
from haselab.controllers.observer_law import critical_feedback, process_noise
from haselab.controllers.protocol import ControllerSetting
from haselab.controllers.sampled_point import SampledPoint, sampled_point

__all__ = ["design_chip_observer", "feedback_gains", "linear_chip_loop", "steady_gains"]

Floats = NDArray[np.float64]
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
# stiffness; later_s; peak sensitivity
_SPREAD = ((1.1, 0.0, 2.5), (0.9, 0.5e-3, 2.5), (1.0, 5e-3, 6.0))
_SHAKEN = 0.06  # of the highest drive, by noise
_CHANGED, _MOVED = 1.0, 1.5
# Larger acceleration noise makes the observer faster: it rejects loads better, but passes more
# noise to the drive. If that is too much, the design takes `SHAKE_M_S2`.
_FAST_SHAKE_M_S2 = 0.04


def feedback_gains(
    motion: MotionRecord, bandwidth_rad_s: float, period_s: float
) -> tuple[float, float]:
    """Feedback of length and speed, in units of the tables.

    Args:
        motion: for its unit of time.
        bandwidth_rad_s: of the error's decay, critically damped.
        period_s: of an update.
    """
    per_x, per_v = critical_feedback(bandwidth_rad_s, period_s)
    return per_x * motion.unit_s**2, per_v * motion.unit_s


def steady_gains(
    motion: MotionRecord, setting: ControllerSetting, strain: float, load_n: float,
    shake_m_s2: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Gains of Kalman's filter for length, speed and load at rest, in units of the tables.

    Args:
        motion: tables and units.
        setting: of the loop, with the actuator.
        strain: at rest.
        load_n: change of the load that is expected in a second.
        shake_m_s2: unknown accelerations, in m/s^2 per root of hertz.
    """
    known, period_s = setting.actuator, setting.period_s
    assert known is not None
    width_m, step = known.zero_length_m * motion.span, period_s / motion.unit_s
    scale = np.array([1.0, motion.unit_s]) / width_m
    noise = np.zeros((3, 3))
    noise[:2, :2] = process_noise(shake_m_s2, period_s) * np.outer(scale, scale)
    noise[2, 2] = motion.acceleration_of(load_n, known.zero_length_m) ** 2 * period_s
    error = known.length_noise_m(strain) / width_m
    half = np.array([1.0, 0.5 * step, 0.0])
    accelerates = np.array([0.0, -motion.drag, 1.0]) - motion.slope_at(strain) * half
    speed = np.array([0.0, 1.0, 0.0]) + step * accelerates
    a = np.stack([half + 0.5 * step * speed, speed, [0.0, 0.0, 1.0]])
    lag, square = lag_of(motion, setting)
    seen = np.array([1.0, -lag, 0.0]) + square * accelerates
    p = solve_discrete_are(a.T, seen[:, None], noise / error**2, [[1.0]])
    x, v, load = (p @ seen / (seen @ p @ seen + 1.0)).tolist()
    return x, v, load


def linear_chip_loop(
    motion: MotionRecord, setting: ControllerSetting, point: SampledPoint,
    values: tuple[float, float, float],
) -> LinearLoop:  # fmt: skip
    """The closed loop where it holds a strain.

    Args:
        motion: tables and units.
        setting: of the loop, with the actuator.
        point: the actuator, as it really is; its input is the mean square of the voltage.
        values: `bandwidth_rad_s`, `load_n` and `shake_m_s2`.
    """
    known, period_s = setting.actuator, setting.period_s
    assert known is not None
    width_m, step = known.zero_length_m * motion.span, period_s / motion.unit_s
    full_v2 = (known.gain_v_per_v * motion.high_v) ** 2
    per_x, per_v = feedback_gains(motion, values[0], period_s)
    gain_x, gain_v, gain_load = steady_gains(motion, setting, point.strain, *values[1:])
    lag, square = lag_of(motion, setting)
    size = point.b.size
    # rows over the states of the actuator, those of the observer, and the noise in lengths
    x, v, load, a, noise = np.eye(size + 5)[size:]
    error = np.r_[point.c / width_m, np.zeros(5)] + noise - (x - lag * v + square * a)
    x, v, load = x + gain_x * error, v + gain_v * error, load + gain_load * error
    pushed = -per_x * x - per_v * v
    middle = x + 0.5 * step * v
    rest, push, push_slope = motion.forces_at(point.strain)
    needed = pushed + rest * middle - load + motion.drag * v
    drive = (needed - point.volt2 / full_v2 * push_slope * middle) * full_v2 / push
    speed = v + step * pushed
    rows = np.zeros((size + 4, size + 5))
    rows[:size, :size] = point.a
    rows[:size] += np.outer(point.b, drive)
    rows[size:] = middle + 0.5 * step * speed, speed, load, pushed
    none = np.zeros(4)
    return LinearLoop(
        rows[:, :-1], np.r_[point.load, none], rows[:, -1] / width_m, np.r_[point.b, none],
        np.r_[point.c, none], drive[:-1], float(drive[-1] / width_m),
    )  # fmt: skip


def design_chip_observer(setting: ControllerSetting) -> Mapping[str, float]:
    """Choose bandwidth and expected load so that a change of load is rejected best.

    Minimises the integral of time times the squared error after a step of the load, over three
    strains of the reachable range. The peak sensitivity is at most 2.5 with the stiffness 10 %
    higher, and with it 10 % lower and the delay 0.5 ms longer; at most 6 with the delay 5 ms
    longer, which is three times that of the loop. Noise moves the actuator by at most 1.5 times
    the noise of the sensed length, the drive by at most 6 % of its range and from one update to
    the next by at most what the loop allows (standard deviations). The observer assumes
    acceleration noise with a spectral density of 0.04 m/s^2/sqrt(Hz), or 0.01 if noise moves the
    drive too much with 0.04.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `ChipObserverController`.
    Raises:
        ResultError: No parameters keep the loop stable.
    """
    known = setting.actuator
    assert known is not None, "the kind needs it"
    motion = motion_record(setting, RESERVE)
    points = [
        (sampled_point(setting, strain, stiffness=stiffness, later_s=later_s), peak)
        for strain in np.interp(_POINTS, (0.0, 1.0), known.reachable()).tolist()
        for stiffness, later_s, peak in _SPREAD
    ]
    with contextlib.suppress(ResultError):
        return _searched(motion, setting, points, _FAST_SHAKE_M_S2)
    return _searched(motion, setting, points, SHAKE_M_S2)


def _searched(
    motion: MotionRecord, setting: ControllerSetting, points: list[tuple[SampledPoint, float]],
    shake_m_s2: float,
) -> Mapping[str, float]:  # fmt: skip
    """The best bandwidth and load with these unknown accelerations."""
    known = setting.actuator
    assert known is not None

    def loops(bandwidth: float, load_n: float) -> Iterator[tuple[LinearLoop, Demands]]:
        for point, peak in points:
            loop = linear_chip_loop(motion, setting, point, (bandwidth, load_n, shake_m_s2))
            yield loop, _demands(setting, known, point, peak)

    found = best_parameters(loops, setting, evaluations=100)
    return {**found, "shake_m_s2": shake_m_s2}


def _demands(
    setting: ControllerSetting, known: KnownActuator, point: SampledPoint, peak: float
) -> Demands:
    per_v2 = 0.5 / math.sqrt(point.volt2) / known.gain_v_per_v  # V of drive per V^2
    allowed_v = setting.highest_rate_per_s * setting.period_s
    return Demands(
        known.length_noise_m(point.strain), _SHAKEN * known.high_v / per_v2, peak, _MOVED,
        _CHANGED * allowed_v / per_v2,
    )  # fmt: skip
