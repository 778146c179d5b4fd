"""Records that cannot be those of an actuator: swapped units, and voltages of another place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ActuatorLaw, equilibrium_m
from haselab.base import LimitError
from haselab.identify.physical.record import MotionRecord

__all__ = ["find_implausible"]

Floats = NDArray[np.float64]

_LENGTH, _CAPACITANCE = 10.0, 100.0  # factor from the start values that no start explains
_BREAKDOWN = 3.0  # fields over that of breakdown, likewise
_UNSEEN = 0.01  # motion over the noise of a length
_STILL = 20.0  # spread of the lengths over their noise, of an actuator that moves


def find_implausible(law: ActuatorLaw, records: Sequence[MotionRecord]) -> str:
    """Say which unit or voltage of the records is wrong by orders of magnitude.

    Args:
        law: at the start values, which may be off by a factor of 2.
        records: to be fitted.
    Returns:
        What is wrong and what to do; empty if nothing is.
    """
    for record in records:
        for fault in (_length(law, record), _capacitance(law, record), _voltage(law, record)):
            if fault:
                return f"{record.name}: {fault}"
    return ""


def _length(law: ActuatorLaw, record: MotionRecord) -> str:
    if not record.length_m.size:
        return ""
    typical_m, free_m = float(np.median(record.length_m)), law.free_length_m
    if free_m / _LENGTH < typical_m < free_m * _LENGTH:
        return ""
    return (
        f"the lengths are about {typical_m:.3g} m, but the start values give a length of "
        f"{free_m:.3g} m without load. Check the unit of the lengths (m) and the camera's scale"
    )


def _capacitance(law: ActuatorLaw, record: MotionRecord) -> str:
    if not record.capacitance_f.size:
        return ""
    typical_f = float(np.median(record.capacitance_f))
    limits = law.length_limits_m
    lengths_m = np.linspace(limits.low, limits.high, 5)
    known_f = law.capacitance_f(lengths_m)
    if known_f.min() / _CAPACITANCE < typical_f < known_f.max() * _CAPACITANCE:
        return ""
    return (
        f"the capacitances are about {typical_f:.3g} F, but the start values give "
        f"{float(np.median(known_f)):.3g} F. Check the unit of the capacitances (F) and the gains "
        "of the monitors"
    )


def _voltage(law: ActuatorLaw, record: MotionRecord) -> str:
    drive = record.drive
    highest_v = float(np.abs(drive.voltage_v).max())
    if highest_v == 0.0:
        return ""
    field_v_m = highest_v / float(law.gap_m(law.free_length_m))
    if field_v_m > _BREAKDOWN * law.circuit.breakdown_v_per_m:
        return (
            f"the drive reaches {highest_v:.3g} V, a field of {field_v_m:.3g} V/m, and the "
            f"dielectric breaks down at {law.circuit.breakdown_v_per_m:.3g} V/m. State the volts "
            "at the actuator: check that the amplifier's gain is not counted twice"
        )
    moved_m = _moved_m(law, record, highest_v)
    if moved_m is None or not record.length_m.size:
        return ""
    noise_m = float(np.median(record.length_std_m))
    if moved_m > _UNSEEN * noise_m or float(np.std(_at_usual_load(record))) < _STILL * noise_m:
        return ""
    return (
        f"the drive of at most {highest_v:.3g} V would move the actuator by {1e6 * moved_m:.2g} "
        "um, but it moves. State the volts at the actuator, not those at the amplifier's input: "
        "check the amplifier's gain"
    )


def _at_usual_load(record: MotionRecord) -> Floats:
    """Lengths seen under the load that acted longest."""
    drive = record.drive
    _, of = np.unique(drive.load_n, return_inverse=True)
    usual = np.argmax(np.bincount(of, np.diff(drive.edge_s)))
    at = np.clip(np.searchsorted(drive.edge_s, record.length_time_s) - 1, 0, of.size - 1)
    return np.asarray(record.length_m[of[at] == usual])


def _moved_m(law: ActuatorLaw, record: MotionRecord, voltage_v: float) -> float | None:
    """Motion from 0 V to a voltage at the first load; None where there is no equilibrium."""
    load_n = float(record.drive.load_n[0])
    try:
        rest_m, at_m = (equilibrium_m(law, v, load_n) for v in (0.0, voltage_v))
    except LimitError:
        return None
    return abs(at_m - rest_m)
