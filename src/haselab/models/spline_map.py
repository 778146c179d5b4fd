"""A static map as a quadratic spline with an exact inverse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, LimitError

__all__ = ["SplineMap"]

Floats = NDArray[np.float64]
_SLACK = 1e-12  # of the range: rounding error of a value at the end of the range


@dataclass(frozen=True)
class SplineMap:
    r"""Quadratic spline, defined by its slopes at the knots.

    Between two knots the slope is linear, so the curve rises everywhere exactly when it
    rises at all knots, and each segment is inverted in closed form.

    Args:
        knots: rising abscissas; the first and last are the ends of the map. Shape `(K,)`, two at
            least.
        slopes: derivative at the knots. Shape `(K,)`.
        start: value at the first knot.
    Raises:
        InputError: unequal lengths, values that are not finite, knots that do not rise.
    Source: Ramsay, Statistical Science 3 (1988), 425, integrated splines of order 2.
    Example:
        >>> curve = SplineMap(np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 3.0]), 0.5)
        >>> curve.value([0.0, 1.0, 2.0]).tolist(), curve.inverse(4.0).tolist()
        ([0.5, 2.5, 5.5], 1.5)
    """

    knots: Floats
    slopes: Floats
    start: float

    def __post_init__(self) -> None:
        knots = np.asarray(self.knots, dtype=np.float64)
        slopes = np.asarray(self.slopes, dtype=np.float64)
        fine = knots.ndim == 1 and knots.size >= 2 and knots.shape == slopes.shape
        if not fine or not np.isfinite([*knots, *slopes, self.start]).all():
            raise InputError(
                f"The map has {knots.size} knots and {slopes.size} slopes; it must have two or "
                "more of each, finite. Fit the map again."
            )
        if not (np.diff(knots) > 0.0).all():
            raise InputError("The knots do not rise. Fit the map again.")
        object.__setattr__(self, "knots", knots)
        object.__setattr__(self, "slopes", slopes)

    @property
    def values(self) -> Floats:
        """Values at the knots. Shape `(K,)`."""
        steps = np.diff(self.knots) * 0.5 * (self.slopes[1:] + self.slopes[:-1])
        return np.asarray(self.start + np.concatenate([[0.0], np.cumsum(steps)]))

    @property
    def is_monotone(self) -> bool:
        """Whether the map rises, or falls, everywhere, so that it has an inverse."""
        return bool((self.slopes > 0.0).all() or (self.slopes < 0.0).all())

    def value(self, x: ArrayLike) -> Floats:
        """Value of the map.

        Args:
            x: abscissas within the knots. Shape `(...)`.
        Returns:
            Values. Shape of `x`.
        Raises:
            LimitError: an abscissa outside the knots.
        """
        x, piece, past = self._placed(x)
        bend = (self.slopes[piece + 1] - self.slopes[piece]) / np.diff(self.knots)[piece]
        return np.asarray(self.values[piece] + past * (self.slopes[piece] + 0.5 * bend * past))

    def slope(self, x: ArrayLike) -> Floats:
        """Derivative of the map. Arguments, shape and errors of `value`."""
        x, _, _ = self._placed(x)
        return np.asarray(np.interp(x, self.knots, self.slopes))

    def _placed(self, x: ArrayLike) -> tuple[Floats, NDArray[np.intp], Floats]:
        """Abscissas, the indices of their segments, and their distances from the knots."""
        x = np.asarray(x, dtype=np.float64)
        x = _inside(x, float(self.knots[0]), float(self.knots[-1]), "x")
        piece = np.clip(np.searchsorted(self.knots, x, side="right") - 1, 0, self.knots.size - 2)
        return x, piece, x - self.knots[piece]

    def inverse(self, y: ArrayLike) -> Floats:
        """Abscissa at which the map gives a value.

        Args:
            y: values. Shape `(...)`.
        Returns:
            Abscissas. Shape of `y`.
        Raises:
            InputError: the map is not monotone.
            LimitError: a value that the map does not reach.
        """
        if not self.is_monotone:
            turns = self.knots[1:][np.diff(np.sign(self.slopes)) != 0]
            raise InputError(
                f"The map turns near x = {float(turns[0]):g}, so it has no inverse. "
                "Fit it as monotone."
            )
        sign, values = np.sign(self.slopes[0]), self.values
        low, high = sorted((float(values[0]), float(values[-1])))
        y = _inside(np.asarray(y, dtype=np.float64), low, high, "y")
        rising = sign * values
        piece = np.clip(np.searchsorted(rising, sign * y, side="right") - 1, 0, self.knots.size - 2)
        gap, slope = y - values[piece], self.slopes[piece]
        bend = (self.slopes[piece + 1] - slope) / np.diff(self.knots)[piece]
        # The root of the quadratic in the form that is exact also for a straight segment.
        root = np.sqrt(np.maximum(slope * slope + 2.0 * bend * gap, 0.0))
        past = 2.0 * gap / (slope + sign * root)
        return np.asarray(np.minimum(self.knots[piece] + past, self.knots[piece + 1]))


def _inside(values: Floats, low: float, high: float, name: str) -> Floats:
    """Clamp rounding errors at the ends; other outside values are a `LimitError`."""
    slack = _SLACK * max(high - low, abs(low), abs(high))
    outside = ~((values >= low - slack) & (values <= high + slack))
    if outside.any():
        raise LimitError(
            f"{name} = {float(values[outside].flat[0]):g} is outside [{low:g}, {high:g}], which "
            "the map was fitted for. Stay within, or record a wider range."
        )
    return np.asarray(np.minimum(np.maximum(values, low), high))
