"""The share of a loop's measured strain that follows the drive at once, from an actuator file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from haselab.base import Estimate, InputError
from haselab.control.simulate import LoopSetting
from haselab.controllers import KnownActuator, known_actuator
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.strain_map import HIGHEST_SHARE

__all__ = ["with_direct_share", "with_share"]

_STRAINS = 9  # within the limits of the loop
_TWO_STD = 2.0


def with_direct_share(setting: LoopSetting, tables: ActuatorTables) -> LoopSetting:
    """A loop with the direct share of its actuator file.

    The nominal share is the measured one, `direct_share` of `[sensing.strain_map]`, else that of
    the physical model in the middle of the loop's limits. With a physical model without errors,
    its shares within these limits are the range, else twice the standard deviation to either side.

    Args:
        setting: rate, delay and limits of the loop.
        tables: of the actuator file.
    Returns:
        The loop; unchanged if the file knows no share.
    """
    shares = _physical(tables, setting)
    table = tables.sensing.strain_map
    stated = None if table is None else table.direct_share
    if stated is None and not shares:
        return setting
    if not shares:
        assert table is not None and stated is not None
        return with_share(setting, Estimate.normal(stated, table.direct_share_std or 0.0, ""))
    nominal = shares[len(shares) // 2] if stated is None else stated
    return _with(setting, nominal, min(*shares, nominal), max(*shares, nominal))


def with_share(setting: LoopSetting, share: Estimate | None) -> LoopSetting:
    """A loop with a measured direct share; its range is twice the standard deviation to each side.

    Args:
        setting: of the loop.
        share: as measured; None: the sensed strain has none.
    Returns:
        The loop.
    """
    if share is None:
        return setting
    around = _TWO_STD * share.std
    return _with(setting, share.value, share.value - around, share.value + around)


def _with(setting: LoopSetting, share: float, low: float, high: float) -> LoopSetting:
    share, low, high = np.clip([share, low, high], -HIGHEST_SHARE, HIGHEST_SHARE).tolist()
    return replace(setting, direct_share=share, direct_range=None if low == high else (low, high))


def _physical(tables: ActuatorTables, setting: LoopSetting) -> list[float]:
    """Shares by a physical model without errors, at strains within the limits of the loop."""
    model = None if tables.model is None else tables.model.physical
    if model is None or model.status != "ok":
        return []
    try:
        known = known_actuator(tables)
        return [] if known is None else _shares(known, setting)
    except InputError:  # the file lacks what only controllers of the physical model need
        return []


def _shares(known: KnownActuator, setting: LoopSetting) -> list[float]:
    if not known.capacitance_follows_drive:
        return []
    reached, limits = known.sensed_range(), setting.saturation
    low, high = max(limits.low, reached[0]), min(limits.high, reached[1])
    if not low < high:
        return []
    return [known.direct_share(strain) for strain in np.linspace(low, high, _STRAINS).tolist()]
