"""The ideal zipping pouch: two inextensible films about a constant amount of liquid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import LimitError
from haselab.base.root import root

__all__ = ["Arcs", "Pouch"]

Floats = NDArray[np.float64]
_LARGEST_SHARE = 0.9  # of the electrode in the pouch; the blocked force diverges towards 1
_NEWTON = 60


class Arcs(NamedTuple):
    """Zipped length (m), stroke (m) and zipped length per half angle (m/rad) of a pouch."""

    zipped_m: Floats
    stroke_m: Floats
    zipped_per_rad: Floats


@dataclass(frozen=True)
class Pouch:
    r"""Cross-section of a pouch whose films are two equal circular arcs of half angle $\alpha$.

    The electrodes zip from the end of the pouch. What is left of the film, $l$, encloses the fill
    area $A$, and the zipped length $z = L - l$ and the stroke $s$ follow:

    $l = \sqrt{2 A \alpha^2 / (\alpha - \sin\alpha\cos\alpha)},\quad
    s = L\,\frac{\sin\alpha_0}{\alpha_0} - l\,\frac{\sin\alpha}{\alpha} - (L - l)$

    The fill, $A = (L - L_e)^2/\pi$, makes the pouch a cylinder ($\alpha = \pi/2$) when the
    electrodes are used up, so that $z \le L_e$.

    Args:
        length_m: of the film of one pouch, L.
        electrode_m: of that, the part with electrodes, L_e.
    Raises:
        LimitError: The electrode covers more than 90 % of the pouch.
    Source: Kellaris, Gopaluni Venkata, Rothemund and Keplinger, Extreme Mech. Lett. 29 (2019),
        100449.
    Example:
        >>> pouch = Pouch(0.02, 0.01)
        >>> round(math.degrees(pouch.rest_angle_rad), 2), round(1e3 * pouch.rest_m, 2)
        (13.84, 19.81)
    """

    length_m: float
    electrode_m: float

    def __post_init__(self) -> None:
        if not self.electrode_m <= _LARGEST_SHARE * self.length_m:
            raise LimitError(
                f"The electrode of {self.electrode_m:g} m covers more than {_LARGEST_SHARE:.0%} of "
                f"the pouch of {self.length_m:g} m. Shorten the electrode."
            )

    @property
    def fill_m2(self) -> float:
        """Area of the liquid in the cross-section."""
        return (self.length_m - self.electrode_m) ** 2 / math.pi

    @cached_property
    def rest_angle_rad(self) -> float:
        """Half angle of the arcs before anything has zipped."""
        wanted = 2.0 * self.fill_m2 / self.length_m**2

        def missing(angle: float) -> float:
            return (angle - math.sin(angle) * math.cos(angle)) / angle**2 - wanted

        return root(missing, 1e-4, 0.5 * math.pi, xtol=1e-16, rtol=1e-15)

    @property
    def rest_m(self) -> float:
        """Distance of the pouch's ends before anything has zipped."""
        return self.length_m * math.sin(self.rest_angle_rad) / self.rest_angle_rad

    @property
    def longest_stroke_m(self) -> float:
        """Stroke at which the electrodes are used up."""
        return float(self.stroke_m(0.5 * math.pi))

    def arcs(self, angle_rad: Floats, sine: Floats, cosine: Floats) -> Arcs:
        """Zipped length, stroke and slope at once, where sine and cosine are known already.

        Args:
            angle_rad: half angle of the arcs. Shape `(...)`.
            sine: of the angle. Shape `(...)`.
            cosine: of the angle. Shape `(...)`.
        Returns:
            The same as `zipped_m`, `stroke_m` and `zipped_per_rad`.
        """
        bulge = angle_rad - sine * cosine
        left_m = angle_rad * np.sqrt(2.0 * self.fill_m2 / bulge)
        zipped_m = self.length_m - left_m
        stroke_m = self.rest_m - left_m * sine / angle_rad - zipped_m
        return Arcs(zipped_m, stroke_m, left_m * (sine**2 / bulge - 1.0 / angle_rad))

    def zipped_m(self, angle_rad: ArrayLike) -> Floats:
        """Zipped length.

        Args:
            angle_rad: half angle of the arcs. Shape `(...)`.
        Returns:
            Length, 0 at `rest_angle_rad`. Shape `(...)`.
        """
        return np.asarray(self.length_m - self._left_m(np.asarray(angle_rad, dtype=np.float64)))

    def stroke_m(self, angle_rad: ArrayLike) -> Floats:
        """Contraction of the pouch.

        Args:
            angle_rad: half angle of the arcs. Shape `(...)`.
        Returns:
            Stroke, 0 at `rest_angle_rad`. Shape `(...)`.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        left_m = self._left_m(angle)
        return np.asarray(self.rest_m - left_m * np.sin(angle) / angle - (self.length_m - left_m))

    def zipped_per_stroke(self, angle_rad: ArrayLike) -> Floats:
        """Slope of the zipped length over the stroke.

        Args:
            angle_rad: half angle of the arcs. Shape `(...)`.
        Returns:
            The slope, a ratio; 0 where the electrodes are used up. Shape `(...)`.
        """
        cosine = np.cos(np.asarray(angle_rad, dtype=np.float64))
        return np.asarray(cosine / (1.0 - cosine))

    def zipped_per_rad(self, angle_rad: ArrayLike) -> Floats:
        """Slope of the zipped length over the half angle.

        Args:
            angle_rad: half angle of the arcs. Shape `(...)`.
        Returns:
            The slope, in m/rad. Shape `(...)`.
        """
        angle = np.asarray(angle_rad, dtype=np.float64)
        bulge = angle - np.sin(angle) * np.cos(angle)
        return np.asarray(self._left_m(angle) * (np.sin(angle) ** 2 / bulge - 1.0 / angle))

    def angle_rad(self, stroke_m: ArrayLike) -> Floats:
        """Half angle at a stroke.

        Args:
            stroke_m: from 0 to `longest_stroke_m`, beyond which it is taken as its end. Shape
                `(...)`.
        Returns:
            The half angle. Shape `(...)`.
        """
        stroke = np.clip(np.asarray(stroke_m, dtype=np.float64), 0.0, self.longest_stroke_m)
        low = np.full(stroke.shape, self.rest_angle_rad)
        high = np.full(stroke.shape, 0.5 * math.pi)
        angle = 0.5 * (low + high)
        for _ in range(_NEWTON):  # Newton's steps, halving the bracket where one leaves it
            missing = self.stroke_m(angle) - stroke
            low, high = np.where(missing < 0.0, angle, low), np.where(missing < 0.0, high, angle)
            with np.errstate(all="ignore"):
                slope = self.zipped_per_rad(angle) / self.zipped_per_stroke(angle)
                wanted = angle - missing / slope
            inside = (low <= wanted) & (wanted <= high)
            new = np.where(inside, wanted, 0.5 * (low + high))
            if (np.abs(new - angle) <= 1e-15).all():
                break
            angle = new
        return np.asarray(angle)

    def _left_m(self, angle: Floats) -> Floats:
        bulge = angle - np.sin(angle) * np.cos(angle)
        return np.asarray(angle * np.sqrt(2.0 * self.fill_m2 / bulge))
