"""The text shown to the person who arms a bench: the highest voltage and the limits in force."""

from __future__ import annotations

from haselab.rig import RigDescription

__all__ = ["arming_limits"]


def arming_limits(
    rig: RigDescription, current_limit_a: float, rate_limit_v_per_s: float, *, own_controller: bool
) -> str:
    """Describe the limits of a bench in words, the voltage first.

    Args:
        rig: nominal values of the bench.
        current_limit_a: mean current that trips.
        rate_limit_v_per_s: fastest rise of the drive at the amplifier's input.
        own_controller: a microcontroller closes the loop; the limits of this program do not apply.
    Returns:
        Complete sentences, beginning with the name of the bench.
    """
    limits = rig.drive_limits
    top_v = max(abs(limits.low), abs(limits.high)) * rig.amplifier_gain
    text = f"{rig.name}: up to {1e-3 * top_v:g} kV at the amplifier's output."
    if own_controller:
        return (
            f"{text} The firmware limits the drive and its rise; neither it nor this program "
            "limits the mean current. The microcontroller ramps down when its link is lost."
        )
    rise_v_per_s = rate_limit_v_per_s * rig.amplifier_gain
    return (
        f"{text} Trips above {1e3 * current_limit_a:g} mA mean current; the drive rises by at most "
        f"{rate_limit_v_per_s:g} V/s ({1e-6 * rise_v_per_s:g} MV/s at the output)."
    )
