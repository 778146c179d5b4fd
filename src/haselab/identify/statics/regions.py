"""Linear regions of a load-stretch curve: a broken line whose break points are fitted too."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import curve_chart
from haselab.identify.fit import CurveFit, propagated, rescaled
from haselab.identify.independent import independent_share, spread_of, student_estimate
from haselab.identify.noise import r_squared
from haselab.identify.projection import Basis, Solution, minimise, project
from haselab.identify.statics.broken_line import BreakGrid, best_breaks
from haselab.identify.statics.columns import check_pair, plausible_stretch

__all__ = ["Region", "RegionsFit", "find_regions"]

Floats = NDArray[np.float64]
_MOST_SEGMENTS = 6
_LEAST_SAMPLES = 3
_FINAL_STEPS = 100  # first steps of the last search, in the range of stretch
_PROFILE_STEPS = 8
_PROFILE_GAP = 0.03
_ROUNDING = 1e-9  # of the load's span: residuals below it do not count for BIC


@dataclass(frozen=True)
class Region:
    """One straight segment.

    Args:
        low: stretch at its lower end.
        high: stretch at its upper end.
        slope_n: load per unit stretch, in N.
        r_squared: share of the load's variance within the segment that the line explains.
    """

    low: Estimate
    high: Estimate
    slope_n: Estimate
    r_squared: float

    def to_dict(self) -> JsonObject:
        """The form of the public contract."""
        return {
            "stretch": [self.low.value, self.high.value],
            "stretch_low": self.low,
            "stretch_high": self.high,
            "slope_n": self.slope_n,
            "r_squared": self.r_squared,
        }


@dataclass(frozen=True, kw_only=True)
class RegionsFit(CurveFit):
    """A broken line; see `Fit` for what all fits have.

    Its `parameters` are the break points `break_1` and so on and the slopes `slope_1_n` and so
    on, in the order of the stretch; its `residuals` are load minus line at `stretch`, in N.

    Args:
        regions: straight segments, the longest first.
        r_squared: share of the load's variance that the broken line explains.
        bic: Bayesian information criterion for each number of segments that was tried, relative to
            that of the chosen number.
        stretch: stretches, sorted. Shape `(N,)`.
        load_n: load at `stretch`, in N. Shape `(N,)`.
    """

    regions: tuple[Region, ...] = ()
    r_squared: float = math.nan
    bic: dict[int, float] = field(default_factory=dict)
    stretch: Floats = field(repr=False)
    load_n: Floats = field(repr=False)

    @property
    def chosen(self) -> int:
        """Index of the longest region."""
        return 0

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """Load at stretches, in N; the first and the last piece go on. See `CurveFit`."""
        self._require()
        segments = sorted(self.regions, key=lambda region: region.low.value)
        slopes_n = [region.slope_n.value for region in segments]
        breaks = np.array([region.low.value for region in segments[1:]])
        stretch = np.atleast_1d(np.asarray(x, dtype=np.float64))
        bends = np.maximum(stretch[:, None] - breaks, 0.0) @ np.diff(slopes_n)
        start_n = float(self.load_n[0] - self.residuals[0][0])
        return np.asarray(start_n + slopes_n[0] * (stretch - self.stretch[0]) + bends)

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        self._require()
        title, line_n = f"{len(self.regions)} linear regions", self.load_n - self.residuals[0]
        return curve_chart(
            title, names or ("Stretch", "Force (N)"), (self.stretch, self.load_n),
            (self.stretch, line_n),
        )  # fmt: skip

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "regions": [region.to_dict() for region in self.regions],
            "chosen": self.chosen if self.regions else None,
            "r_squared": self.r_squared,
            "bic": {str(segments): value for segments, value in self.bic.items()},
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def find_regions(stretch: ArrayLike, load_n: ArrayLike, segments: int | None = None) -> RegionsFit:
    r"""Fit a continuous broken line; its straight segments are the linear regions.

    $\min \sum_i \bigl(F_i - c - \sum_k s_k\,(\lambda_i - \lambda_k)_+\bigr)^2$ over the break
    points too: the best of a grid is found exactly, then refined. Each segment has three
    samples or more.

    Args:
        stretch: stretches, in any order. Shape `(N,)`.
        load_n: loads, in N. Shape `(N,)`.
        segments: number of straight segments. None: the number of up to six that BIC prefers.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: too few samples for the segments, unequal lengths, NaN, no change.
    Source: reference study, row S17; Hudson, J. Am. Stat. Assoc. 61 (1966), 1097; intervals from
        the covariance for the noise model of the residuals.
    Example:
        >>> stretch = np.linspace(1.0, 3.0, 81)
        >>> load_n = np.where(stretch < 1.6, 5.0 * stretch, 8.0 + 2.0 * (stretch - 1.6))
        >>> load_n = load_n + 0.01 * np.random.default_rng(2).normal(size=81)
        >>> fit = find_regions(stretch, load_n)
        >>> longest = fit.regions[fit.chosen]
        >>> len(fit.regions), longest.low.ci95[0] < 1.6 < longest.low.ci95[1]
        (2, True)
    """
    x, y = _checked(stretch, load_n, segments)
    most = min(_MOST_SEGMENTS, x.size // _LEAST_SAMPLES) if segments is None else segments
    starts = best_breaks(BreakGrid.of(x, y), most, _LEAST_SAMPLES)
    tried = {
        count: _best(x, y, found)
        for count, found in starts.items()
        if segments is None or count == segments
    }
    if not tried:
        reason = "no result: too few distinct stretches for these segments; fit fewer segments"
        return RegionsFit(status=reason, stretch=x, load_n=y)
    # The residuals of the largest number of segments contain the least of the curve.
    share = independent_share(tried[max(tried)].residuals)
    scores = {count: _bic(solution, count, y, share) for count, solution in tried.items()}
    chosen = min(scores, key=lambda count: scores[count])
    bic = {count: score - scores[chosen] for count, score in scores.items()}
    return _describe(x, y, _settled(x, y, tried[chosen]), bic)


def _checked(stretch: ArrayLike, load_n: ArrayLike, segments: int | None) -> tuple[Floats, Floats]:
    x, y = check_pair(
        "stretch", stretch, "load_n", load_n, least=2 * _LEAST_SAMPLES, record="record more loads"
    )
    plausible_stretch(x, "load_n", y)
    most = x.size // _LEAST_SAMPLES
    if segments is not None and not 1 <= segments <= most:
        raise InputError(
            f"segments = {segments}; it must be 1 to {most}, a third of the {x.size} samples. "
            "Fit fewer segments, or record more loads."
        )
    order = np.argsort(x, kind="stable")
    return x[order], y[order]


def _bases(x: Floats, y: Floats, breaks: Floats) -> list[Basis]:
    """Constant, slope, and the change of slope at each break point."""
    past = x[:, None] - breaks
    shapes = np.column_stack([np.ones_like(x), x - x[0], np.maximum(past, 0.0)])
    slopes = np.zeros((breaks.size, x.size, shapes.shape[1]))
    for k in range(breaks.size):
        slopes[k, :, 2 + k] = np.where(past[:, k] > 0.0, -1.0, 0.0)
    none = np.zeros((x.size, 0))
    return [Basis(y, shapes, none, slopes, np.zeros(x.size), np.zeros((breaks.size, x.size)))]


def _best(x: Floats, y: Floats, starts: list[Floats]) -> Solution:
    """The best of several lines on the grid, with its break points refined."""
    found = []
    for start in starts:
        on_grid = project(start, _bases(x, y, start))
        fences = np.concatenate([[x[0]], 0.5 * (start[1:] + start[:-1]), [x[-1]]])
        bounds = fences[:-1][: start.size], fences[1:][: start.size]
        moved = minimise(lambda at: _bases(x, y, at), start, bounds)[0]
        found.append(moved if _filled(x, moved.search) else on_grid)
    return min(found, key=lambda solution: solution.cost)


def _settled(x: Floats, y: Floats, solution: Solution) -> Solution:
    """Refine the line without derivatives, since the cost has kinks.

    The derivative with respect to a break point jumps where it passes a sample.
    """
    start = solution.search
    if start.size == 0:
        return solution

    def cost(breaks: Floats) -> float:
        fenced = np.concatenate([[x[0]], breaks, [x[-1]]])
        if not (np.diff(fenced) > 0.0).all() or not _filled(x, breaks):
            return math.inf
        shapes = _bases(x, y, breaks)[0].shared
        error = y - shapes @ np.linalg.lstsq(shapes, y, rcond=None)[0]
        return float(error @ error)

    step = float(np.ptp(x)) / _FINAL_STEPS
    options = {
        "initial_simplex": np.vstack([start, start + step * np.eye(start.size)]),
        "xatol": 1e-4 * step,
        "fatol": 1e-9 * solution.cost,
        "maxfev": 150 * start.size,
    }
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    return project(found.x, _bases(x, y, found.x)) if found.fun < solution.cost else solution


def _filled(x: Floats, breaks: Floats) -> bool:
    """Whether each segment has enough samples."""
    counts = np.histogram(x, bins=np.concatenate([[-np.inf], breaks, [np.inf]]))[0]
    return bool((counts >= _LEAST_SAMPLES).all())


def _bic(solution: Solution, segments: int, y: Floats, share: float) -> float:
    """Schwarz's criterion with the effective number of samples of coloured residuals."""
    floor = y.size * (_ROUNDING * float(np.ptp(y))) ** 2
    samples = share * y.size
    return samples * math.log((solution.cost + floor) / y.size) + 2 * segments * math.log(samples)


@dataclass(frozen=True)
class _Spread:
    """Quantities needed for the intervals of a broken line.

    Args:
        covariance: of break points and factors, for the effective number of samples.
        inflation: of the variance of each, relative to white noise.
        quantile: of Student's distribution for 95 %.
    """

    covariance: Floats
    inflation: Floats
    quantile: float

    @classmethod
    def of(cls, solution: Solution) -> _Spread:
        columns, residuals = solution.columns[0], solution.residuals[0]
        numbers = columns.shape[1]
        covariance, quantile = spread_of(solution.columns, solution.residuals, numbers)
        gram = columns.T @ columns
        white = np.diag(np.linalg.pinv(gram)) * solution.cost / max(residuals.size - numbers, 1)
        variance = np.maximum(np.diag(covariance), 0.0)
        inflation = np.where(white > 0.0, variance / np.where(white > 0.0, white, 1.0), 1.0)
        return cls(covariance, inflation, quantile)


def _break_estimates(x: Floats, y: Floats, solution: Solution, spread: _Spread) -> list[Estimate]:
    """Break points with profile-likelihood intervals."""
    std = np.sqrt(np.maximum(np.diag(spread.covariance), 0.0))
    found = []
    for k, place in enumerate(solution.search):
        freedom = max(y.size - solution.columns[0].shape[1], 1)
        allowed = solution.cost / freedom * spread.inflation[k] * spread.quantile**2
        low, high = (
            _profile_end(x, y, solution, k, way * spread.quantile * std[k], allowed)
            for way in (-1.0, 1.0)
        )
        wide = max(float(std[k]), (high - low) / (2.0 * spread.quantile))
        found.append(Estimate(float(place), wide, (float(low), float(high)), ""))
    return found


def _profile_end(
    x: Floats, y: Floats, solution: Solution, k: int, reach: float, allowed: float
) -> float:
    """Place of break point `k` where the cost exceeds the minimum by `allowed` (secant method)."""
    place = float(solution.search[k])
    if not math.isfinite(reach) or reach == 0.0 or not solution.cost > 0.0:
        return place + reach
    ends = float(x[0]), float(x[-1])
    others = solution.search
    step, inside = reach, 0.0
    for _ in range(_PROFILE_STEPS):
        at = place + step
        if not ends[0] < at < ends[1]:
            return ends[0] if step < 0.0 else ends[1]
        cost, others = _cost_with(x, y, others, k, at)
        # The square root of the excess is nearly linear in the step.
        share = math.sqrt(max(cost - solution.cost, 0.0) / allowed)
        if abs(share - 1.0) < _PROFILE_GAP:
            break
        if share < 1.0:
            inside = step
            step *= min(max(1.0 / max(share, 1e-3), 1.02), 2.0)
        else:
            step = max(abs(step / share), 0.5 * (abs(step) + abs(inside))) * math.copysign(
                1.0, step
            )
    return place + step


def _cost_with(x: Floats, y: Floats, breaks: Floats, k: int, at: float) -> tuple[float, Floats]:
    """Least cost with break point `k` held, the others free."""
    start = np.delete(breaks, k)
    left = int((start < at).sum())
    fences = np.concatenate([[x[0]], np.sort(np.append(start, at)), [x[-1]]])
    if start.size == 0:
        return project(np.array([at]), _bases(x, y, np.array([at]))).cost, np.array([at])

    def bases(search: Floats) -> list[Basis]:
        basis = _bases(x, y, np.insert(search, left, at))[0]
        moved = np.delete(basis.by_search, left, axis=0)
        still = np.zeros((search.size, x.size))
        return [Basis(y, basis.shared, basis.own, moved, basis.known, still)]

    low = np.array([fences[i] for i in range(fences.size - 2) if i != left])
    high = np.array([fences[i + 2] for i in range(fences.size - 2) if i != left])
    found = minimise(bases, start, (low, high), iterations=20, gain=1e-4)[0]
    return found.cost, np.insert(found.search, left, at)


def _describe(x: Floats, y: Floats, solution: Solution, bic: dict[int, float]) -> RegionsFit:
    """Regions with intervals."""
    breaks, factors = solution.search, solution.shared
    spread = _Spread.of(solution)
    covariance = spread.covariance
    ends = [
        Estimate.normal(x[0], 0.0, ""),
        *_break_estimates(x, y, solution, spread),
        Estimate.normal(x[-1], 0.0, ""),
    ]
    residuals = solution.residuals[0]
    regions = []
    for k in range(breaks.size + 1):
        # The slope of a segment is the sum of all changes up to it.
        part = slice(breaks.size + 1, breaks.size + 2 + k)
        slope = student_estimate(
            factors[1 : 2 + k].sum(), math.sqrt(max(covariance[part, part].sum(), 0.0)),
            spread.quantile, "N",
        )  # fmt: skip
        inside = (x >= ends[k].value) & (x <= ends[k + 1].value)
        quality = r_squared(y[inside], y[inside] - residuals[inside])
        regions.append(Region(ends[k], ends[k + 1], slope, quality))
    parameters = {f"break_{k}": end for k, end in enumerate(ends[1:-1], start=1)}
    parameters |= {f"slope_{k}_n": region.slope_n for k, region in enumerate(regions, start=1)}
    std = np.array([estimate.std for estimate in parameters.values()])
    to_slopes = np.zeros((std.size, covariance.shape[0]))
    to_slopes[: breaks.size, : breaks.size] = np.eye(breaks.size)
    to_slopes[breaks.size :, breaks.size + 1 :] = np.tri(breaks.size + 1)
    regions.sort(key=lambda region: region.low.value - region.high.value)
    return RegionsFit(
        status="ok",
        parameters=parameters,
        covariance=rescaled(propagated(to_slopes, covariance), std),
        residuals=(residuals,),
        notes=_notes(x, regions, bic),
        regions=tuple(regions),
        r_squared=r_squared(y, y - residuals),
        bic=bic,
        stretch=x,
        load_n=y,
    )


def _notes(x: Floats, regions: list[Region], bic: dict[int, float]) -> tuple[str, ...]:
    notes = []
    span = float(np.ptp(x))
    if any(not end.std < 0.1 * span for region in regions for end in (region.low, region.high)):
        notes.append("A break point is not identifiable from this record; fit fewer segments.")
    if len(bic) > 1 and len(regions) == max(bic):
        notes.append("BIC prefers the most segments tried: the curve bends everywhere.")
    return tuple(notes)
