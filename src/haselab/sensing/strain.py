"""Strain from capacitance in farads, with the band that hysteresis opens, and a watch on drift.

`identify.fit_capacitance_map` fits eq. 5 of the study, in relative units, with intervals of its two
numbers. Here a reading is to become a strain: the question is how far off that strain may be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.special import stdtrit

from haselab.base import Estimate, InputError, LimitError, ResultError

__all__ = ["DriftCheck", "FittedStrainMap", "MapKind", "drift_check", "fit_strain_map"]

Floats = NDArray[np.float64]
MapKind = Literal["line", "monotone"]

_FEWEST = 32
_CELLS = 24  # of equal capacitance: each counts once a branch, however long was spent there
_KNOTS = 13  # of the monotone map: its chords miss a parabola by 1/576 of its height
_TURN = 0.15  # of the range: smaller reversals are noise, not a new branch
_FOLDS = 10  # hands that the cycles are dealt to, each left out once
_STIFFNESS = 1e-6  # of the knots against bending: nothing beside samples, all where there are none
_SEGMENTS = 16  # of a record whose drift is judged
_HOUR_S = 3600.0


@dataclass(frozen=True)
class FittedStrainMap:
    """Strain as a rising function of capacitance, with the band of what was seen about it.

    Args:
        kind: line, or monotone (shape-preserving cubic through `knots_f`, `knots_strain`).
        knots_f: capacitances, rising; their ends are the range of the record. Shape `(K,)`.
        knots_strain: strain there. Shape `(K,)`.
        band: lowest and highest deviation of the strain from the map, `coverage` of them between.
        coverage: share of the deviations that the band is to hold.
        held_out_coverage: share that was held in cycles left out of fit and band, before the band
            was widened to make up for what is missing; NaN with one cycle.
        hysteresis_strain: largest distance of the rising from the falling branch, strain.
        residual_std: rms of the deviations, strain.
    """

    kind: MapKind
    knots_f: Floats
    knots_strain: Floats
    band: tuple[float, float]
    coverage: float
    held_out_coverage: float
    hysteresis_strain: float
    residual_std: float

    def inside(self, capacitance_f: ArrayLike) -> NDArray[np.bool_]:
        """Whether the map reaches there; the shape of `capacitance_f`."""
        c = np.asarray(capacitance_f, dtype=np.float64)
        return np.asarray((c >= self.knots_f[0]) & (c <= self.knots_f[-1]))

    def strain(self, capacitance_f: ArrayLike) -> Floats:
        """Strain of each capacitance; NaN stays NaN.

        Args:
            capacitance_f: any shape.
        Returns:
            Strain, the same shape.
        Raises:
            LimitError: a capacitance outside the record that was fitted.
        """
        c = np.asarray(capacitance_f, dtype=np.float64)
        outside = ~self.inside(c) & ~np.isnan(c)
        if outside.any():
            raise LimitError(
                f"Capacitance = {c[outside].flat[0]:.6g} F is outside [{self.knots_f[0]:.6g}, "
                f"{self.knots_f[-1]:.6g}] F that was fitted. Fit a record that reaches there."
            )
        return _values(self.kind, self.knots_f, self.knots_strain, c)

    def interval(self, capacitance_f: ArrayLike) -> tuple[Floats, Floats]:
        """Ends of the strain's interval: the map and its band.

        Args:
            capacitance_f: any shape.
        Returns:
            Lower and upper strain, the same shape each.
        Raises:
            LimitError: a capacitance outside the record that was fitted.
        """
        middle = self.strain(capacitance_f)
        return middle + self.band[0], middle + self.band[1]

    def slope_per_f(self, capacitance_f: float) -> float:
        """d strain / d C there, in 1/F, by a difference over 1 % of the range."""
        low, high = float(self.knots_f[0]), float(self.knots_f[-1])
        step = 0.005 * (high - low)
        middle = min(max(capacitance_f, low + step), high - step)
        below, above = self.strain(np.array([middle - step, middle + step]))
        return float((above - below) / (2.0 * step))


@dataclass(frozen=True)
class DriftCheck:
    """Whether the map still holds.

    Args:
        slope_per_hour: change of (camera's strain minus the map's) in an hour.
        offset: their mean distance over the record.
        verdict: "no drift seen", "drifts", or "too short to tell".
    """

    slope_per_hour: Estimate
    offset: Estimate
    verdict: str


def fit_strain_map(
    capacitance_f: ArrayLike, strain: ArrayLike, kind: MapKind = "line", *, coverage: float = 0.95
) -> FittedStrainMap:
    r"""Strain as a function of capacitance, rising and falling branches alike.

    Cells of equal capacitance count once for each branch, so that neither the time spent at a
    strain nor the hysteresis shifts the map. The band is taken from deviations of cycles that were
    left out of the fit, one after the other, so that it holds for a cycle to come.

    Args:
        capacitance_f: in order of time. Shape `(N,)`.
        strain: of the camera at the same times. Shape `(N,)`.
        kind: "line", the study's form, or "monotone", any rising curve.
        coverage: share of the strains that the band is to hold.
    Returns:
        The map with its band.
    Raises:
        InputError: fewer than 32 samples, unequal lengths, NaN, a capacitance that does not change,
            an unknown kind, a coverage outside (0, 1).
        ResultError: the strain does not rise with the capacitance.
    Source: reference study, row S15, for the line; Fritsch and Butland 1984 for the cubic.
    Example:
        >>> phase = 2 * np.pi * np.arange(4000) / 1000
        >>> strain = 0.05 - 0.05 * np.cos(phase)
        >>> c = 1e-9 * (1 + strain) ** 3.3 * (1 + 2e-3 * np.sin(phase))  # a loop
        >>> line, curve = fit_strain_map(c, strain), fit_strain_map(c, strain, "monotone")
        >>> line.residual_std > 1.5 * curve.residual_std, curve.hysteresis_strain < 2e-3
        (True, True)
    """
    c, e = _checked(capacitance_f, strain, coverage)
    if kind not in get_args(MapKind):
        raise InputError(f"kind = {kind!r}; allowed are line and monotone. Name one of them.")
    turns = _turns(c)
    branch = _branches(c.size, turns)
    knots_f, knots_strain = _fit(c, e, branch, kind, (float(c.min()), float(c.max())))
    deviation = e - _values(kind, knots_f, knots_strain, c)
    band, held = _band(c, e, branch, _folds(c.size, turns), kind, coverage)
    if math.isnan(held):  # one cycle: there is none to leave out
        band = _tails(deviation, coverage)
    return FittedStrainMap(
        kind=kind,
        knots_f=knots_f,
        knots_strain=knots_strain,
        band=band,
        coverage=coverage,
        held_out_coverage=held,
        hysteresis_strain=_loop_height(c, deviation, branch),
        residual_std=float(np.sqrt(np.mean(deviation**2))),
    )


def drift_check(
    fitted: FittedStrainMap, capacitance_f: ArrayLike, strain: ArrayLike, time_s: ArrayLike
) -> DriftCheck:
    """Whether the camera's strain moves away from the map's as time goes on.

    The record is cut into 16 segments, whose means are taken as independent: let each hold whole
    cycles of the drive.

    Args:
        fitted: the map.
        capacitance_f: in order of time. Shape `(N,)`.
        strain: of the camera at the same times. Shape `(N,)`.
        time_s: rising. Shape `(N,)`.
    Returns:
        Slope and offset with intervals, and a verdict: it drifts where the interval of the slope
        leaves zero out; the record is too short where that interval would let the map leave its
        own band within the record.
    Raises:
        InputError: fewer than 32 samples, unequal lengths, NaN, times that do not rise.
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
            f"time_s of shape {time.shape} for {c.size} samples; allowed are as many, rising. "
            "Give the time of each sample."
        )
    pieces = np.array_split(np.arange(c.size), _SEGMENTS)
    deviation = e - fitted.strain(c)
    means = np.array([deviation[piece].mean() for piece in pieces])
    hours = np.array([time[piece].mean() for piece in pieces]) / _HOUR_S
    about = hours - hours.mean()
    slope = float(about @ means / (about @ about))
    left = means - means.mean() - slope * about
    variance = float(left @ left) / (_SEGMENTS - 2)
    slope_std = math.sqrt(variance / float(about @ about))
    change = _interval(slope, slope_std, "1/h")
    over_hours = float(time[-1] - time[0]) / _HOUR_S
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
            f"capacitance_f of shape {c.shape} and strain of shape {e.shape}; allowed are two "
            f"columns of the same length, {_FEWEST} or more. Record for longer."
        )
    if not (np.isfinite(c).all() and np.isfinite(e).all()):
        raise InputError(
            "capacitance_f or strain holds NaN or infinity. Leave out the samples that are not "
            "valid, in both."
        )
    return c, e


def _checked(capacitance_f: ArrayLike, strain: ArrayLike, coverage: float) -> tuple[Floats, Floats]:
    c, e = _columns(capacitance_f, strain)
    if np.ptp(c) == 0.0:
        raise InputError(
            f"capacitance_f is {c[0]:g} F throughout; allowed is a column that changes. Record "
            "while the actuator moves."
        )
    if not 0.0 < coverage < 1.0:
        raise InputError(f"coverage = {coverage:g} is outside (0, 1). Take 0.95.")
    return c, e


def _turns(c: Floats) -> list[tuple[int, int]]:
    """Samples where the capacitance turns, and the way it takes from there, 1 up or -1 down."""
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
    """Cycles, from one way of turning to the next of the same, dealt to at most `_FOLDS` hands."""
    starts = [start for start, way in turns if way == turns[0][1]]
    cycle = np.searchsorted(np.asarray(starts[1:]), np.arange(size), side="right")
    return np.asarray(cycle % _FOLDS, dtype=np.intp)


def _weights(c: Floats, branch: NDArray[np.intp]) -> Floats:
    """Each cell of equal capacitance counts once on each branch. Shape `(N,)`."""
    cell = np.minimum((_CELLS * (c - c.min()) / np.ptp(c)).astype(np.intp), _CELLS - 1)
    group = 2 * cell + (branch > 0)
    count = np.bincount(group, minlength=2 * _CELLS)
    return np.asarray(1.0 / count[group])


def _fit(
    c: Floats, e: Floats, branch: NDArray[np.intp], kind: MapKind, ends_f: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Knots of the map: least squares on chords, for the monotone map without any descent."""
    count = 2 if kind == "line" else _KNOTS
    knots_f = np.linspace(*ends_f, count)
    place = np.clip((c - ends_f[0]) / (ends_f[1] - ends_f[0]) * (count - 1), 0.0, count - 1.0)
    left = np.minimum(place.astype(np.intp), count - 2)
    rows = np.arange(c.size)
    chords = np.zeros((c.size, count))
    chords[rows, left], chords[rows, left + 1] = 1.0 + left - place, place - left
    root = np.sqrt(_weights(c, branch))
    bend = _STIFFNESS * np.diff(np.eye(count), n=2, axis=0)  # carries on where no sample lies
    values = np.linalg.lstsq(
        np.vstack([root[:, np.newaxis] * chords, bend]),
        np.concatenate([root * e, np.zeros(len(bend))]),
        rcond=None,
    )[0]
    share = (root[:, np.newaxis] ** 2 * chords).sum(axis=0)
    values = _without_descent(values, np.maximum(share, 1e-3))
    if not values[-1] > values[0]:
        raise ResultError(
            f"The strain does not rise with the capacitance: {values[0]:.3g} at {ends_f[0]:.3g} F "
            f"and {values[-1]:.3g} at {ends_f[1]:.3g} F. Check the columns and their times."
        )
    return knots_f, values


def _without_descent(values: Floats, weight: Floats) -> Floats:
    """The nearest sequence that nowhere falls: neighbours that do are pooled."""
    pools: list[list[float]] = []  # mean, weight, how many
    for value, w in zip(values.tolist(), weight.tolist(), strict=True):
        pools.append([value, w, 1])
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            mean, heavy, many = pools.pop()
            last = pools[-1]
            last[0] = (last[0] * last[1] + mean * heavy) / (last[1] + heavy)
            last[1] += heavy
            last[2] += many
    return np.repeat([pool[0] for pool in pools], [int(pool[2]) for pool in pools])


def _values(kind: MapKind, knots_f: Floats, knots_strain: Floats, c: Floats) -> Floats:
    if kind == "line":
        return np.asarray(np.interp(c, knots_f, knots_strain))
    return np.asarray(PchipInterpolator(knots_f, knots_strain)(c))


def _band(
    c: Floats,
    e: Floats,
    branch: NDArray[np.intp],
    fold: NDArray[np.intp],
    kind: MapKind,
    coverage: float,
) -> tuple[tuple[float, float], float]:
    """Band of the deviations of left-out cycles, and the share that the others' bands held.

    A few cycles do not show all that cycles can be: the band is widened by what the bands of the
    others would have needed to hold their share of each cycle left out.
    """
    ends_f = (float(c.min()), float(c.max()))
    parts = []
    for k in range(int(fold.max()) + 1):
        rest = fold != k
        if not rest.any() or np.ptp(c[rest]) == 0.0:
            continue
        knots = _fit(c[rest], e[rest], branch[rest], kind, ends_f)
        parts.append(e[~rest] - _values(kind, *knots, c[~rest]))
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
    """Largest distance of the branches' means over cells of equal capacitance."""
    cell = np.minimum((_CELLS * (c - c.min()) / np.ptp(c)).astype(np.intp), _CELLS - 1)
    means = []
    for way in (1, -1):
        here = branch == way
        count = np.bincount(cell[here], minlength=_CELLS)
        total = np.bincount(cell[here], weights=deviation[here], minlength=_CELLS)
        means.append(np.divide(total, count, out=np.full(_CELLS, np.nan), where=count > 0))
    apart = np.abs(means[0] - means[1])
    return float(np.nanmax(apart)) if np.isfinite(apart).any() else 0.0
