"""Feedthrough of the drive to the sensed strain of a loop, from an actuator file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from haselab.actuators import ACTUATORS
from haselab.base import Estimate, InputError
from haselab.control.simulate import LoopSetting
from haselab.controllers import KnownActuator, known_actuator
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import LARGEST_FEEDTHROUGH

__all__ = ["feedthrough_doubt", "with_feedthrough", "with_measured_feedthrough"]

_STRAINS = 9  # within the limits of the loop
_TWO_STD = 2.0
_SAME = 1e-6  # relative difference of capacitances by rounding
_HIGH_V = 3000.0  # at which a capacitance that depends on the voltage differs from that at 0 V


def with_feedthrough(setting: LoopSetting, tables: ActuatorTables) -> LoopSetting:
    """A loop with the feedthrough that its actuator file knows.

    The nominal feedthrough is that of `[sensing.strain_map]`, else that of the physical model in
    the middle of the loop's limits. With a physical model without errors, the values within these
    limits are the range, else twice the standard deviation to either side. A stated feedthrough of
    0 is that of a loop whose strain is measured by camera: it has no range.

    Args:
        setting: rate, delay and limits of the loop.
        tables: of the actuator file.
    Returns:
        The loop; unchanged if the file knows no feedthrough.
    """
    table = tables.sensing.strain_map
    stated = None if table is None else table.feedthrough
    if stated == 0.0:
        return setting
    found = _physical(tables, setting)
    if found:
        nominal = found[len(found) // 2] if stated is None else stated
        return _with(setting, nominal, min(*found, nominal), max(*found, nominal))
    if table is None or stated is None:
        return setting
    return with_measured_feedthrough(
        setting, Estimate.normal(stated, table.feedthrough_std or 0.0, "")
    )


def with_measured_feedthrough(setting: LoopSetting, found: Estimate | None) -> LoopSetting:
    """A loop with a measured feedthrough; its range is twice the standard deviation to each side.

    Args:
        setting: of the loop.
        found: as measured; None: the sensed strain has none.
    Returns:
        The loop.
    """
    if found is None:
        return setting
    around = _TWO_STD * found.std
    return _with(setting, found.value, found.value - around, found.value + around)


def feedthrough_doubt(setting: LoopSetting, tables: ActuatorTables) -> str:
    """Why the margins of a loop may be wrong: nobody knows the feedthrough of its pouches.

    Args:
        setting: see `with_feedthrough`.
        tables: of the actuator file.
    Returns:
        What is missing and what to do; empty if nothing is.
    """
    table = tables.sensing.strain_map
    if setting.feedthrough or table is None or table.feedthrough == 0.0:
        return ""
    try:
        law = ACTUATORS.find(tables.actuator.kind)()
    except InputError:  # a kind that is not installed
        return ""
    at = 0.5 * (law.length_limits_m.low + law.length_limits_m.high)
    ends_f = law.differential_capacitance_f(at, np.array([0.0, _HIGH_V]))
    if np.ptp(ends_f) < _SAME * ends_f.max():
        return ""
    return (
        f"the capacitance of a {law.kind} depends on the voltage too, so its sensed strain follows "
        "the drive in part at once, but the file does not say how much (feedthrough in "
        "[sensing.strain_map]). These margins may be far too large. Play a study with [chirp], or "
        "run haselab identify actuator first"
    )


def _with(setting: LoopSetting, nominal: float, low: float, high: float) -> LoopSetting:
    limit = LARGEST_FEEDTHROUGH
    nominal, low, high = np.clip([nominal, low, high], -limit, limit).tolist()
    range_ = None if low == high else (low, high)
    return replace(setting, feedthrough=nominal, feedthrough_range=range_)


def _physical(tables: ActuatorTables, setting: LoopSetting) -> list[float]:
    """Feedthrough by a physical model without errors, at strains within the limits of the loop."""
    model = None if tables.model is None else tables.model.physical
    if model is None or model.status != "ok":
        return []
    try:
        known = known_actuator(tables)
        return [] if known is None else _over_limits(known, setting)
    except InputError:  # the file lacks what only controllers of the physical model need
        return []


def _over_limits(known: KnownActuator, setting: LoopSetting) -> list[float]:
    if not known.capacitance_follows_drive:
        return []
    reached, limits = known.sensed_range(), setting.saturation
    low, high = max(limits.low, reached[0]), min(limits.high, reached[1])
    if not low < high:
        return []
    return [known.feedthrough(strain) for strain in np.linspace(low, high, _STRAINS).tolist()]
