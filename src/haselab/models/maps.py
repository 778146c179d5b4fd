"""Static maps: corrected strain to voltage (eq. 4), capacitance to strain (eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, LimitError

__all__ = ["LinearMap", "VoltageMap", "allow_start", "require_start"]

Floats = NDArray[np.float64]
_MUCH_WIDER = 10.0  # times the map's range
_REACH_POINTS = 1501
_ITERATIONS = 60
_NEAR_ZERO = 0.05  # of a strain range's width: largest distance from 0 of an end to start at


@dataclass(frozen=True)
class VoltageMap:
    r"""Voltage from strain as the sum of two exponentials, and its inverse.

    $V = a_1 e^{b_1 \varepsilon} + a_2 e^{b_2 \varepsilon}$

    Args:
        a1_v: first amplitude, in V.
        b1: first rate, per unit strain.
        a2_v: second amplitude, in V.
        b2: second rate, per unit strain.
        strain_low: lower end of the range in which `strain` searches.
        strain_high: upper end of it.
    Source: reference study, eq. 4, with its coefficients in the example (DAQ volts).
    Example:
        >>> eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
        >>> round(float(eq4.voltage_v(0.0)), 4), round(float(eq4.strain(1.5)), 6)
        (1.0435, 0.053738)
    """

    a1_v: float
    b1: float
    a2_v: float
    b2: float
    strain_low: float = -0.1
    strain_high: float = 0.2

    def __post_init__(self) -> None:
        numbers = (self.a1_v, self.b1, self.a2_v, self.b2, self.strain_low, self.strain_high)
        if not np.isfinite(numbers).all() or not self.strain_low < self.strain_high:
            raise InputError(
                f"The voltage map has the parameters {numbers}; they must be finite, with "
                "strain_low below strain_high. Fit the map again."
            )

    def voltage_v(self, strain: ArrayLike) -> Floats:
        """Voltage, in V, for a strain. Shape of `strain`."""
        e = np.asarray(strain, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # far outside the map: inf or NaN
            return np.asarray(self.a1_v * np.exp(self.b1 * e) + self.a2_v * np.exp(self.b2 * e))

    def slope_v(self, strain: ArrayLike) -> Floats:
        """Derivative of the voltage with respect to the strain, in V. Shape of `strain`."""
        e = np.asarray(strain, dtype=np.float64)
        first = self.a1_v * self.b1 * np.exp(self.b1 * e)
        return np.asarray(first + self.a2_v * self.b2 * np.exp(self.b2 * e))

    def is_monotone(self, strain_low: float, strain_high: float) -> bool:
        """Whether the voltage rises, or falls, everywhere between the two strains.

        The slope has at most one zero, where `a1 b1 e^{b1 e} = -a2 b2 e^{b2 e}`; so it is
        sufficient to check both ends.
        """
        ends = self.slope_v([strain_low, strain_high])
        return bool(ends[0] * ends[1] > 0.0)

    def reach(
        self, strains: tuple[float, float], low_v: float, high_v: float
    ) -> tuple[float, float] | None:
        """Narrow a range of strains to those whose voltage is within limits.

        Args:
            strains: lowest and highest strain; they stay where the map is within the limits.
            low_v: lowest voltage, in V.
            high_v: highest voltage, in V.
        Returns:
            Lowest and highest strain; None if no voltage is within the limits. A range more than
            ten times as wide as that of the map is narrowed to the map's, with zero, first.
        Example:
            >>> eq4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
            >>> low, high = eq4.reach((-0.05, 0.1), 0.0, 1.6)
            >>> low, round(high, 4)
            (-0.05, 0.0692)
        """
        low, high = strains
        if high - low > _MUCH_WIDER * (self.strain_high - self.strain_low):  # few points in reach
            strains = max(low, min(self.strain_low, 0.0)), min(high, max(self.strain_high, 0.0))
            if strains[0] >= strains[1]:
                return None
        zero = np.clip(0.0, *strains)  # not between two points, where it is the end of the range
        grid = np.unique(np.append(np.linspace(*strains, _REACH_POINTS), zero))
        volt = self.voltage_v(grid)
        inside = grid[(volt >= low_v) & (volt <= high_v)]
        return (float(inside[0]), float(inside[-1])) if inside.size else None

    def strain(self, voltage_v: ArrayLike) -> Floats:
        """Strain at which the map gives a voltage, within `[strain_low, strain_high]`.

        Args:
            voltage_v: voltage, in V. Shape `(...)`.
        Returns:
            Strain. Shape `(...)`.
        Raises:
            InputError: the map is not monotone in its range.
            LimitError: a voltage that the map does not reach in its range.
        Source: Newton's method kept inside a bracket by bisection.
        """
        if not self.is_monotone(self.strain_low, self.strain_high):
            raise InputError(
                f"The voltage map is not monotone in the strain range [{self.strain_low:g}, "
                f"{self.strain_high:g}]; it has no inverse there. Narrow the range."
            )
        target = np.asarray(voltage_v, dtype=np.float64)
        ends = self.voltage_v([self.strain_low, self.strain_high])
        slack_v = 1e-12 * float(np.abs(ends).max())
        outside = ~((target >= ends.min() - slack_v) & (target <= ends.max() + slack_v))
        if outside.any():
            raise LimitError(
                f"voltage_v = {float(target[outside].flat[0]):g} V is outside [{ends.min():g}, "
                f"{ends.max():g}] V, which the map reaches between the strains "
                f"{self.strain_low:g} and {self.strain_high:g}. Lower the request."
            )
        return self._solve(target, rising=bool(ends[1] > ends[0]))

    def _solve(self, target: Floats, *, rising: bool) -> Floats:
        low = np.full(target.shape, self.strain_low)
        high = np.full(target.shape, self.strain_high)
        guess = 0.5 * (low + high)
        for _ in range(_ITERATIONS):
            error_v = self.voltage_v(guess) - target
            above = (error_v > 0.0) == rising
            high, low = np.where(above, guess, high), np.where(above, low, guess)
            newton = guess - error_v / self.slope_v(guess)
            inside = (newton > low) & (newton < high)
            following = np.where(inside, newton, 0.5 * (low + high))
            done = np.abs(following - guess) <= 1e-15
            guess = following
            if done.all():
                break
        return np.asarray(guess)


@dataclass(frozen=True)
class LinearMap:
    """Strain from relative capacitance: `strain = slope C + offset`.

    Args:
        slope: strain per unit of relative capacitance.
        offset: strain at zero capacitance.
    Source: reference study, eq. 5, with its coefficients in the example.
    Example:
        >>> round(float(LinearMap(4.923e6, -0.276).strain(7.6e-8)), 4)
        0.0981
    """

    slope: float
    offset: float

    def strain(self, relative_capacitance: ArrayLike) -> Floats:
        """Strain for a relative capacitance. Shape of the argument."""
        return np.asarray(self.slope * np.asarray(relative_capacitance, np.float64) + self.offset)

    def relative_capacitance(self, strain: ArrayLike) -> Floats:
        """Inverse of `strain`; a map of slope zero is an `InputError`."""
        if self.slope == 0.0:
            raise InputError(
                "The capacitance map has slope 0, so strain does not determine the capacitance. "
                "Fit the map again."
            )
        return np.asarray((np.asarray(strain, np.float64) - self.offset) / self.slope)


def allow_start(strains: tuple[float, float]) -> bool:
    """Whether a loop can start at zero strain, or at an end of the range close to it.

    If zero strain is the length at 0 V, a fitted map gives a strain slightly different from 0 at
    0 V, so the range of the drive may exclude zero strain.

    Args:
        strains: lowest and highest strain.
    Returns:
        True if the range contains 0, or if 0 is outside by at most 5 % of the range's width.
    Example:
        >>> allow_start((-0.03, 0.1)), allow_start((0.0008, 0.08)), allow_start((0.01, 0.08))
        (True, True, False)
    """
    low, high = strains
    return max(low, -high) <= _NEAR_ZERO * (high - low)


def require_start(limits: tuple[float, float]) -> None:
    """Check that a loop with these limits of its output can start.

    Args:
        limits: lowest and highest strain.
    Raises:
        InputError: it cannot; see `allow_start`.
    """
    if not allow_start(limits):
        raise InputError(
            f"The controller's limits are {limits[0]:g} to {limits[1]:g}, but they must contain "
            "zero strain, where a loop starts. Widen the limits."
        )
