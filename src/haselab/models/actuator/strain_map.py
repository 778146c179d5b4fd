"""Strain from capacitance in farads, with its covariance, its band and its range of validity."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, LimitError

__all__ = ["LARGEST_FEEDTHROUGH", "StrainMap"]

Floats = NDArray[np.float64]
LARGEST_FEEDTHROUGH = 0.98  # above, a sensed strain says next to nothing about the length
_BEYOND = 1.0  # of the width of the fitted range, on either side


@dataclass(frozen=True)
class StrainMap:
    r"""Strain as a function of capacitance: $\varepsilon = ((r\,C + q)\,C + k)\,C + \varepsilon_0$.

    The only map from farads to strain: measured by `haselab.sensing.strain.fit_strain_map`, kept in
    `[sensing.strain_map]` of actuator.toml, used by the loop on the desktop and compiled into the
    microcontroller. Without covariance, range or band its uncertainty is unknown.

    Args:
        slope_per_f: in 1/F.
        offset: strain at zero capacitance.
        curvature_per_f2: in 1/F^2; 0 for the study's straight line.
        cubic_per_f3: in 1/F^3; 0 for a line or a parabola.
        covariance: of slope, offset, curvature and cubic factor; rows and columns of 0 for a known
            coefficient. Shape `(4, 4)`.
        range_f: lowest and highest capacitance of the record that was fitted, in F.
        limits_f: capacitances outside which the map must not be used, in F, because the record
            showed that the strain does not follow it there; None: see `usable_f`.
        band: lowest and highest deviation of the strain from the map.
        coverage: share of the deviations that the band should contain.
        held_out_coverage: share inside the band, for cycles left out of fit and band.
        hysteresis_strain: largest distance between the rising and the falling branch, in strain.
        residual_std: root mean square of the deviations, in strain.
        feedthrough: fraction of the steady-state change of this strain that appears together with
            a step of the voltage, before the actuator moves, where the capacitance depends on the
            voltage as well as on the length; NaN: not known.
        feedthrough_std: its standard deviation.
    Raises:
        InputError: coefficients that are not finite, a range or a band that is empty, a map that
            turns within its range.
    Example:
        >>> line = StrainMap(4.923e8, -0.276, range_f=(5e-10, 8e-10), band=(-0.002, 0.002))
        >>> [round(float(end), 4) for end in line.interval(7.6e-10)]
        [0.0961, 0.1001]
    """

    slope_per_f: float
    offset: float
    curvature_per_f2: float = 0.0
    cubic_per_f3: float = 0.0
    covariance: tuple[tuple[float, ...], ...] | None = None
    range_f: tuple[float, float] | None = None
    limits_f: tuple[float, float] | None = None
    band: tuple[float, float] | None = None
    coverage: float = 0.95
    held_out_coverage: float = math.nan
    hysteresis_strain: float = math.nan
    residual_std: float = math.nan
    feedthrough: float = math.nan
    feedthrough_std: float = math.nan

    def __post_init__(self) -> None:
        if not np.isfinite(self.coefficients).all():
            raise InputError(
                f"The strain map has the coefficients {self.coefficients}, but they must be "
                "finite. Fit the map again."
            )
        for name, ends in (
            ("range_f", self.range_f), ("limits_f", self.limits_f), ("band", self.band)
        ):  # fmt: skip
            if ends is not None and not ends[0] <= ends[1]:
                raise InputError(
                    f"{name} of the strain map is [{ends[0]:g}, {ends[1]:g}]. Give the lower end "
                    "first."
                )
        low_f, high_f = self.range_f or (-math.inf, math.inf)
        inside_f = 1e-6 * (high_f - low_f)  # a map may end where it turns
        if self.range_f is not None and any(
            low_f + inside_f < turn_f < high_f - inside_f for turn_f in self.turns_f
        ):
            raise InputError(
                f"The strain map turns at {self.turns_f[0]:.4g} F, within its range of {low_f:.4g} "
                f"to {high_f:.4g} F: a loop would get the wrong direction there. Fit the map again "
                "with haselab identify capacitance-map, or narrow range_f."
            )
        columns = [len(row) for row in self.covariance or ()]
        if self.covariance is not None and columns != [4] * 4:
            raise InputError(
                f"The covariance of the strain map has rows of {columns} numbers, but needs 4 rows "
                "of 4: slope_per_f, offset, curvature_per_f2, cubic_per_f3."
            )

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Slope, offset, curvature and cubic factor, as the C core uses them."""
        return self.slope_per_f, self.offset, self.curvature_per_f2, self.cubic_per_f3

    def strain(self, capacitance_f: ArrayLike) -> Floats:
        """Strain of each capacitance, also outside of `range_f`; NaN stays NaN.

        Args:
            capacitance_f: any shape, in F.
        Returns:
            Strain, the same shape.
        """
        c = np.asarray(capacitance_f, dtype=np.float64)
        slope = self.cubic_per_f3 * c + self.curvature_per_f2
        return np.asarray((slope * c + self.slope_per_f) * c + self.offset)

    def std(self, capacitance_f: ArrayLike) -> Floats:
        """Standard deviation of the map itself, by its covariance; NaN without one.

        Args:
            capacitance_f: any shape, in F.
        Returns:
            Standard deviation of the strain, the same shape.
        """
        c = np.asarray(capacitance_f, dtype=np.float64)
        if self.covariance is None:
            return np.full(c.shape, np.nan)
        slopes = np.stack([c, np.ones_like(c), c**2, c**3], axis=-1)
        variance = np.einsum("...i,ij,...j->...", slopes, np.asarray(self.covariance), slopes)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def inside(self, capacitance_f: ArrayLike) -> NDArray[np.bool_]:
        """Whether each capacitance is in the fitted range; False for NaN."""
        c = np.asarray(capacitance_f, dtype=np.float64)
        low_f, high_f = (-math.inf, math.inf) if self.range_f is None else self.range_f
        return np.asarray((c >= low_f) & (c <= high_f))

    @property
    def usable_f(self) -> tuple[float, float]:
        """Capacitances for which a loop may use the map, in F; without a range, all of them.

        Creep, overshoot and another load take an actuator a little beyond the record that was
        fitted: there the strain is extrapolated, beyond its band but still a strain to control.
        The map is not used further out than the width of the fitted range, than `limits_f`, and
        than where the polynomial turns.
        """
        if self.range_f is None:
            return self.limits_f or (-math.inf, math.inf)
        low_f, high_f = self.range_f
        beyond_f = _BEYOND * (high_f - low_f)
        least_f, most_f = self.limits_f or (low_f - beyond_f, high_f + beyond_f)
        middle_f = 0.5 * (low_f + high_f)
        return (
            max([least_f, *(turn_f for turn_f in self.turns_f if turn_f < middle_f)]),
            min([most_f, *(turn_f for turn_f in self.turns_f if turn_f > middle_f)]),
        )

    @property
    def turns_f(self) -> tuple[float, ...]:
        """Capacitances at which the polynomial turns, in F, in order."""
        a, b, c = 3.0 * self.cubic_per_f3, 2.0 * self.curvature_per_f2, self.slope_per_f
        if a == 0.0:
            return () if b == 0.0 else (-c / b,)
        root = b * b - 4.0 * a * c
        if not root > 0.0:
            return ()
        sum_ = -0.5 * (b + math.copysign(math.sqrt(root), b))  # without cancellation
        return tuple(sorted({sum_ / a, c / sum_ if sum_ else 0.0}))

    def interval(self, capacitance_f: ArrayLike) -> tuple[Floats, Floats]:
        """Ends of the strain's interval: the map plus its band.

        Args:
            capacitance_f: any shape, in F.
        Returns:
            Lower and upper strain, the same shape each.
        Raises:
            InputError: the map has no band.
            LimitError: a capacitance outside the record that was fitted.
        """
        if self.band is None:
            raise InputError(
                "The strain map has no band, so the strain has no interval. Fit the map with "
                "`haselab identify capacitance-map`, or add band to [sensing.strain_map]."
            )
        c = np.asarray(capacitance_f, dtype=np.float64)
        outside = ~self.inside(c) & ~np.isnan(c)
        if self.range_f is not None and outside.any():
            raise LimitError(
                f"Capacitance = {c[outside].flat[0]:.6g} F is outside [{self.range_f[0]:.6g}, "
                f"{self.range_f[1]:.6g}] F, where the map was fitted. Fit a record that reaches "
                "there."
            )
        middle = self.strain(c)
        return middle + self.band[0], middle + self.band[1]

    def slope_at(self, capacitance_f: float) -> float:
        """Slope of the strain over the capacitance, in 1/F, at a capacitance in F."""
        c = capacitance_f
        return (3.0 * self.cubic_per_f3 * c + 2.0 * self.curvature_per_f2) * c + self.slope_per_f

    def rebased(self, zero: float) -> StrainMap:
        """The same map for a strain relative to another length.

        Args:
            zero: strain of this map that becomes 0.
        Returns:
            The map of `(strain - zero) / (1 + zero)`.
        """
        scale = 1.0 + zero
        cov = self.covariance
        return replace(
            self,
            slope_per_f=self.slope_per_f / scale,
            offset=(self.offset - zero) / scale,
            curvature_per_f2=self.curvature_per_f2 / scale,
            cubic_per_f3=self.cubic_per_f3 / scale,
            covariance=None
            if cov is None
            else tuple(tuple(x / scale**2 for x in row) for row in cov),
            band=None if self.band is None else (self.band[0] / scale, self.band[1] / scale),
            hysteresis_strain=self.hysteresis_strain / scale,
            residual_std=self.residual_std / scale,
        )
