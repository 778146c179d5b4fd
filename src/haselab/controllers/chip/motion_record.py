r"""The identified motion as integers for `core/include/hs_motion.h`.

Lengths $x$ are parts of a range about the reachable strains, in Q30. The unit of time is
$2^n$ updates, with the largest $n$ for which all accelerations stay below 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.actuators import GRAVITY_M_S2
from haselab.base import InputError
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.protocol import ControllerSetting, Measurement
from haselab.controllers.reference_plan import ReferencePlan

__all__ = [
    "MotionRecord",
    "as_q",
    "lag_of",
    "motion_record",
    "require_square_law",
    "sensed_strain",
    "set_lag",
]

Floats = NDArray[np.float64]
_ONE, _FULL = 2.0**30, 32767
_LARGEST = 32000  # of a table, in whose steps rounding must fit
_BEYOND = 0.15  # of the reachable strains, on both sides
_FIELD_STRAIN = 2e-3  # by which the field is looked up ahead
_MOST = 0.9  # acceleration
_SINGLE = 2.0**-22  # relative, more than two roundings of a float
_TURNS = 4  # updates in which every branch moves once: HS_MOTION_BRANCHES
_STARTS, _WAYS = 9, 9  # HS_MOTION_STARTS, HS_MOTION_WAYS
_INSIDE = 0.01  # of the reachable strains, from its ends
_LONGER = 1.02  # from one try of a duration to the next
_LONGEST_SHIFT = 10


@dataclass(frozen=True)
class MotionRecord:
    """The integers, and what they mean.

    Args:
        numbers: record of `_core.MOTION`. Shape `()`.
        low: strain at x = 0.
        span: strain of the whole table.
        unit_s: unit of time.
        drag: acceleration over speed, in units of x and time.
        inertia_kg: of the motion.
        high_v: highest drive.
    """

    numbers: NDArray[np.void]
    low: float
    span: float
    unit_s: float
    drag: float
    inertia_kg: float
    high_v: float

    def acceleration_of(self, force_n: float, zero_length_m: float) -> float:
        """Acceleration by a force, in units of x and time."""
        return force_n / self.inertia_kg / zero_length_m / self.span * self.unit_s**2

    def forces_at(self, strain: float) -> tuple[float, float, float]:
        """Slope of the resting acceleration over x, acceleration by the highest drive, its slope.

        Args:
            strain: at which.
        """
        knots = np.linspace(0.0, 1.0, self.numbers["rest"].size)
        x = (strain - self.low) / self.span
        rest, push = (self.numbers[name] / 2.0**15 for name in ("rest", "push"))
        slopes = [np.gradient(row, knots[1]) for row in (rest, push)]
        rest_slope, push_slope = (float(np.interp(x, knots, row)) for row in slopes)
        return rest_slope, float(np.interp(x, knots, push)), push_slope

    def slope_at(self, strain: float) -> float:
        """Slope of elastic minus electric force over x, at the drive that holds a strain."""
        knots = np.linspace(0.0, 1.0, self.numbers["rest"].size)
        rest_slope, push, push_slope = self.forces_at(strain)
        rest = np.interp((strain - self.low) / self.span, knots, self.numbers["rest"] / 2.0**15)
        carrier = float(self.numbers["carrier"]) / _ONE
        return rest_slope - min(max(float(rest) / push, carrier), 1.0 + carrier) * push_slope


def as_q(value: float, bits: int, what: str, most: int = _FULL) -> int:
    """A number as an integer with a number of bits behind the point.

    Args:
        value: of it.
        bits: behind the point.
        what: name, for the message.
        most: largest integer.
    Returns:
        The nearest integer.
    Raises:
        InputError: It does not fit.
    """
    found = round(value * 2.0**bits)
    if abs(found) > most:
        raise InputError(
            f"{what} is {value:.4g}, but the step in integers allows at most "
            f"{most / 2.0**bits:.4g}. Design the controller again, or use it on the computer."
        )
    return found


def sensed_strain(known: KnownActuator, measurement: Measurement) -> float:
    """Strain by the identified capacitance, or as the camera saw it.

    Args:
        known: the actuator.
        measurement: valid.
    """
    if math.isnan(measurement.capacitance_f):
        return measurement.strain
    return known.strain(known.sensed_length_m(measurement.capacitance_f, measurement.voltage_v))


def lag_of(motion: MotionRecord, setting: ControllerSetting) -> tuple[float, float]:
    """Age of a measurement when the drive acts, in units of time, and half of its square.

    Args:
        motion: for its unit of time.
        setting: of the loop.
    """
    delay_s = 0.5 * setting.period_s if setting.delay_s is None else setting.delay_s
    lag = delay_s / motion.unit_s
    return lag, 0.5 * lag * lag


def set_lag(gains: NDArray[np.void], motion: MotionRecord, setting: ControllerSetting) -> None:
    """Write the age of a measurement when the drive acts.

    Args:
        gains: record with `lag` and `lag_square`.
        motion: for its unit of time.
        setting: of the loop.
    """
    lag, square = lag_of(motion, setting)
    gains["lag"] = as_q(lag, 15, "The delay", 2**13)
    gains["lag_square"] = as_q(square, 16, "The delay")


def require_square_law(known: KnownActuator) -> None:
    """Refuse an actuator whose electric force is not proportional to the square of the voltage.

    Args:
        known: the actuator.
    Raises:
        InputError: it is such an actuator.
    """
    if len(known.table.pull_n_v2) > 1:
        raise InputError(
            "The electric force of this actuator is not proportional to the square of the "
            "voltage, which the step in integers requires. Use 'force' or 'observer' at 100 Hz."
        )


def motion_record(setting: ControllerSetting, reserve: float) -> MotionRecord:
    """Compute tables and units.

    Args:
        setting: of the loop, with the actuator.
        reserve: share of the force's range that a plan leaves to the feedback.
    Returns:
        The integers.
    Raises:
        InputError: The electric force is not a product of length and square of the voltage, or
            the motion is too fast for the updates.
    """
    assert setting.actuator is not None, "the kind needs it"
    known = setting.actuator
    known = replace(known, high_v=min(known.high_v, setting.drive_high))
    require_square_law(known)
    knots = _core.MOTION["rest"].shape[0]
    reach = known.reachable()
    margin = _BEYOND * (reach[1] - reach[0])
    low, span = reach[0] - margin, reach[1] - reach[0] + 2.0 * margin
    strains = low + span * np.linspace(0.0, 1.0, knots)
    model = MotionModel(known)
    per_n = setting.period_s**2 / (model.inertia_kg * known.zero_length_m * span)
    rest, push = _accelerations(known, strains)
    branches = _branches(known, setting.period_s)
    rest = (1.0 + sum(share for share, _ in branches)) * rest - GRAVITY_M_S2 * known.mass_kg
    rest, push = per_n * rest, per_n * push
    largest = max(np.abs(rest).max(), np.abs(push).max())
    shift = math.floor(0.5 * math.log2(_MOST / largest))
    if shift < 0:
        raise InputError(
            f"The motion is too fast for updates of {setting.period_s:g} s. Use a faster loop."
        )
    shift = min(shift, _LONGEST_SHIFT)
    rest, push = 4.0**shift * rest, 4.0**shift * push
    unit_s = 2.0**shift * setting.period_s
    drag = known.law.losses.damping_n_s_per_m / model.inertia_kg * unit_s
    one = np.zeros((), _core.MOTION)
    one["low"], one["per_strain"] = low, _ONE / span
    one["per_volt"] = _FULL / known.high_v
    one["volt"] = known.high_v / _FULL * (1.0 - _SINGLE)  # the highest drive is not above its limit
    one["rest"] = np.round(rest * 2.0**15)
    one["push"] = np.round(push * 2.0**15)
    one["highest"] = [
        math.floor(_FULL * known.highest_drive_v(known.length_m(s + _FIELD_STRAIN)) / known.high_v)
        for s in strains
    ]
    carrier = known.carrier_v2 / (known.gain_v_per_v * known.high_v) ** 2
    one["carrier"] = round(carrier * _ONE)
    _set_root(one, push, carrier)
    one["most"] = int(_ONE) >> shift
    _set_moves(one, setting, known, (low, span, reserve))
    _set_branches(one, branches, setting.period_s)
    one["drag"] = as_q(drag, 15, "The damping")
    one["lowest"] = math.ceil(_FULL * max(setting.drive_low, 0.0) / known.high_v)
    rise = _FULL * setting.highest_rate_per_s * setting.period_s / known.high_v
    one["rise"] = math.floor(min(rise * (1.0 - 1e-6), _FULL))
    one["shift"] = shift
    return MotionRecord(one, low, span, unit_s, drag, model.inertia_kg, known.high_v)


def _accelerations(known: KnownActuator, strains: Floats) -> tuple[Floats, Floats]:
    """Elastic force and electric force of the highest drive, in N."""
    lengths = [known.length_m(float(strain)) for strain in strains]
    full_v2 = (known.gain_v_per_v * known.high_v) ** 2
    return (
        np.array([known.elastic_n(length) for length in lengths]),
        np.array([known.pull_per_v2(length) * full_v2 for length in lengths]),
    )


def _branches(known: KnownActuator, period_s: float) -> list[tuple[float, float]]:
    """Share and time of the branches that are slower than their own updates, the largest first."""
    losses = known.law.losses
    found = [
        (share, time_s)
        for share, time_s in zip(losses.branch_share, losses.branch_relaxation_s, strict=True)
        if time_s > 2.0 * _TURNS * period_s
    ]
    return sorted(found, reverse=True)[:_TURNS]


def _set_branches(
    one: NDArray[np.void], branches: list[tuple[float, float]], period_s: float
) -> None:
    whole = 1.0 + sum(share for share, _ in branches)
    for k, (share, time_s) in enumerate(branches):
        gain = 1.0 - math.exp(-_TURNS * period_s / time_s)
        slow = gain < 2.0**-8
        one["branch_share"][k] = round(share / whole * 2.0**15)
        one["branch_gain"][k] = round(gain * 2.0 ** (24 if slow else 16))
        one["branch_slow"][k] = slow
    one["branches"] = len(branches)


def _set_root(one: NDArray[np.void], push: Floats, carrier: float) -> None:
    """From an acceleration to w and to the drive: scales that use all bits."""
    weakest = np.abs(push).min()
    one["inverse"] = np.round(_LARGEST * weakest / push)
    full_w = _LARGEST * weakest * 2.0**14  # of the highest drive
    one["carrier_w"] = round(carrier * full_w)
    ratio = _FULL / math.sqrt(full_w)  # of drive and root
    shift = math.floor(math.log2(ratio)) + 1
    one["root_unit"] = min(round(2.0**16 * ratio / 2.0**shift), 65535)
    one["root_shift"] = shift


def _set_moves(
    one: NDArray[np.void], setting: ControllerSetting, known: KnownActuator,
    table: tuple[float, float, float],
) -> None:  # fmt: skip
    """Speeds of moves from nine lengths over nine distances, both ways, as `ReferencePlan`."""
    low, span, reserve = table
    model, period_s = MotionModel(known), setting.period_s
    plan = ReferencePlan(model, known, period_s, reserve, setting.highest_rate_per_s)
    first, last = known.reachable()
    inner = _INSIDE * (last - first)
    found = []
    for sign in (-1.0, 1.0):
        for x in np.linspace(0.0, 1.0, _STARTS):
            start = min(max(low + span * float(x), first + inner), last - inner)
            length_m = known.length_m(start)
            state = model.at_rest(length_m, known.static_drive_v(start))
            for halvings in range(_WAYS - 1, -1, -1):
                end = min(max(start + sign * span * 0.5**halvings, first), last)
                for_s = plan.duration_s((length_m, 0.0), known.length_m(end), state, _LONGER)
                found.append(max(math.floor(2.0**16 * period_s / for_s), 1))
    one["move"] = found
