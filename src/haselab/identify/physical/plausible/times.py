"""Times in a wrong unit, which a motion betrays by its dynamics."""

from __future__ import annotations

from haselab.identify.physical.plausible.coarse import Glimpse, StartLaw
from haselab.identify.physical.record import MotionRecord

__all__ = ["find_wrong_times", "follows_with_inertia"]

# true over stated times: ms or min for s, s for ms, a rate that is wrong by 10
_TIME_SCALES = (1e-3, 1.0 / 60.0, 0.1, 10.0, 60.0, 1e3)
# of the times, because the resonance at the start values may be off; the most likely ones first
_TUNED = (1.0, 0.85, 1.2, 0.7, 1.4, 0.6, 1.7)
_NEAR, _NEARLY = (0.94, 1.07), 0.3  # of the best of them; correlation from which they are tried
_SLOW_S = 1.0  # time from value to value, in which no resonance is seen
_LONGEST_S = 5e3  # of one simulation
_ALIKE = 0.95  # correlation of steps, of right times for certain
_LEAST = 0.65  # the same, of another unit of the times that explains them
_LESS = 0.5  # of what the stated times leave unexplained, that the other unit may
_INERTIAS = (3.0, 20.0)  # without weight, over the hung mass
_AS_GOOD = 0.75  # of what an inertia leaves unexplained, that the other unit must
_FOLLOWS = 0.8  # correlation of steps, of a large inertia that explains them


def find_wrong_times(law: StartLaw, record: MotionRecord) -> str:
    """Say whether the values follow the drive in another unit of the times only.

    Args:
        law: at the start values.
        record: of the motion.
    Returns:
        What is wrong and what to do; empty if nothing is.
    """
    glimpse = Glimpse.of(record)
    if glimpse is None:
        return ""
    stated = _tuned_agreement(law, glimpse, 1.0)
    if stated > _ALIKE:
        return ""
    others = {scale: _tuned_agreement(law, glimpse, scale) for scale in _TIME_SCALES}
    best = max(others, key=lambda scale: others[scale])
    if others[best] < _LEAST or _unexplained(others[best]) > _LESS * _unexplained(stated):
        return ""
    if follows_with_inertia(law, glimpse, others[best]):
        return ""
    change = f"{best:g} times longer" if best > 1.0 else f"{1.0 / best:g} times shorter"
    what = "lengths" if glimpse.record.length_m.size else "capacitances"
    return (
        f"the {what} do not follow the drive as an actuator does, but they would if all "
        f"times were {change} (correlation of the steps: {others[best]:.2f}, now {stated:.2f}). "
        "Check the unit of the times (s)"
    )


def follows_with_inertia(law: StartLaw, glimpse: Glimpse, wanted: float | None = None) -> bool:
    """Whether the values follow the drive as those of an actuator with a large inertia do.

    Args:
        law: at the start values.
        glimpse: of the motion.
        wanted: correlation of another explanation, which an inertia nearly as good excludes;
            None: there is no other one.
    """
    for inertia in _INERTIAS:
        found = _tuned_agreement(law, glimpse, 1.0, inertia)
        if wanted is None:
            follows = found > _FOLLOWS
        else:
            follows = _AS_GOOD * _unexplained(found) < _unexplained(wanted)
        if follows:
            return True
    return False


def _unexplained(agreement: float) -> float:
    return 1.0 - max(agreement, 0.0) ** 2


def _tuned_agreement(
    law: StartLaw, glimpse: Glimpse, time_scale: float, inertia: float = 0.0
) -> float:
    """Largest correlation of the steps with simulated ones, with the resonance moved."""
    if time_scale > 1.0 and time_scale * glimpse.duration_s > _LONGEST_S:
        return 0.0
    fast = time_scale * glimpse.interval_s < _SLOW_S
    found: dict[float, float] = {}
    for tuned in _TUNED if fast else _TUNED[:1]:
        found[tuned] = glimpse.agreement(law, tuned * time_scale, inertia)
        if found[tuned] > _ALIKE:
            return found[tuned]
    best = max(found, key=lambda tuned: found[tuned])
    if fast and found[best] > _NEARLY:  # a weakly damped resonance is narrower than the grid
        for near in _NEAR:
            found[near * best] = glimpse.agreement(law, near * best * time_scale, inertia)
    return max(0.0, *found.values())
