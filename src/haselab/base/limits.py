"""Ranges of quantities. A value outside is refused, never clipped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from haselab.base.errors import LimitError

__all__ = ["Limits"]


@dataclass(frozen=True)
class Limits:
    """A closed range `[low, high]` of one named quantity.

    Args:
        name: of the quantity, for error messages.
        low: smallest allowed value, in `unit`.
        high: largest allowed value, in `unit`.
        unit: SI unit.
        low_source: file that `low` comes from, for error messages.
        high_source: file that `high` comes from.

    Example:
        >>> Limits("drive voltage", 0.0, 2.0, "V").check(1.5)
    """

    name: str
    low: float
    high: float
    unit: str
    low_source: str = "the rig file"
    high_source: str = "the rig file"

    def check(self, value: ArrayLike) -> None:
        """Raise `LimitError` unless every element of `value` is finite and inside the range."""
        if type(value) is float and self.low <= value <= self.high:
            return  # one number of a block, without an array
        values = np.atleast_1d(np.asarray(value, dtype=float))
        outside = ~((values >= self.low) & (values <= self.high))
        if outside.any():
            worst = float(values[outside][0])
            unit = f" {self.unit}" if self.unit else ""
            source = self.low_source if worst < self.low else self.high_source
            raise LimitError(
                f"{self.name} = {worst:g}{unit} is outside [{self.low:g}, {self.high:g}]{unit}. "
                f"Lower the request, or widen the limit in {source}."
            )
