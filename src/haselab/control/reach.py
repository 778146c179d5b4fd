"""Range of a controller's output that the drive can produce, and the step within it."""

from __future__ import annotations

import math

from haselab.base import InputError, ResultError
from haselab.control.gains import Saturation
from haselab.control.plants.general import AnyPlant, PlantScale
from haselab.models.maps import VoltageMap, allow_start, require_start
from haselab.models.plant import Plant

__all__ = ["default_step", "integrates", "reachable_range", "usual_limits"]

_STEP = 0.04  # of the reference study
_OF_REACH = 0.5
_GAINS = (0.01, 100.0)  # of a model from strain to strain; it is 1 without creep


def integrates(plant: AnyPlant) -> bool:
    """Whether a plant reaches any output with any input."""
    return not isinstance(plant, Plant) and plant.denominator[-1] == 0.0


def usual_limits(plant: AnyPlant) -> Saturation:
    """Limits of a controller whose output is a strain, where none are given.

    Args:
        plant: from strain to strain.
    Returns:
        Those of the reference study.
    Raises:
        InputError: the static gain is far from 1, so the model maps from or to something else.
    Example:
        >>> usual_limits(Plant(0.8, 60.0, 0.2)).high
        0.1
    """
    gain, usual = abs(PlantScale.of(plant).gain), Saturation()
    if not integrates(plant) and not _GAINS[0] <= gain <= _GAINS[1]:
        raise InputError(
            f"The static gain of the model is {gain:.3g}, so it is not a model from strain to "
            f"strain, but the usual limits {usual.low:g} to {usual.high:g} are strains. Give "
            "limits=(LOW, HIGH) in the unit of the model's input."
        )
    return usual


def default_step(plant: AnyPlant, limits: Saturation) -> float:
    """The step of a design or a simulation, where none is given.

    Args:
        plant: plant.
        limits: of the controller's output.
    Returns:
        0.04 if the limits allow it. Otherwise half of the largest step that they allow, upwards or
        downwards; upwards if both are equally large.
    Example:
        >>> plant = Plant(0.8, 60.0, 0.2)
        >>> default_step(plant, Saturation()), default_step(plant, Saturation(-0.02, 0.015))
        (0.04, -0.008)
    """
    gain = PlantScale.of(plant).gain
    low, high = sorted((gain * limits.low, gain * limits.high))
    if integrates(plant) or low <= _STEP <= high:
        return _STEP
    return _OF_REACH * (high if high >= -low else low)


def reachable_range(
    wanted: Saturation, to_volt: VoltageMap, low_v: float | None, high_v: float | None
) -> Saturation:
    """Limit a range of strain to what the drive can produce through the voltage map.

    Args:
        wanted: range of the corrected strain.
        to_volt: corrected strain to drive voltage.
        low_v: lowest drive, in V; None: no limit.
        high_v: highest drive, in V; None: no limit.
    Returns:
        The limited range. It may end close to zero strain, see `allow_start`; a loop then starts
        at this end.
    Raises:
        InputError: zero strain is outside the wanted range.
        ResultError: the drive does not reach zero strain.
    Example:
        >>> eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
        >>> round(reachable_range(Saturation(), eq4, 0.0, 1.6).high, 4)
        0.0692
    """
    low_v = -math.inf if low_v is None else low_v
    high_v = math.inf if high_v is None else high_v
    found = to_volt.reach((wanted.low, wanted.high), low_v, high_v)
    require_start((wanted.low, wanted.high))
    if found is None or not allow_start(found):
        raise ResultError(
            f"The voltage map has zero strain at {float(to_volt.voltage_v(0.0)):.3g} V, but the "
            f"drive is limited to [{low_v:g}, {high_v:g}] V. Change the limits of the drive, or "
            "define zero strain as the length at a drive within these limits (zero_length_m, with "
            "a column of lengths), and fit both maps and the model again."
        )
    return Saturation(*found)
