"""An estimated number: value, standard deviation, 95 % interval, unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from haselab.base.json import JsonObject

__all__ = ["Z95", "Estimate"]

Z95 = 1.959963984540054


@dataclass(frozen=True)
class Estimate:
    """A number with its uncertainty.

    Args:
        value: best value, in `unit`.
        std: standard deviation, in `unit`.
        ci95: 95 % interval `(low, high)`, in `unit`.
        unit: SI unit, `""` when dimensionless.

    Example:
        >>> [round(end, 6) for end in Estimate.normal(5.11, 0.02, "rad/s").ci95]
        [5.070801, 5.149199]
    """

    value: float
    std: float
    ci95: tuple[float, float]
    unit: str

    @classmethod
    def normal(cls, value: float, std: float, unit: str) -> Estimate:
        """Estimate whose error is normal with standard deviation `std`."""
        value, std = float(value), float(std)
        return cls(value, std, (value - Z95 * std, value + Z95 * std), unit)

    @classmethod
    def lognormal(cls, value: float, relative_std: float, unit: str) -> Estimate:
        """Estimate of a positive quantity whose logarithm has standard deviation `relative_std`.

        If `relative_std` is infinite, the interval is from 0 to infinity, with the sign of `value`.
        """
        value, relative_std = float(value), float(relative_std)
        if math.isinf(relative_std):
            whole = (0.0, math.inf) if value >= 0.0 else (-math.inf, 0.0)
            return cls(value, math.inf, whole, unit)
        factor = math.exp(Z95 * min(relative_std, 300.0))
        low, high = sorted((value / factor, value * factor))
        return cls(value, abs(value) * relative_std, (low, high), unit)

    @classmethod
    def inverse(
        cls, value: float, relative_std: float, unit: str, largest: float, power: float
    ) -> Estimate:
        """Estimate of a positive quantity with a normal error in a power of its inverse.

        Args:
            value: best value.
            relative_std: standard deviation of the quantity over its value, for small errors.
            unit: of both.
            largest: upper end of the interval where the inverse may as well be 0.
            power: of the inverse.
        """
        spread = power * Z95 * float(relative_std)
        high = value / (1.0 - spread) ** (1.0 / power) if spread < 1.0 else math.inf
        ends = value / (1.0 + spread) ** (1.0 / power), max(min(high, largest), value)
        return cls(float(value), value * relative_std, ends, unit)

    def scaled(self, factor: float, unit: str) -> Estimate:
        """Multiply by an exactly known factor, in another unit."""
        low, high = sorted((self.ci95[0] * factor, self.ci95[1] * factor))
        return Estimate(self.value * factor, self.std * abs(factor), (low, high), unit)

    def to_dict(self) -> JsonObject:
        """Convert to a dictionary: value, std, ci95, unit."""
        return {
            "value": self.value,
            "std": self.std,
            "ci95": [self.ci95[0], self.ci95[1]],
            "unit": self.unit,
        }

    @classmethod
    def from_dict(cls, data: JsonObject) -> Estimate:
        """Inverse of `to_dict`."""
        ends = data["ci95"]
        if not isinstance(ends, Sequence):
            raise TypeError(f"ci95 is {ends!r}, but must be a pair of numbers")
        low, high = (_number(end) for end in ends)
        return cls(_number(data["value"]), _number(data["std"]), (low, high), str(data["unit"]))


def _number(value: object) -> float:
    if not isinstance(value, (int, float)):
        raise TypeError(f"{value!r} is no number")
    return float(value)
