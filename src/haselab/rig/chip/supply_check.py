"""Check the microcontroller's supply voltage, which scales all its readings."""

from __future__ import annotations

from haselab.base import DeviceError

__all__ = ["check_supply"]

_BANDGAP_V = 1.1
_LOWEST_V, _HIGHEST_V = (
    1.0,
    1.2,
)  # of any chip, by the ATmega2560's data sheet (reset characteristics)
_CODES = 1024  # code = bandgap * 1024 / supply
_SHARE = 0.05  # by which the supply may differ from what the front end was calculated for


def check_supply(code: int, wanted_v: float, bandgap_v: float | None = None) -> str:
    """Check that the microcontroller has the supply voltage for which its front end was designed.

    The converter measures relative to the supply. The supply cancels in the capacitance, but not in
    the level of the high voltage: with 4.5 V instead of 5 V the actuator gets 10 % less than
    reported. Without a measured reference the supply is known to 9 %, so only values outside the
    range of the data sheet are refused.

    Args:
        code: of the reference relative to the supply; 0: this board does not measure it.
        wanted_v: range of the converter, in V.
        bandgap_v: measured voltage of this microcontroller's reference, in V; None: not measured.
    Returns:
        Text to add to the microcontroller's identity.
    Raises:
        DeviceError: The supply differs by more than 5 %.
    Example:
        >>> check_supply(225, 5.0), check_supply(225, 5.0, 1.08), check_supply(0, 3.3)
        (', supply 5.01 V to 9 %', ', supply 4.92 V', '')
    """
    if code == 0:
        return ""
    low_v, high_v = (bandgap_v, bandgap_v) if bandgap_v is not None else (_LOWEST_V, _HIGHEST_V)
    supply_v = (bandgap_v or _BANDGAP_V) * _CODES / code
    if (
        high_v * _CODES / code < (1.0 - _SHARE) * wanted_v
        or low_v * _CODES / code > (1.0 + _SHARE) * wanted_v
    ):
        raise DeviceError(
            f"The microcontroller's supply is about {supply_v:.2f} V (its reference reads {code} "
            f"of {_CODES}), but it must be {wanted_v:g} V within {100.0 * _SHARE:g} %. Otherwise "
            "the reported high voltage is wrong. Feed its 5V pin from a regulated supply, not "
            "from USB."
        )
    if bandgap_v is None:
        return f", supply {supply_v:.2f} V to 9 %"
    return f", supply {supply_v:.2f} V"
