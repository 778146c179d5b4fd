"""Limits of what may be requested from generator and supply, whatever their drivers accept."""

from __future__ import annotations

import numpy as np

from haselab.base import InputError, Limits
from haselab.rig import RigDescription
from haselab.safety.state_machine import SafetySettings

__all__ = ["as_number", "carrier_limit_v", "check_carrier", "supply_limits"]

_HIGHEST_HZ = 1e6


def as_number(name: str, value: object) -> float:
    """Convert one number of a request, so that limits and driver get the same value.

    Args:
        name: of the quantity, for the message.
        value: as it was requested; NaN is returned and then refused by the limits.
    Raises:
        InputError: The value is a text, a truth value, an array, or None.
    """
    if type(value) is float:
        return value
    kind = type(value).__name__
    if isinstance(value, (bool, np.bool_, str, bytes)) or np.ndim(value) != 0:  # type: ignore[arg-type]
        raise InputError(f"{name} is {value!r} ({kind}), but it must be one number.")
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(f"{name} is {value!r} ({kind}), but it must be one number.") from None


def carrier_limit_v(rig: RigDescription, settings: SafetySettings) -> float:
    """Highest peak of the sensing signal, in V at the amplifier's input.

    Half of the largest drive unless `SafetySettings.carrier_limit_v` is set: the carrier adds to
    the drive and must not be the larger of the two.
    """
    if settings.carrier_limit_v is not None:
        return settings.carrier_limit_v
    return 0.5 * rig.drive_reach_v


def check_carrier(
    rig: RigDescription, settings: SafetySettings, frequency_hz: float, amplitude_v: float
) -> None:
    """Refuse a sensing signal before it reaches the generator.

    Args:
        rig: nominal values of the bench.
        settings: limits of the safety chain.
        frequency_hz: at least one period per block; may be above half of the sampling rate, since
            a microcontroller undersamples its carrier.
        amplitude_v: peak at the amplifier's input, from 0 V to `carrier_limit_v`.
    Raises:
        LimitError: A value is outside these limits, or not a number.
    """
    low_hz = 1.0 / rig.block_s  # one period per block: a slower carrier looks like a drive
    Limits("carrier frequency", low_hz, _HIGHEST_HZ, "Hz").check(frequency_hz)
    Limits("carrier amplitude", 0.0, carrier_limit_v(rig, settings), "V").check(amplitude_v)


def supply_limits(rig: RigDescription, settings: SafetySettings) -> Limits:
    """Limits of the set voltage of a separate supply, in V.

    At most `SafetySettings.supply_limit_v`; unless that is set, the highest output of the bench:
    its largest drive times the gain of the amplifier.
    """
    high_v = settings.supply_limit_v
    if high_v is None:
        high_v = rig.drive_reach_v * rig.amplifier_gain
    return Limits("supply voltage", 0.0, high_v, "V")
