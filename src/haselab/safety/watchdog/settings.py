"""Limits of the loop watchdog, which must all be finite."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from haselab.base import InputError

__all__ = ["FieldRating", "WatchdogSettings", "permit_expired", "require_finite"]


def require_finite(section: str, settings: Any) -> None:
    """Refuse a limit that is not a finite number above zero, as it would disable its check.

    Args:
        section: of the rig file, for the message.
        settings: a dataclass of numbers and booleans.
    Raises:
        InputError: A limit is infinite, not a number, zero or negative.
    """
    for name in (field.name for field in fields(settings)):
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        if not (value > 0 and math.isfinite(value)):
            raise InputError(
                f"{section}.{name} is {value:g}, but a limit must be finite and above 0. "
                "Change it in the rig file."
            )


@dataclass(frozen=True)
class FieldRating:
    """Electric field that the dielectric withstands, and its thickness at a known capacitance.

    The volume of the dielectric is constant, so its thickness is proportional to $C^{-1/2}$.

    Args:
        limit_v_per_m: highest field, margin included.
        thickness_m: of the dielectric at `capacitance_f`.
        capacitance_f: of the actuator at that thickness.
    Raises:
        InputError: A number is not finite and above zero.
    """

    limit_v_per_m: float
    thickness_m: float
    capacitance_f: float

    def __post_init__(self) -> None:
        require_finite("rating", self)

    def field_v_per_m(self, voltage_v: float, capacitance_f: float) -> float:
        """Electric field at a voltage and a sensed capacitance, both positive."""
        return voltage_v / self.thickness_m * math.sqrt(capacitance_f / self.capacitance_f)


@dataclass(frozen=True)
class WatchdogSettings:
    """Limits of a closed loop: [safety.loop] of RIG.toml.

    "Range" is the strain range of the voltage map. Rates count over a window of 0.5 s.

    Args:
        range_margin: how far strain may leave the range on either side, as a fraction of its
            width.
        repeat_s: how long a block, strain or frame may repeat values of the last second.
        lost_share: fraction of the blocks of a window that may have no strain.
        jump_share: change of the strain's rate from one block to the next, as a fraction of the
            range; six times the recent scatter is added. For actuators with a resonance above
            11.5 Hz (blocks of 10 ms) both shares are larger, see `LoopModel.quickness`.
        chatter_share: RMS of that change over 0.2 s, as a fraction of the range.
        swing_share: smallest reversal of the drive that counts as a swing, as a fraction of its
            limits.
        swings_per_s: swings that are not part of the reference.
        slow_swings_per_s: the same over 3 s, for slow oscillations.
        charges_per_s: charging energy, $\\Delta V^2$, in full charges to the drive's limit.
        move_share: change of the drive, in static strain, to which strain must respond, as a
            fraction of the range.
        response_share: least response within the window, as a fraction of that change.
        direction_ratio: how many times better a plant that moves the wrong way may explain the
            window (RMS of residuals) than one that moves the right way.
        extra_delay_blocks: blocks by which the monitor may lag the drive beyond the delay that
            the rig file states.
        frame_age_s: largest age of the frame that gives the strain, for video feedback.
    Raises:
        InputError: A number is not finite and above zero.
    """

    range_margin: float = 0.5
    repeat_s: float = 0.1
    lost_share: float = 0.5
    jump_share: float = 0.15
    chatter_share: float = 0.15
    swing_share: float = 0.25
    swings_per_s: float = 16.0
    slow_swings_per_s: float = 4.0
    charges_per_s: float = 5.0
    move_share: float = 0.05
    response_share: float = 0.01
    direction_ratio: float = 1.6
    extra_delay_blocks: int = 1
    frame_age_s: float = 0.25

    def __post_init__(self) -> None:
        require_finite("safety.loop", self)


def permit_expired(armed_s: float, permit_age_s: float) -> str:
    """Return why a bench must not stay armed any longer, or an empty text.

    Args:
        armed_s: time since it was armed, in s.
        permit_age_s: longest time, `SafetySettings.permit_age_s`.
    """
    if armed_s <= permit_age_s:
        return ""
    return (
        f"Permit expired: armed for {armed_s:.0f} s, but a permit is valid for {permit_age_s:g} s. "
        "Arm the bench again."
    )
