"""A desired length that an actuator can follow: planned after a jump, as given where smooth."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.motion_model import MotionModel

__all__ = ["ReferencePlan", "cubic"]

_CHECKED = 16  # times of a plan at which its force is checked
_LONGER = 1.12  # from one try to the next
_LEAST = 4  # periods of a plan
_LONGEST_S = 5.0
_SOON_S = 0.01
_ALONE = 3.0  # times its neighbours: a rise that is a step
_NEAR = 0.3
_SAME = 1e-9
_SMALL = 0.03  # of the way in a period: a rise that is followed, whatever its neighbours are


class ReferencePlan:
    """The desired length at the time at which a drive acts, with its speed and acceleration.

    Args:
        model: of the motion.
        known: limits of drive and field.
        period_s: between two drives.
        reserve: share of the force's range that a plan leaves to the feedback.
        rate_v_per_s: fastest change of the drive.
    """

    def __init__(
        self, model: MotionModel, known: KnownActuator, period_s: float, reserve: float,
        rate_v_per_s: float,
    ) -> None:  # fmt: skip
        self._period_s, self._reserve, self._rate = period_s, reserve, rate_v_per_s
        self.exchange(model, known)

    def exchange(self, model: MotionModel, known: KnownActuator) -> None:
        """Plan with another model from now on.

        Args:
            model: of the motion.
            known: limits of drive and field.
        """
        self._model, self._known = model, known
        ends = known.limited_strain(-math.inf), known.limited_strain(math.inf)
        self._ends_m = known.length_m(ends[0]), known.length_m(ends[1])
        lengths_m = [known.length_m(strain) for strain in np.linspace(*known.reachable(), 9)]
        most_n = max(
            abs(model.pull_n(length_m, known.highest_drive_v(length_m))) for length_m in lengths_m
        )
        # the way in a period at a speed that the largest force gives soon
        soon_s = max(self._period_s, _SOON_S)
        self._most_m = most_n / model.inertia_kg * soon_s * self._period_s

    def begin(self, length_m: float) -> None:
        """Rest at a length."""
        self._curve: tuple[float, ...] = ()
        self._for_s, self._at_s, self._target_m = 0.0, 0.0, length_m
        self._follows, self._last_m = False, length_m
        self._here = (length_m, 0.0)  # length and speed at the next drive

    def next(
        self, wanted_m: list[float], acts_s: float, state: list[float]
    ) -> tuple[float, float, float]:
        """Length, speed, and mean acceleration until the next drive.

        Args:
            wanted_m: desired length of the block that ended, and of those that come.
            acts_s: from the end of that block to the effect of the drive.
            state: then.
        """
        period_s = self._period_s
        samples = self._samples_m(wanted_m)
        place = acts_s / period_s + 2.0  # of the samples, the drive's effect
        at = min(int(place + 1e-9), len(samples) - 1)
        target_m, here = samples[at], self._here
        if len(samples) > at + 4 and self.smooth(samples, at):
            given = cubic(samples, place, period_s)
            rests = self._at_s >= self._for_s - _SAME
            if self._follows or (rests and abs(given[0] - here[0]) < _NEAR * self._most_m):
                self._follows = True
                after = self._here = cubic(samples, place + 1.0, period_s)
                return (*given, 2.0 * (after[0] - given[0] - given[1] * period_s) / period_s**2)
        if self._follows or target_m != self._target_m:
            self._follows = False
            self._plan(here, target_m, state)
        self._at_s += period_s
        if self._at_s >= self._for_s - _SAME:
            self._here = self._target_m, 0.0
        else:  # as a drive that is held can lead it
            speed = _value(self._curve, self._at_s)[1]
            self._here = here[0] + 0.5 * period_s * (here[1] + speed), speed
        return (*here, (self._here[1] - here[1]) / period_s)

    def _samples_m(self, wanted_m: list[float]) -> list[float]:
        """The desired lengths, limited, after the one of the update before."""
        (low_m, high_m), before_m = self._ends_m, self._last_m
        limited_m = [min(max(length_m, low_m), high_m) for length_m in wanted_m]
        self._last_m = limited_m[0]
        return [before_m, *limited_m]

    def smooth(self, samples: list[float], at: int) -> bool:
        """Whether the samples about one are neither a step nor faster than the force of the field.

        In a step, one rise is much larger than both of its neighbours.
        """
        rises = [abs(b - a) for a, b in pairwise(samples[max(at - 2, 0) : at + 5])]
        alone = any(
            rise > _ALONE * max(before, after) + _SMALL * self._most_m
            for before, rise, after in zip(rises, rises[1:], rises[2:], strict=False)
        )
        return not alone and max(rises) <= self._most_m

    def before_step(self, samples: list[float], at: int) -> list[float]:
        """The samples before the first step that `smooth` does not see, because it comes later.

        The last rise may be the beginning of a step.
        """
        rises = [*(abs(b - a) for a, b in pairwise(samples)), 0.0]
        for k in range(at + 3, len(rises) - 1):
            alone = _ALONE * max(rises[k - 1], rises[k + 1]) + _SMALL * self._most_m
            if rises[k] > min(alone, self._most_m):
                return samples[: k + 1]
        return samples

    def _plan(self, start: tuple[float, float], target_m: float, state: list[float]) -> None:
        """Plan the fastest polynomial within the limits, else the one that exceeds them least."""
        for_s = self.duration_s(start, target_m, state)
        self._target_m = target_m
        self._curve, self._for_s, self._at_s = _quintic(start, target_m, for_s), for_s, 0.0

    def duration_s(
        self, start: tuple[float, float], target_m: float, state: list[float],
        longer: float = _LONGER,
    ) -> float:  # fmt: skip
        """Duration of the fastest polynomial within the limits, else of that which exceeds least.

        Args:
            start: length and speed.
            target_m: length at which it comes to rest.
            state: from which the branches and the load are.
            longer: from one try to the next.
        """
        period_s, least_n = self._period_s, math.inf
        for_s = found_s = _LEAST * period_s
        while for_s < _LONGEST_S and least_n > 0.0:
            curve = _quintic(start, target_m, for_s)
            excess_n = self._excess_n(curve, for_s, target_m, state)
            if excess_n < least_n:
                least_n, found_s = excess_n, for_s
            for_s = period_s * math.ceil(longer * for_s / period_s)
        return found_s

    def _excess_n(
        self, curve: tuple[float, ...], for_s: float, target_m: float, state: list[float]
    ) -> float:
        """Force by which a polynomial exceeds the limits; 0: it keeps them."""
        model, known, excess_n = self._model, self._known, 0.0
        rest_n = [model.needed_n(state, length_m, 0.0, 0.0) for length_m in (curve[0], target_m)]
        before_v = math.nan
        for k in range(_CHECKED + 1):
            length_m, speed, pushed = _value(curve, for_s * k / _CHECKED)
            needed_n = model.needed_n(state, length_m, speed, pushed)
            ends_n = sorted(
                model.pull_n(length_m, volt)
                for volt in (max(known.low_v, 0.0), known.highest_drive_v(length_m))
            )
            spare_n = self._reserve * (ends_n[1] - ends_n[0])
            low_n = min(ends_n[0] + spare_n, *rest_n)
            high_n = max(ends_n[1] - spare_n, *rest_n)
            excess_n = max(excess_n, low_n - _SAME - needed_n, needed_n - high_n - _SAME)
            if math.isfinite(self._rate):
                drive_v = known.drive_v(length_m, needed_n)
                faster = abs(drive_v - before_v) * _CHECKED / (self._rate * for_s) - 1.0
                if faster > 0.0:
                    excess_n = max(excess_n, faster * (ends_n[1] - ends_n[0]))
                before_v = drive_v
        return excess_n


def _quintic(start: tuple[float, float], target_m: float, for_s: float) -> tuple[float, ...]:
    """Coefficients, lowest power first, of the way to rest at a target, from no acceleration."""
    x, v = start
    t, gap = for_s, target_m - x
    c3 = (10.0 * gap - 6.0 * v * t) / t**3
    c4 = (-15.0 * gap + 8.0 * v * t) / t**4
    c5 = (6.0 * gap - 3.0 * v * t) / t**5
    return x, v, 0.0, c3, c4, c5


def _value(curve: tuple[float, ...], t: float) -> tuple[float, float, float]:
    c0, c1, c2, c3, c4, c5 = curve
    return (
        c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * c5)))),
        c1 + t * (2.0 * c2 + t * (3.0 * c3 + t * (4.0 * c4 + t * 5.0 * c5))),
        2.0 * c2 + t * (6.0 * c3 + t * (12.0 * c4 + t * 20.0 * c5)),
    )


def cubic(samples: list[float], place: float, period_s: float) -> tuple[float, float]:
    """Value and slope by the four samples about a place."""
    first = min(max(int(place + 1e-9) - 1, 0), len(samples) - 4)
    t = place - first - 1.0
    a, b, c, d = samples[first : first + 4]
    one, two, three = (
        -a / 3.0 - b / 2.0 + c - d / 6.0, a / 2.0 - b + c / 2.0, (d - a) / 6.0 + (b - c) / 2.0,
    )  # fmt: skip
    slope = one + t * (2.0 * two + t * 3.0 * three)
    return b + t * (one + t * (two + t * three)), slope / period_s
