"""Static map as a smoothing spline, optionally monotone; the data determine the smoothness."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear, minimize_scalar

from haselab.base import Estimate, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import curve_chart
from haselab.identify.fit import CurveFit
from haselab.identify.independent import independent_share
from haselab.identify.noise import r_squared
from haselab.identify.statics.columns import check_pair
from haselab.identify.statics.cycles import loop_width, trend
from haselab.models import SplineMap

__all__ = ["MapFit", "fit_map"]

Floats = NDArray[np.float64]
_MOST_PIECES = 40
_LEAST_PIECES = 4
_SAMPLES_A_PIECE = 3
_LEAST_SAMPLES = 8
_LEAST_SLOPE = 1e-3  # of a monotone map, relative to the mean slope
_STIFFNESS = (-10.0, 8.0)  # decades of the weight of the curvature, relative to that of the data
_ROUNDS = 4
_FEW = 30  # independent samples below which the noise level is poorly known


@dataclass(frozen=True, kw_only=True)
class MapFit(CurveFit):
    """A fitted map; see `Fit` for what all fits have.

    Its `parameters` are the value at the first knot, `start`, and the slope at each knot,
    `slope_1` and so on.

    Args:
        x: that was fitted. Shape `(N,)`.
        y: the same. Shape `(N,)`.
        curve: the map; None without a result.
        monotone: whether the curve rises, or falls, everywhere.
        effective_parameters: effective degrees of freedom; 2 is a straight line.
        hysteresis_width: mean distance of the rising and the falling branch at equal x; 0 when
            there is one branch only.
        r_squared: share of the variance that the curve explains.
    """

    x: Floats = field(repr=False)
    y: Floats = field(repr=False)
    curve: SplineMap | None = None
    monotone: bool = False
    effective_parameters: float = math.nan
    hysteresis_width: float = math.nan
    r_squared: float = math.nan

    @property
    def map(self) -> SplineMap:
        """The map, for the abscissas of the record.

        Raises:
            ResultError: the fit has no result.
        """
        return self._present(self.curve)

    def value_std(self, x: ArrayLike) -> Floats:
        """Standard deviation of the value, in the unit of y.

        Includes the noise and the smoothing bias.

        Args:
            x: abscissas. Shape `(...)`.
        Returns:
            Standard deviation. Shape of `x`.
        Raises:
            ResultError: the fit has no result.
        """
        x = np.asarray(x, dtype=np.float64)
        columns = _columns(x.ravel(), self.map.knots)
        variance = np.einsum("ni,ij,nj->n", columns, self.covariance, columns)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(x.shape))

    def inverse_std(self, y: ArrayLike) -> Floats:
        """Standard deviation of the abscissa at which the map gives `y`, linearised about the map.

        Args:
            y: values. Shape `(...)`.
        Returns:
            Standard deviation, in the unit of x. Shape of `y`.
        Raises:
            ResultError: the fit has no result.
            InputError: the map is not monotone, or does not reach a value.
        """
        x = self.map.inverse(y)
        return np.asarray(self.value_std(x) / np.abs(self.map.slope(x)))

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """See `CurveFit`."""
        return np.asarray(self.map.value(x), dtype=np.float64)

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        grid = np.linspace(self.x.min(), self.x.max(), 400)
        fitted = grid, self.simulate(grid)
        return curve_chart(
            "Map", names or ("x", "y"), (self.x, self.y), fitted, self.value_std(grid)
        )

    def answer(self) -> JsonObject:
        """The result for JSON; arrays have one value per knot."""
        usable = self.succeeded
        return {
            "x": self.map.knots if usable else None,
            "y": self.map.values if usable else None,
            "y_std": self.value_std(self.map.knots) if usable else None,
            "slope": self.map.slopes if usable else None,
            "monotone": self.monotone,
            "effective_parameters": self.effective_parameters,
            "hysteresis_width": self.hysteresis_width,
            "r_squared": self.r_squared,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_map(x: ArrayLike, y: ArrayLike, *, monotone: bool = False) -> MapFit:
    r"""Penalised least squares of a quadratic spline.

    $\min \sum_i (y_i - f(x_i))^2 + \lambda \int f''^2$, with $f' \ge$ a thousandth of the mean
    slope for a monotone map

    The weight $\lambda$ maximises the restricted likelihood. Noise that is coloured in
    time, or a hysteresis loop, reduces the effective number of samples.

    Args:
        x: abscissas in order of time. Shape `(N,)`.
        y: values at the same times. Shape `(N,)`.
        monotone: keep the curve rising, or falling, everywhere, so that it has an inverse.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: fewer than 8 samples, unequal lengths, NaN, a constant column.
    Source: Ramsay, Statistical Science 3 (1988), 425; Wood, J. R. Stat. Soc. B 73 (2011), 3, for
        the weight; Nychka, J. Am. Stat. Assoc. 83 (1988), 1134, for the intervals.
    Example:
        >>> x = np.linspace(0.0, 1.0, 200)
        >>> y = np.tanh(3.0 * x) + 0.02 * np.random.default_rng(1).normal(size=200)
        >>> fit = fit_map(x, y, monotone=True)
        >>> bool(abs(fit.map.inverse(np.tanh(1.5)) - 0.5) < 4.0 * fit.inverse_std(np.tanh(1.5)))
        True
    """
    x, y = check_pair("x", x, "y", y, least=_LEAST_SAMPLES, record="record a sweep of it")
    distinct = np.unique(x).size
    pieces = max(_LEAST_PIECES, min(_MOST_PIECES, distinct // _SAMPLES_A_PIECE))
    sign = trend(x, y)
    if distinct < 4 or (monotone and sign == 0):
        reason = (
            f"no result: x has only {distinct} distinct values; record a sweep of x" if distinct < 4
            else "no result: y does not depend on x; check the columns, or fit without monotone"
        )  # fmt: skip
        return MapFit(status=reason, x=x, y=y)
    knots = np.linspace(x.min(), x.max(), pieces + 1)
    problem = _Problem.of(x, y, knots)
    weight, share = _weighed(problem)
    numbers = problem.solved(weight, share)
    least = _LEAST_SLOPE * float(np.ptp(y) / np.ptp(x))
    held = np.zeros(knots.size, dtype=bool)
    if monotone:
        numbers = problem.held(weight, share, sign, least)
        held = sign * numbers[1:] <= 1.001 * least
    residuals = y - problem.columns @ numbers
    curve = SplineMap(knots, numbers[1:], float(numbers[0]))
    covariance, effective = problem.spread(weight, share, float(residuals @ residuals))
    names = ["start", *(f"slope_{k}" for k in range(1, knots.size + 1))]
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return MapFit(
        status="ok",
        parameters={
            name: Estimate.normal(value, spread, "")
            for name, value, spread in zip(names, numbers, std, strict=True)
        },
        covariance=covariance,
        residuals=(residuals,),
        notes=_notes(curve, held, share * x.size),
        x=x,
        y=y,
        curve=curve,
        monotone=curve.is_monotone,
        effective_parameters=effective,
        hysteresis_width=loop_width(x, y, residuals),
        r_squared=r_squared(y, y - residuals),
    )


def _columns(x: Floats, knots: Floats) -> Floats:
    """1, then the integral up to `x` of each slope's hat. Shape `(N, K + 1)`."""
    width = np.diff(knots)
    past = np.clip(x[:, None] - knots[:-1], 0.0, width)
    falling = past - 0.5 * past**2 / width
    rising = 0.5 * past**2 / width
    hats = np.zeros((x.size, knots.size))
    hats[:, :-1] += falling
    hats[:, 1:] += rising
    return np.column_stack([np.ones(x.size), hats])


@dataclass(frozen=True)
class _Problem:
    """Penalised least squares, as sums over the samples.

    Args:
        columns: functions of the start and the slopes. Shape `(N, P)`.
        y: values. Shape `(N,)`.
        gram: `columns' columns`. Shape `(P, P)`.
        moment: `columns' y`. Shape `(P,)`.
        bending: integral of the squared second derivative, as a quadratic form of the parameters,
            scaled to the size of `gram`. Shape `(P, P)`.
    """

    columns: Floats
    y: Floats
    gram: Floats
    moment: Floats
    bending: Floats

    @classmethod
    def of(cls, x: Floats, y: Floats, knots: Floats) -> _Problem:
        columns = _columns(x, knots)
        change = np.diff(np.eye(knots.size), axis=0) / np.sqrt(np.diff(knots))[:, None]
        bending = np.zeros((knots.size + 1, knots.size + 1))
        bending[1:, 1:] = change.T @ change
        gram = columns.T @ columns
        bending *= np.trace(gram[1:, 1:]) / np.trace(bending)
        return cls(columns, y, gram, columns.T @ y, bending)

    def solved(self, weight: float, share: float) -> Floats:
        """Parameters of the smallest sum when a `share` of the samples counts."""
        matrix = share * self.gram + weight * self.bending
        return np.asarray(np.linalg.solve(matrix, share * self.moment))

    def held(self, weight: float, share: float, sign: int, least: float) -> Floats:
        """The same with all slopes of one sign."""
        triangle = np.linalg.cholesky(share * self.gram + weight * self.bending).T
        target = np.linalg.solve(triangle.T, share * self.moment)
        low = np.full(self.moment.size, least if sign > 0 else -np.inf)
        high = np.full(self.moment.size, np.inf if sign > 0 else -least)
        low[0], high[0] = -np.inf, np.inf
        return np.asarray(lsq_linear(triangle, target, (low, high), method="bvls").x)

    def spread(self, weight: float, share: float, cost: float) -> tuple[Floats, float]:
        """Covariance of the parameters, and the effective degrees of freedom."""
        inverse = np.asarray(np.linalg.inv(share * self.gram + weight * self.bending))
        effective = float(np.trace(inverse @ self.gram) * share)
        freedom = max(self.y.size - effective / share, 1.0) if share < 1.0 else 0.0
        freedom = max(freedom, self.y.size - effective, 1.0)
        return np.asarray(inverse * cost / freedom, dtype=np.float64), effective


def _weighed(problem: _Problem) -> tuple[float, float]:
    """Weight of the curvature, and the share of the samples that are independent."""
    share = 1.0
    weight = _likeliest(problem, share)
    for _ in range(_ROUNDS):
        residuals = problem.y - problem.columns @ problem.solved(weight, share)
        following = independent_share([residuals])
        settled = abs(math.log(following / share)) < 0.01
        share = following
        weight = _likeliest(problem, share)
        if settled:
            break
    return weight, share


def _likeliest(problem: _Problem, share: float) -> float:
    """Weight that maximises the restricted likelihood."""
    samples = max(share * problem.y.size, 4.0)
    total = share * float(problem.y @ problem.y)
    floor = 1e-14 * total

    def misfit(decade: float) -> float:
        weight = share * 10.0**decade
        matrix = share * problem.gram + weight * problem.bending
        numbers = problem.solved(weight, share)
        cost = total - share * float(problem.moment @ numbers)
        size = np.linalg.slogdet(matrix)[1] - (problem.moment.size - 2) * math.log(weight)
        return float((samples - 2.0) * math.log(max(cost, floor)) + size)

    grid = np.linspace(*_STIFFNESS, 49)
    best = int(np.argmin([misfit(decade) for decade in grid]))
    around = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = minimize_scalar(misfit, bounds=around, method="bounded", options={"xatol": 1e-3})
    return float(share * 10.0**found.x)


def _notes(curve: SplineMap, held: NDArray[np.bool_], samples: float) -> tuple[str, ...]:
    notes = []
    if held.any():
        low, high = curve.knots[held].min(), curve.knots[held].max()
        notes.append(
            f"The data are not monotone somewhere in [{low:.4g}, {high:.4g}]; the curve is held "
            "nearly flat there, and its inverse is not identifiable."
        )
    elif not curve.is_monotone:
        turn = float(curve.knots[1:][np.diff(np.sign(curve.slopes)) != 0][0])
        notes.append(f"The curve turns near x = {turn:.4g} and has no inverse. Use monotone.")
    if samples < _FEW:
        notes.append(
            f"The residuals are correlated, so the record is equivalent to {samples:.0f} "
            "independent samples and the intervals are rough. Record more cycles."
        )
    return tuple(notes)
