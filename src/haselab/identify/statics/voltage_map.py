"""Voltage from strain through a hysteresis loop: the sum of two exponentials, eq. 4."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import curve_chart
from haselab.identify.clipped import clipping_of
from haselab.identify.fit import CurveFit, propagated, rescaled
from haselab.identify.noise import coloured_covariance, r_squared
from haselab.identify.projection import Solution
from haselab.identify.statics.columns import check_pair, plausible_strain, plausible_voltage
from haselab.identify.statics.cycles import loop_width, trend
from haselab.identify.statics.exponentials import (
    coefficients,
    is_steep,
    least_split_reached,
    search_free,
    search_monotone,
    shapes_at,
)
from haselab.models.maps import VoltageMap

__all__ = ["VoltageMapFit", "fit_voltage_map"]

Floats = NDArray[np.float64]
_NAMES = ("a1_v", "b1", "a2_v", "b2")
_MARGIN = 0.2  # of the strain's span, on each side
_APART = 2.0  # standard deviations of the squared split; above, the two rates count as different


@dataclass(frozen=True, kw_only=True)
class VoltageMapFit(CurveFit):
    """A fitted voltage map; see `Fit` for what all fits have.

    Its `parameters` are `a1_v`, `b1`, `a2_v`, `b2`; the larger rate is `b1`. Parameters that
    the loop does not determine are NaN; `map` has a value for each.

    Args:
        monotone: whether the curve rises, or falls, over the whole range of the map.
        hysteresis_width: mean distance of the rising and the falling branch at equal strain, in
            V; 0 when there is one branch only.
        r_squared: share of the voltage's variance that the curve explains.
        strain: that was fitted. Shape `(N,)`.
        voltage_v: the same, in V. Shape `(N,)`.
        curve: the curve in well-conditioned numbers, with their covariance. None: no result.
    """

    monotone: bool = False
    hysteresis_width: float = math.nan
    r_squared: float = math.nan
    strain: Floats = field(repr=False)
    voltage_v: Floats = field(repr=False)
    curve: _Curve | None = field(default=None, repr=False)

    @property
    def map(self) -> VoltageMap:
        """The map, for the strains of the record and a fifth of their span on each side.

        Raises:
            ResultError: the fit has no result.
        """
        return self._fitted().map

    @property
    def residual_std_v(self) -> float:
        """Root mean square of the residuals, in V: accuracy of the map, hysteresis included."""
        return float(np.sqrt(np.mean(self.residuals[0] ** 2))) if self.residuals else math.nan

    def curve_std(self, strain: ArrayLike) -> Floats:
        """Standard deviation of the fitted voltage, in V.

        Args:
            strain: strains, dimensionless. Shape `(...)`.
        Returns:
            Standard deviation. Shape of `strain`.
        Raises:
            ResultError: the fit has no result.
        """
        return self._fitted().std_v(np.asarray(strain, dtype=np.float64))

    def linear_coefficients(self) -> dict[str, Estimate]:
        """The coefficients by linear error propagation, those that are not identifiable too.

        Where the loop does not separate the two exponentials, the intervals are too narrow or far
        too wide. They serve to compare two fits of the same loop, such as one without noise.

        Returns:
            `a1_v`, `b1`, `a2_v`, `b2`.
        Raises:
            ResultError: the fit has no result.
        """
        return self._fitted().linear()[0]

    def _fitted(self) -> _Curve:
        return self._present(self.curve)

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """Voltage at strains, in V; see `CurveFit`."""
        return np.asarray(self.map.voltage_v(x), dtype=np.float64)

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        grid = np.linspace(self.strain.min(), self.strain.max(), 400)
        return curve_chart(
            "Voltage map", names or ("Strain", "Voltage (V)"), (self.strain, self.voltage_v),
            (grid, self.simulate(grid)), self.curve_std(grid),
        )  # fmt: skip

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "residual_std_v": self.residual_std_v,
            "hysteresis_width": self.hysteresis_width,
            "r_squared": self.r_squared,
            "monotone": self.monotone,
            **{name: self.parameters.get(name) for name in _NAMES},
            "status": self.status,
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class _Curve:
    """The fitted curve as a function of `x = (strain - middle) / half`, see `exponentials`.

    Args:
        middle: middle of the record's strains.
        half: half their span.
        numbers: mean rate, square of the split, and both factors. Shape `(4,)`.
        covariance: of `numbers`. Shape `(4, 4)`.
    """

    middle: float
    half: float
    numbers: Floats
    covariance: Floats

    @property
    def map(self) -> VoltageMap:
        reach = (1.0 + 2.0 * _MARGIN) * self.half
        values = coefficients(self.numbers, self.middle, self.half)[0]
        a1_v, b1, a2_v, b2 = (float(value) for value in values)
        return VoltageMap(a1_v, b1, a2_v, b2, self.middle - reach, self.middle + reach)

    def std_v(self, strain: Floats) -> Floats:
        x = np.atleast_1d((strain - self.middle) / self.half).ravel()
        shapes, slopes = shapes_at(self.numbers[:2], x)
        columns = np.hstack([(slopes @ self.numbers[2:]).T, shapes])
        variance = np.einsum("ni,ij,nj->n", columns, self.covariance, columns)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(strain.shape))

    def estimates(self) -> tuple[dict[str, Estimate], Floats]:
        """Return the coefficients with their covariance.

        If the data do not separate the two rates, the errors of the coefficients are not normal,
        so they are reported as not identifiable. The curve is still identifiable.
        """
        linear, covariance = self.linear()
        std = np.array([estimate.std for estimate in linear.values()])
        split, split_std = float(self.numbers[1]), math.sqrt(float(self.covariance[1, 1]))
        separate = split > _APART * split_std and not least_split_reached(self.numbers)
        std = np.where(np.isfinite(std) & separate, std, math.inf)
        unknown = math.nan, math.inf, (-math.inf, math.inf)
        return {
            name: known if spread < math.inf else Estimate(*unknown, known.unit)
            for (name, known), spread in zip(linear.items(), std, strict=True)
        }, rescaled(covariance, std)

    def linear(self) -> tuple[dict[str, Estimate], Floats]:
        """Coefficients with their covariance, by linear error propagation."""
        values, slope = coefficients(self.numbers, self.middle, self.half)
        covariance = propagated(slope, self.covariance)
        with np.errstate(invalid="ignore"):
            std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        return {
            name: Estimate.normal(value, spread, "V" if name.endswith("_v") else "")
            for name, value, spread in zip(_NAMES, values, std, strict=True)
        }, covariance


@checked
def fit_voltage_map(strain: ArrayLike, voltage_v: ArrayLike) -> VoltageMapFit:
    r"""Fit the sum of two exponentials through a loop, monotone over the range of the map.

    $V = a_1 e^{b_1 \varepsilon} + a_2 e^{b_2 \varepsilon}$: the rates are searched from a grid,
    the amplitudes are solved for. A curve that would turn within the range is held back to a
    slope of a thousandth of the mean slope; the intervals ignore that limit.

    Args:
        strain: strains in order of time, dimensionless. Shape `(N,)`.
        voltage_v: voltages, in V. Shape `(N,)`.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: fewer than 8 samples, unequal lengths, NaN, a constant column.
    Source: reference study, eq. 4; variable projection, Golub and Pereyra (1973); intervals from
        the covariance for the noise model of the residuals, which include the hysteresis.
    Example:
        >>> strain = np.linspace(-0.045, 0.147, 200)
        >>> voltage_v = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(strain)
        >>> voltage_v = voltage_v + 0.001 * np.random.default_rng(1).normal(size=200)
        >>> fit = fit_voltage_map(strain, voltage_v)
        >>> low, high = fit.parameters["b2"].ci95
        >>> fit.status, low < -26.92 < high
        ('ok', True)
    """
    e, v, doubts = _checked(strain, voltage_v)
    middle, half = 0.5 * float(e.max() + e.min()), 0.5 * float(np.ptp(e))
    x = (e - middle) / half
    sign = trend(x, v)
    clipped = clipping_of(e, "strains")
    if clipped or sign == 0:
        why = clipped or "the voltage does not depend on the strain; check the columns"
        reason = f"no result: {why}"
        return VoltageMapFit(status=reason, strain=e, voltage_v=v)
    reach = 1.0 + 2.0 * _MARGIN
    solution = search_free(x, v)
    limited = not is_steep(solution, v, sign, reach)
    if limited:
        solution = search_monotone(x, v, sign, reach)
    covariance = coloured_covariance(solution.columns, solution.residuals, 4)
    numbers = np.concatenate([solution.search, solution.shared])
    fit = _describe(e, v, _Curve(middle, half, numbers, covariance), solution, limited)
    return replace(fit, notes=(*fit.notes, *doubts))


def _checked(strain: ArrayLike, voltage_v: ArrayLike) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Check both columns; return a note where the strain may be in per cent."""
    e, v = check_pair(
        "strain", strain, "voltage_v", voltage_v, least=8, record="record a triangle test"
    )
    plausible_voltage(v)
    return e, v, plausible_strain(e, "voltage_v", v)


def _describe(
    e: Floats, v: Floats, curve: _Curve, solution: Solution, limited: bool
) -> VoltageMapFit:
    """Parameters with intervals, status and notes."""
    (estimates, covariance), residuals = curve.estimates(), solution.residuals[0]
    chart = curve.map
    return VoltageMapFit(
        status="ok",
        parameters=estimates,
        covariance=covariance,
        residuals=(residuals,),
        notes=_notes(estimates, limited),
        monotone=chart.is_monotone(chart.strain_low, chart.strain_high),
        hysteresis_width=loop_width(e, v, residuals),
        r_squared=r_squared(v, v - residuals),
        strain=e,
        voltage_v=v,
        curve=curve,
    )


def _notes(estimates: dict[str, Estimate], limited: bool) -> tuple[str, ...]:
    notes = []
    if limited:
        notes.append(
            "The best curve turns within the range of the map; the best monotone one is given."
        )
    blind = [name for name, estimate in estimates.items() if math.isnan(estimate.value)]
    if blind:
        notes.append(
            f"Not identifiable from this loop: {', '.join(blind)}, because the loop does not "
            "separate the two exponentials. The curve is still identifiable: use the map."
        )
    return tuple(notes)
