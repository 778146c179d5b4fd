"""Strain from capacitance in farads, with its band due to hysteresis, and a drift check.

`identify.fit_capacitance_map` fits eq. 5 of the study, in relative units, with intervals of its two
parameters. Here a capacitance is converted to a strain, with the uncertainty of that strain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from haselab.base import Estimate, InputError, ResultError, checked
from haselab.models.actuator.strain_map import StrainMap
from haselab.sensing.map_range import fitted_range

__all__ = ["DriftCheck", "MapKind", "drift_check", "fit_strain_map"]

Floats = NDArray[np.float64]
MapKind = Literal["auto", "line", "quadratic", "cubic"]

_FEWEST = 32
_CELLS = 24  # of equal capacitance; each counts once per branch, however long it took
_TURN = 0.15  # of the range: smaller reversals do not start a new branch
_FOLLOWED = 1.0 / 3.0  # of the change of the strain, that the map must cover
_LEFT = 0.5  # of the variance of the strain, that a line may leave
_FOLDS = 10  # groups of cycles, each left out once
_SEGMENTS = 16  # of a record that is checked for drift
_HOUR_S = 3600.0
_LARGEST_F = 1e-3  # above the capacitance of any actuator
_LARGEST_STRAIN = 5.0  # above the actuation strain of any elastomer
_SMALLEST_STRAIN = 1e-7  # span that no camera resolves


@dataclass(frozen=True)
class DriftCheck:
    """Whether the map is still valid.

    Args:
        slope_per_hour: change of (camera's strain minus the map's) per hour.
        offset: mean of that difference over the record.
        verdict: "no drift seen", "drifts", or "too short to tell".
    """

    slope_per_hour: Estimate
    offset: Estimate
    verdict: str


@checked
def fit_strain_map(
    capacitance_f: ArrayLike, strain: ArrayLike, kind: MapKind = "auto", *, coverage: float = 0.95
) -> StrainMap:
    r"""Fit strain as a polynomial of the capacitance, with equal weight for both branches.

    Cells of equal capacitance count once for each branch, so that neither the time spent at a
    strain nor the hysteresis shifts the map. The band is taken from deviations of cycles that were
    left out of the fit one at a time, so that it is valid for future cycles. The
    covariance is from the jackknife, so it includes differences between cycles.

    Args:
        capacitance_f: in order of time, in F. Shape `(N,)`.
        strain: of the camera at the same times. Shape `(N,)`.
        kind: "line", the study's form; "quadratic"; "cubic"; "auto" is the highest degree for
            which the map rises, or falls, over its whole range. It falls for an actuator that
            contracts. If none of them follows the strain over the whole record, "auto" limits the
            map to the part that it follows, see `fitted_range`.
        coverage: share of the strains that the band should contain.
    Returns:
        The map with its band and the range of the record. With one cycle it has no covariance.
    Raises:
        InputError: fewer than 32 samples, unequal lengths, NaN, a constant capacitance, values
            that cannot be F or strain, an unknown kind, a coverage outside (0, 1).
        ResultError: the map turns within the record, follows only a small part of it, or explains
            less than half of the variance of the strain.
    Source: reference study, row S15, for the line; Efron, The Jackknife (1982), for the covariance.
    Example:
        >>> phase = 2 * np.pi * np.arange(4000) / 1000
        >>> strain = 0.05 - 0.05 * np.cos(phase)
        >>> c = 1e-9 * (1 + strain) ** 3.3 * (1 + 2e-3 * np.sin(phase))  # a loop
        >>> line, curve = fit_strain_map(c, strain, "line"), fit_strain_map(c, strain)
        >>> line.residual_std > 1.5 * curve.residual_std, curve.hysteresis_strain < 2e-3
        (True, True)
    """
    c, e = _checked(capacitance_f, strain, coverage)
    limits_f = _limits_f(c, e) if kind == "auto" else None
    if limits_f is not None:
        inside = (c >= limits_f[0]) & (c <= limits_f[1])
        c, e = c[inside], e[inside]
    ends_f = (float(c.min()), float(c.max()))
    turns = _turns(c)
    record = _Record(c, e, _branches(c.size, turns), ends_f)
    degree, factors = _chosen(record, kind)
    deviation = e - record.values(factors)
    fold = _folds(c.size, turns)
    left_out = [_left_out(record, fold == k, degree) for k in range(int(fold.max()) + 1)]
    parts = [(part, other) for part, other in left_out if part.size]
    band, held = _band([part for part, _ in parts], coverage)
    if math.isnan(held):  # with one cycle there is none to leave out
        band = _tails(deviation, coverage)
    return StrainMap(
        *_in_farads(factors, ends_f),
        covariance=_jackknife([_in_farads(other, ends_f) for _, other in parts]),
        range_f=ends_f,
        limits_f=limits_f,
        band=band,
        coverage=coverage,
        held_out_coverage=held,
        hysteresis_strain=_loop_height(c, deviation, record.branch),
        residual_std=float(np.sqrt(np.mean(deviation**2))),
    )


@checked
def drift_check(
    fitted: StrainMap, capacitance_f: ArrayLike, strain: ArrayLike, time_s: ArrayLike
) -> DriftCheck:
    """Check whether the camera's strain drifts away from the map's.

    The record is cut into 16 segments, whose means are assumed to be independent; each should
    contain whole cycles of the drive.

    Args:
        fitted: the map.
        capacitance_f: in order of time. Shape `(N,)`.
        strain: of the camera at the same times. Shape `(N,)`.
        time_s: rising times, in s. Shape `(N,)`.
    Returns:
        Slope and offset with intervals, and a verdict: "drifts" if the interval of the slope
        excludes zero; "too short to tell" if that interval would allow the map to leave its
        own band within the record.
    Raises:
        InputError: fewer than 32 samples, unequal lengths, NaN, times that do not rise, a map
            without a band.
        LimitError: a capacitance outside the map.
    Example:
        >>> c = np.linspace(1e-9, 1.2e-9, 50)
        >>> fitted = fit_strain_map(np.r_[c, c[::-1]], np.r_[c, c[::-1]] * 1e9 - 1)
        >>> hours = np.arange(3200) / 3600.0
        >>> wave = 1.1e-9 + 0.05e-9 * np.sin(np.arange(3200) * 2 * np.pi / 20)
        >>> drift = drift_check(fitted, wave, wave * 1e9 - 1 + 0.01 * hours, 3600 * hours)
        >>> f"{drift.slope_per_hour.value:.4f}", drift.verdict
        ('0.0100', 'drifts')
    """
    time = np.asarray(time_s, dtype=np.float64)
    c, e = _columns(capacitance_f, strain)
    if time.shape != c.shape or not np.all(np.diff(time) > 0.0):
        raise InputError(
            f"time_s of shape {time.shape} for {c.size} samples; there must be as many rising "
            "times. Give the time of each sample."
        )
    segments = np.array_split(np.arange(c.size), _SEGMENTS)
    fitted.interval(c)  # refuses a capacitance outside the map
    deviation = e - fitted.strain(c)
    means = np.array([deviation[segment].mean() for segment in segments])
    hours = np.array([time[segment].mean() for segment in segments]) / _HOUR_S
    about = hours - hours.mean()
    slope = float(about @ means / (about @ about))
    left = means - means.mean() - slope * about
    variance = float(left @ left) / (_SEGMENTS - 2)
    slope_std = math.sqrt(variance / float(about @ about))
    change = _interval(slope, slope_std, "1/h")
    over_hours = float(time[-1] - time[0]) / _HOUR_S
    if fitted.band is None:
        raise InputError("The strain map has no band to compare with. Fit it to several cycles.")
    reach = 0.5 * (change.ci95[1] - change.ci95[0]) * over_hours
    if not change.ci95[0] <= 0.0 <= change.ci95[1]:
        verdict = "drifts"
    elif reach > fitted.band[1] - fitted.band[0]:
        verdict = "too short to tell"
    else:
        verdict = "no drift seen"
    offset = _interval(float(means.mean()), math.sqrt(variance / _SEGMENTS), "")
    return DriftCheck(change, offset, verdict)


def _interval(value: float, std: float, unit: str) -> Estimate:
    half = float(stdtrit(_SEGMENTS - 2, 0.975)) * std
    return Estimate(value, std, (value - half, value + half), unit)


def _columns(capacitance_f: ArrayLike, strain: ArrayLike) -> tuple[Floats, Floats]:
    c = np.asarray(capacitance_f, dtype=np.float64)
    e = np.asarray(strain, dtype=np.float64)
    if c.ndim != 1 or c.shape != e.shape or c.size < _FEWEST:
        raise InputError(
            f"capacitance_f of shape {c.shape} and strain of shape {e.shape}; they must be two "
            f"columns of the same length, with {_FEWEST} samples or more."
        )
    if not (np.isfinite(c).all() and np.isfinite(e).all()):
        raise InputError(
            "capacitance_f or strain contains NaN or infinity. Remove samples that are not "
            "valid from both."
        )
    return c, e


def _check_plausible(c: Floats, e: Floats) -> None:
    """Refuse capacitances that are not in F, strains in per cent, and swapped columns."""
    fits = e.min() > 0.0 and e.max() <= _LARGEST_F
    swapped = " The strain looks like a capacitance in F. Are the two columns swapped?"
    if not (c.min() > 0.0 and c.max() <= _LARGEST_F):
        raise InputError(
            f"capacitance_f lies in [{c.min():.3g}, {c.max():.3g}] F; it must be above 0 and at "
            f"most {_LARGEST_F:g} F.{swapped if fits else ' Give it in F: 500 pF are 500e-12.'}"
        )
    if not (np.abs(e).max() <= _LARGEST_STRAIN and np.ptp(e) >= _SMALLEST_STRAIN):
        raise InputError(
            f"strain lies in [{e.min():.3g}, {e.max():.3g}]; it must change by "
            f"{_SMALLEST_STRAIN:g} or more and be at most {_LARGEST_STRAIN:g} (1 is twice the "
            f"length).{swapped if fits else ' If it is in per cent, divide it by 100.'}"
        )


def _checked(capacitance_f: ArrayLike, strain: ArrayLike, coverage: float) -> tuple[Floats, Floats]:
    c, e = _columns(capacitance_f, strain)
    if np.ptp(c) == 0.0:
        raise InputError(
            f"capacitance_f is {c[0]:g} F throughout; it must change. Record "
            "while the actuator moves."
        )
    _check_plausible(c, e)
    if not 0.0 < coverage < 1.0:
        raise InputError(f"coverage = {coverage:g} is outside (0, 1). Use for example 0.95.")
    return c, e


def _turns(c: Floats) -> list[tuple[int, int]]:
    """Samples where the capacitance reverses, and the direction after it: 1 up, -1 down."""
    least = _TURN * float(np.ptp(c))
    low = high = way = 0
    found: list[tuple[int, int]] = []
    for k, value in enumerate(c.tolist()):
        low = k if value < c[low] else low
        high = k if value > c[high] else high
        if way >= 0 and c[high] - value >= least:
            found.append((high, -1))
            low, way = k, -1
        elif way <= 0 and value - c[low] >= least:
            found.append((low, 1))
            high, way = k, 1
    return found


def _branches(size: int, turns: list[tuple[int, int]]) -> NDArray[np.intp]:
    """1 where the capacitance rises, -1 where it falls. Shape `(N,)`."""
    branch = np.full(size, -turns[0][1])
    for start, way in turns:
        branch[start:] = way
    return branch


def _folds(size: int, turns: list[tuple[int, int]]) -> NDArray[np.intp]:
    """Cycles between equal reversals, distributed over at most `_FOLDS` groups."""
    starts = [start for start, way in turns if way == turns[0][1]]
    cycle = np.searchsorted(np.asarray(starts[1:]), np.arange(size), side="right")
    return np.asarray(cycle % _FOLDS, dtype=np.intp)


def _weights(c: Floats, branch: NDArray[np.intp]) -> Floats:
    """Each cell of equal capacitance counts once on each branch. Shape `(N,)`."""
    cell = np.minimum((_CELLS * (c - c.min()) / np.ptp(c)).astype(np.intp), _CELLS - 1)
    group = 2 * cell + (branch > 0)
    count = np.bincount(group, minlength=2 * _CELLS)
    return np.asarray(1.0 / count[group])


@dataclass(frozen=True)
class _Record:
    """Samples with their branches; the abscissa of polynomials is scaled to -1 to 1.

    Args:
        c: capacitances, in F. Shape `(N,)`.
        e: strains. Shape `(N,)`.
        branch: 1 where the capacitance rises, -1 where it falls. Shape `(N,)`.
        ends_f: range of the whole record, in F.
    """

    c: Floats
    e: Floats
    branch: NDArray[np.intp]
    ends_f: tuple[float, float]

    def part(self, rows: NDArray[np.bool_]) -> _Record:
        """The selected samples, over the same range."""
        return _Record(self.c[rows], self.e[rows], self.branch[rows], self.ends_f)

    @property
    def x(self) -> Floats:
        low_f, high_f = self.ends_f
        return np.asarray((2.0 * self.c - low_f - high_f) / (high_f - low_f))

    def values(self, factors: Floats) -> Floats:
        """Strain from a polynomial of rising powers. Shape `(N,)`."""
        return np.asarray(np.polynomial.polynomial.polyval(self.x, factors))


def _chosen(record: _Record, kind: MapKind) -> tuple[int, Floats]:
    """Degree and factors of the map.

    Raises:
        ResultError: no polynomial of this kind rises, or falls, over the whole record, or the
            strain does not depend on the capacitance.
    """
    straight = _fit(record, 1)
    left, direction = _left(record, straight), float(np.sign(straight[1]))
    if left > _LEFT:
        raise ResultError(
            f"The strain does not follow the capacitance: a straight line leaves {100.0 * left:.3g}"
            f" % of its variance, but at most {100.0 * _LEFT:g} % may be left. Check the columns "
            "and their times."
        )
    for degree in {"auto": (3, 2, 1), "cubic": (3,), "quadratic": (2,), "line": (1,)}[kind]:
        factors = _fit(record, degree)
        if _rises(direction * factors):
            return degree, factors
    low, high = np.polynomial.polynomial.polyval(np.array([-1.0, 1.0]), factors)
    ends_f = record.ends_f
    raise ResultError(
        f"The strain does not {'rise' if direction > 0.0 else 'fall'} with the capacitance "
        f"everywhere: {low:.3g} at {ends_f[0]:.3g} F and {high:.3g} at {ends_f[1]:.3g} F, with a "
        "turn in between. Fit a lower degree."
    )


def _limits_f(c: Floats, e: Floats) -> tuple[float, float] | None:
    """Capacitances that limit the map, because no curve follows the strain beyond them.

    Raises:
        ResultError: the curve follows less than a third of the change of the strain.
    """
    ends_f, width_f = (float(c.min()), float(c.max())), float(np.ptp(c))
    branch = _branches(c.size, _turns(c))
    found = fitted_range(c, e, branch, _monotonic)
    inside = np.zeros(c.size, np.bool_) if found is None else (c >= found[0]) & (c <= found[1])
    if found is None or inside.sum() < _FEWEST or np.ptp(e[inside]) < _FOLLOWED * np.ptp(e):
        whole = _Record(c, e, branch, ends_f)
        if _left(whole, _fit(whole, 1)) > _LEFT:
            return None  # which is refused for this reason
        raise ResultError(
            "No line, parabola or cubic follows the strain over a third of its change: it hardly "
            "changes with the capacitance, or turns. Record a range in which the length follows "
            "the capacitance; a slack actuator needs a larger load or a higher lowest voltage."
        )
    low_f, high_f = found
    cut_low, cut_high = low_f > ends_f[0] + 1e-9 * width_f, high_f < ends_f[1] - 1e-9 * width_f
    if not (cut_low or cut_high):
        return None
    beyond_f = high_f - low_f  # on a side without a limit, as in StrainMap.usable_f
    return low_f if cut_low else low_f - beyond_f, high_f if cut_high else high_f + beyond_f


def _monotonic(c: Floats, e: Floats) -> Floats | None:
    """The polynomial of the highest degree that rises or falls everywhere, at its points."""
    x = (2.0 * c - c[0] - c[-1]) / (c[-1] - c[0])
    for degree in (3, 2, 1):
        factors = np.polynomial.polynomial.polyfit(x, e, degree)
        padded = np.concatenate([factors, np.zeros(3 - degree)])
        if _rises(float(np.sign(e[-1] - e[0])) * padded):
            return np.asarray(np.polynomial.polynomial.polyval(x, factors))
    return None


def _fit(record: _Record, degree: int) -> Floats:
    """Factors of rising powers of `x`. Shape `(4,)`, zero beyond the degree."""
    root = np.sqrt(_weights(record.c, record.branch))
    columns = np.stack([record.x**power for power in range(degree + 1)], axis=1)
    factors = np.linalg.lstsq(root[:, None] * columns, root * record.e, rcond=None)[0]
    return np.concatenate([factors, np.zeros(3 - degree)])


def _left(record: _Record, factors: Floats) -> float:
    """Share of the strain's variance that a fit leaves, with the weights of the fit."""
    weights = _weights(record.c, record.branch)
    about = record.e - float(np.average(record.e, weights=weights))
    residuals = record.e - record.values(factors)
    return float(weights @ residuals**2 / (weights @ about**2))


def _rises(factors: Floats) -> bool:
    """Whether a polynomial of degree 3 rises from -1 to 1."""
    _, slope, curvature, cubic = factors.tolist()
    least = slope + 3.0 * cubic - 2.0 * abs(curvature)  # lower bound of the slope at the ends
    if cubic > 0.0 and abs(curvature) < 3.0 * cubic:  # its minimum lies between
        least = slope - curvature**2 / (3.0 * cubic)
    return bool(least > 0.0)


def _in_farads(factors: Floats, ends_f: tuple[float, float]) -> tuple[float, float, float, float]:
    """Slope (1/F), offset, curvature (1/F^2) and cubic factor (1/F^3) of a polynomial of `x`."""
    half_f, middle_f = 0.5 * (ends_f[1] - ends_f[0]), 0.5 * (ends_f[0] + ends_f[1])
    cubic = factors[3] / half_f**3
    curvature = factors[2] / half_f**2 - 3.0 * cubic * middle_f
    slope = factors[1] / half_f - (2.0 * curvature + 3.0 * cubic * middle_f) * middle_f
    offset = factors[0] - ((cubic * middle_f + curvature) * middle_f + slope) * middle_f
    return float(slope), float(offset), float(curvature), float(cubic)


def _jackknife(
    others: list[tuple[float, float, float, float]],
) -> tuple[tuple[float, ...], ...] | None:
    """Covariance of the map's factors from fits with one group of cycles left out."""
    count = len(others)
    if count < 2:
        return None
    about = np.array(others) - np.mean(others, axis=0)
    matrix = (count - 1) / count * about.T @ about
    return tuple(tuple(float(value) for value in row) for row in matrix)


def _left_out(record: _Record, out: NDArray[np.bool_], degree: int) -> tuple[Floats, Floats]:
    """Deviations of the left-out samples, and the factors of the fit to the others."""
    rest = record.part(~out)
    if not rest.c.size or np.ptp(rest.c) == 0.0:
        return np.zeros(0), np.zeros(4)
    factors = _fit(rest, degree)
    missing = record.part(out)
    return missing.e - missing.values(factors), factors


def _band(parts: list[Floats], coverage: float) -> tuple[tuple[float, float], float]:
    """Band of the deviations of left-out cycles, and the share inside the bands of the others.

    A few cycles do not show the full variation, so the band is widened by the amount that the bands
    of the others would have required to contain their share of each left-out cycle.
    """
    if len(parts) < 2:
        return (math.nan, math.nan), math.nan
    needed = []
    for k, part in enumerate(parts):
        low, high = _tails(np.concatenate(parts[:k] + parts[k + 1 :]), coverage)
        half = max(0.5 * (high - low), 1e-15)
        needed.append(np.abs(part - 0.5 * (low + high)) / half)
    factors = np.concatenate(needed)
    low, high = _tails(np.concatenate(parts), coverage)
    wider = 0.5 * (high - low) * (max(1.0, float(np.quantile(factors, coverage))) - 1.0)
    return (low - wider, high + wider), float(np.mean(factors <= 1.0))


def _tails(deviation: Floats, coverage: float) -> tuple[float, float]:
    low, high = np.quantile(deviation, [0.5 * (1.0 - coverage), 0.5 * (1.0 + coverage)])
    return float(low), float(high)


def _loop_height(c: Floats, deviation: Floats, branch: NDArray[np.intp]) -> float:
    """Largest distance between the branches' means, over cells of equal capacitance."""
    cell = np.minimum((_CELLS * (c - c.min()) / np.ptp(c)).astype(np.intp), _CELLS - 1)
    means = []
    for way in (1, -1):
        here = branch == way
        count = np.bincount(cell[here], minlength=_CELLS)
        total = np.bincount(cell[here], weights=deviation[here], minlength=_CELLS)
        means.append(np.divide(total, count, out=np.full(_CELLS, np.nan), where=count > 0))
    apart = np.abs(means[0] - means[1])
    return float(np.nanmax(apart)) if np.isfinite(apart).any() else 0.0
