"""Offset of the current monitor and leakage, from charges that must return to zero."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.charge.path import Anchors, Path

__all__ = ["Offset", "fit_offset"]

Floats = NDArray[np.float64]

_FEWEST = 4  # fewest intervals to separate leakage from offset
_WITH_DRIFT = 6
_ROBUST = 8  # intervals needed to distinguish an outlier from noise
_NORMAL = 0.6745  # median of |x| over the standard deviation of a normal distribution
_OUTLIER = 6.0
_ROUNDS = 3
_WANDERS = 2.0  # misfit above which the offset is not linear in time


@dataclass(frozen=True)
class Offset:
    """Offset and leakage: the part of the current that does not charge the capacitance.

    Args:
        level: offset at the middle of the record, in the unit of the readings.
        slope: of the offset, per s.
        middle_s: time of `level`, counted over all runs.
        level_var: its variance for a known leakage; infinite where it is not known.
        leakage: current over voltage, both as readings.
        leakage_std: its standard deviation.
        mean_voltage: voltage at which offset and leakage are uncorrelated.
        inflation: closing errors relative to the noise, at least 1.
        by_loss: whether the leakage is estimated from the energy loss, which may be hysteresis.
        broken: for each path, the intervals whose charge does not return to zero, `(anchors + 1,)`.
    """

    level: float
    slope: float
    middle_s: float
    level_var: float
    leakage: float
    leakage_std: float
    mean_voltage: float
    inflation: float
    by_loss: bool
    broken: tuple[NDArray[np.bool_], ...]

    @property
    def wanders(self) -> bool:
        """Whether the closing errors are much larger than the noise."""
        return self.inflation > _WANDERS


@dataclass(frozen=True)
class _Closings:
    """Intervals between anchors; arrays of shape `(intervals,)`.

    `loss` is the energy supplied by the current, `square` the integral of the squared voltage,
    `moments` the sums of the charge's variance times 1, v and v^2, shape `(intervals, 3)`.
    """

    charge: Floats
    time: Floats
    area: Floats
    middle: Floats
    variance: Floats
    loss: Floats
    square: Floats
    moments: Floats

    def only(self, kept: NDArray[np.bool_]) -> _Closings:
        """The selected intervals."""
        return _Closings(*(getattr(self, part.name)[kept] for part in fields(self)))


def fit_offset(paths: list[tuple[Path, Anchors]]) -> Offset:
    r"""Estimate offset and leakage of a record.

    Between two anchors $\Delta q = i_0 \Delta t + G \int v\,dt$. If the mean voltages of the
    intervals differ, both follow by least squares. Otherwise the energy loss per cycle gives G,
    which includes the loss of a hysteresis: half of it is used, with an equal standard deviation.

    Args:
        paths: each run of blocks with its anchors.
    """
    whole = _closings(paths)
    far = np.zeros(whole.time.size, dtype=np.bool_)
    if not far.size:
        none = tuple(np.zeros(anchors.at.size + 1, dtype=np.bool_) for _, anchors in paths)
        return Offset(0.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 1.0, False, none)
    for _ in range(_ROUNDS):  # outliers distort the fit by which they are detected
        closings = whole.only(~far)
        leakage, leakage_std, by_loss = _leakage(closings)
        level = _level(closings, leakage)
        far |= np.abs(level.left_of(whole, leakage)) > _OUTLIER * level.inflation
        if whole.time.size < _ROBUST or 2 * np.count_nonzero(far) > far.size:
            far[:] = False
            break
    return Offset(
        level=level.value,
        slope=level.slope,
        middle_s=level.middle_s,
        level_var=level.variance,
        leakage=leakage,
        leakage_std=leakage_std,
        mean_voltage=float(closings.area.sum() / closings.time.sum()),
        inflation=level.inflation,
        by_loss=by_loss,
        broken=_broken(paths, far),
    )


def _leakage(closings: _Closings) -> tuple[float, float, bool]:
    """Leakage, its standard deviation, and whether it is estimated from the energy loss."""
    mean = float(closings.area.sum() / closings.time.sum())
    square = float(closings.square.sum())
    spread = square - mean * float(closings.area.sum())
    leakage = std = 0.0
    if spread > 1e-9 * square:
        lost = float(closings.loss.sum()) - mean * float(closings.charge.sum())
        noise = float(closings.moments.sum(axis=0) @ (mean**2, -2.0 * mean, 1.0))
        leakage = 0.5 * lost / spread
        std = float(np.hypot(leakage, max(noise, 0.0) ** 0.5 / spread))
    found, cov, inflation = _by_closing(closings)
    closing_std = float(cov[1, 1]) ** 0.5 * inflation
    if closing_std <= std:
        return float(found[1]), closing_std, False
    return leakage, std, True


def _closings(paths: list[tuple[Path, Anchors]]) -> _Closings:
    rows, started_s = [], 0.0
    for path, anchors in paths:
        noise = np.diff(anchors.grown) + anchors.variance[1:] + anchors.variance[:-1]
        ends = np.round(anchors.at).astype(np.intp)
        for k in range(anchors.at.size - 1):
            inside = slice(int(ends[k]), int(ends[k + 1]) + 1)
            v, walk = path.v[inside], np.diff(path.grown[inside])
            half = 0.5 * (v[1:] + v[:-1])
            rows.append(
                (anchors.charge[k + 1] - anchors.charge[k], anchors.time[k + 1] - anchors.time[k],
                 anchors.area[k + 1] - anchors.area[k],
                 started_s + 0.5 * (anchors.time[k + 1] + anchors.time[k]), noise[k],
                 np.diff(path.charge[inside]) @ half, np.diff(path.time[inside]) @ half**2,
                 walk.sum(), walk @ half, walk @ half**2)
            )  # fmt: skip
        started_s += float(path.time[-1])
    table = np.array(rows, dtype=np.float64).reshape(-1, 10).T
    charge, time, area, middle, variance, loss, square = table[:7]
    return _Closings(charge, time, area, middle, variance, loss, square, table[7:].T)


def _by_closing(closings: _Closings) -> tuple[Floats, Floats, float]:
    """Offset, leakage and possibly a drift by least squares; their covariance and the misfit."""
    unknown = np.full((2, 2), np.inf)
    count = closings.time.size
    if count < _FEWEST:
        return np.zeros(2), unknown, 1.0
    std = np.sqrt(np.maximum(closings.variance, 1e-300))
    columns = [closings.time, closings.area]
    if count >= _WITH_DRIFT:
        columns.append(closings.time * (closings.middle - closings.middle.mean()))
    a = np.stack(columns, axis=1) / std[:, np.newaxis]
    size = np.sqrt((a**2).sum(axis=0))
    if not (size > 0.0).all():
        return np.zeros(2), unknown, 1.0
    u, s, vt = np.linalg.svd(a / size, full_matrices=False)
    if s[-1] < 1e-6 * s[0]:
        return np.zeros(2), unknown, 1.0
    found = vt.T @ ((u.T @ (closings.charge / std)) / s) / size
    cov = (vt.T / s**2) @ vt / np.outer(size, size)
    left = closings.charge / std - a @ (found)
    return found, cov, _misfit(left, a.shape[1])


def _misfit(left: Floats, unknowns: int) -> float:
    """Standardised residuals relative to their expectation, at least 1."""
    if left.size >= _ROBUST:
        return max(1.0, float(np.median(np.abs(left))) / _NORMAL)
    if left.size > unknowns:
        return max(1.0, float(np.sqrt(left @ left / (left.size - unknowns))))
    return 1.0


@dataclass(frozen=True)
class _Level:
    """Offset for a known leakage."""

    value: float
    slope: float
    middle_s: float
    variance: float
    inflation: float

    def left_of(self, closings: _Closings, leakage: float) -> Floats:
        """Closing errors over their standard deviations."""
        offset = self.value + self.slope * (closings.middle - self.middle_s)
        error = closings.charge - leakage * closings.area - offset * closings.time
        return np.asarray(error / np.sqrt(np.maximum(closings.variance, 1e-300)))


def _level(closings: _Closings, leakage: float) -> _Level:
    """Offset for a known leakage, with a linear drift if that is identifiable.

    If the closing errors exceed the noise, the offset drifts irregularly; then its error outside
    all anchors is the spread of the intervals' own offsets.
    """
    std = np.sqrt(np.maximum(closings.variance, 1e-300))
    middle_s = float(closings.middle.mean())
    columns = [closings.time]
    if closings.time.size >= _WITH_DRIFT:
        columns.append(closings.time * (closings.middle - middle_s))
    a = np.stack(columns, axis=1) / std[:, np.newaxis]
    drawn = (closings.charge - leakage * closings.area) / std
    found, _, _, _ = np.linalg.lstsq(a, drawn, rcond=None)
    cov = np.linalg.pinv(a.T @ a, hermitian=True)
    left = drawn - a @ found
    inflation = _misfit(left, a.shape[1])
    variance = inflation**2 * float(cov[0, 0])
    slope = 0.0
    if found.size > 1:
        slope = float(found[1])
        reach_s = 0.5 * float(np.ptp(closings.middle)) + float(closings.time.max())
        variance += inflation**2 * float(cov[1, 1]) * reach_s**2
    if inflation > _WANDERS:
        variance += float(np.mean((left * std / closings.time) ** 2))
    return _Level(float(found[0]), slope, middle_s, variance, inflation)


def _broken(
    paths: list[tuple[Path, Anchors]], far: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], ...]:
    """Intervals whose charge does not return to zero, for each path."""
    broken, first = [], 0
    for _, anchors in paths:
        count = max(anchors.at.size - 1, 0)
        gaps = np.zeros(anchors.at.size + 1, dtype=np.bool_)
        gaps[1 : 1 + count] = far[first : first + count]
        broken.append(gaps)
        first += count
    return tuple(broken)
