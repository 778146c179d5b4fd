"""Offset of the current monitor and leakage, from charges that must close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.charge_path import Anchors, Path

__all__ = ["Offset", "fit_offset"]

Floats = NDArray[np.float64]

_FEWEST = 4  # intervals that tell leakage from offset
_WITH_DRIFT = 6
_ROBUST = 8  # intervals from which on an outlier is told from noise
_NORMAL = 0.6745  # median of |x| over the standard deviation of a normal distribution
_OUTLIER = 6.0
_WANDERS = 2.0  # misfit from which on the offset is no line in time


@dataclass(frozen=True)
class Offset:
    """What the current monitor shows beside the charging current.

    Args:
        level: offset at the middle of the record, in the unit of the readings.
        slope: of the offset, per s.
        middle_s: where `level` is meant, counted over all runs.
        level_var: its variance for a known leakage; infinite where it is not known.
        leakage: current over voltage, both as readings.
        leakage_std: its standard deviation.
        mean_voltage: where offset and leakage are uncorrelated.
        inflation: closing errors over what the noise explains, at least 1.
        by_loss: the leakage comes from the energy that is lost, so it may be a hysteresis.
        broken: of each path, the intervals whose charge does not close, `(anchors + 1,)`.
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


@dataclass(frozen=True)
class _Closings:
    """Intervals between anchors, shape `(intervals,)`, and sums over all of them."""

    charge: Floats
    time: Floats
    area: Floats
    middle: Floats
    variance: Floats
    loss: float
    square: float
    loss_var: float


def fit_offset(paths: list[tuple[Path, Anchors]]) -> Offset:
    r"""Offset and leakage of a record.

    Between two anchors $\Delta q = i_0 \Delta t + G \int v\,dt$. Where the mean voltages of the
    intervals differ, both follow by least squares. Else a cycle's energy gives G, which holds the
    loss of a hysteresis too: half of it is taken, with the same as its deviation.

    Args:
        paths: each run of blocks with its anchors.
    """
    closings = _closings(paths)
    nothing = tuple(np.zeros(anchors.at.size + 1, dtype=np.bool_) for _, anchors in paths)
    total_s = float(closings.time.sum())
    if total_s <= 0.0:
        return Offset(0.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 1.0, False, nothing)
    mean = float(closings.area.sum()) / total_s
    spread = closings.square - mean * float(closings.area.sum())
    leakage = loss_std = noise = 0.0
    if spread > 1e-9 * closings.square:
        by_energy = (closings.loss - mean * float(closings.charge.sum())) / spread
        noise = closings.loss_var**0.5 / spread
        leakage, loss_std = 0.5 * by_energy, float(np.hypot(0.5 * by_energy, noise))
    one, cov, inflation = _by_closing(closings)
    by_loss = not cov[1, 1] ** 0.5 * inflation <= loss_std
    if not by_loss:
        leakage, loss_std = float(one[1]), float(cov[1, 1] ** 0.5) * inflation
    level = _level(closings, leakage)
    return Offset(
        level=level.value,
        slope=level.slope,
        middle_s=level.middle_s,
        level_var=level.variance,
        leakage=leakage,
        leakage_std=loss_std,
        mean_voltage=mean,
        inflation=level.inflation,
        by_loss=by_loss,
        broken=_broken(paths, level),
    )


def _closings(paths: list[tuple[Path, Anchors]]) -> _Closings:
    rows, loss, square = [np.zeros((0, 5))], 0.0, 0.0
    moments = []
    started_s = 0.0
    for path, anchors in paths:
        at = anchors.at
        middle = started_s + 0.5 * (anchors.time[1:] + anchors.time[:-1])
        started_s += float(path.time[-1])
        variance = np.diff(anchors.grown) + anchors.variance[1:] + anchors.variance[:-1]
        rows.append(
            np.stack([np.diff(anchors.charge), np.diff(anchors.time), np.diff(anchors.area),
                      middle, variance], axis=1)
        )  # fmt: skip
        if at.size < 2:
            continue
        inside = slice(int(np.ceil(at[0])), int(np.floor(at[-1])) + 1)
        v = path.v[inside]
        half = 0.5 * (v[1:] + v[:-1])
        loss += float(np.diff(path.charge[inside]) @ half)
        square += float(np.diff(path.time[inside]) @ half**2)
        moments.append((np.diff(path.grown[inside]), half))
    charge, time, area, at_s, variance = np.concatenate(rows).T
    mean = float(area.sum()) / float(time.sum()) if time.size else 0.0
    loss_var = sum(float(step @ (half - mean) ** 2) for step, half in moments)
    return _Closings(charge, time, area, at_s, variance, loss, square, loss_var)


def _by_closing(closings: _Closings) -> tuple[Floats, Floats, float]:
    """Offset, leakage and perhaps a drift by least squares; their covariance and the misfit."""
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
    """Standardised residuals over what they should be, at least 1."""
    if left.size >= _ROBUST:
        return max(1.0, float(np.median(np.abs(left))) / _NORMAL)
    if left.size > unknowns:
        return max(1.0, float(np.sqrt(left @ left / (left.size - unknowns))))
    return 1.0


@dataclass(frozen=True)
class _Level:
    """Offset for a known leakage; `left` are closing errors over their deviations."""

    value: float
    slope: float
    middle_s: float
    variance: float
    inflation: float
    left: Floats


def _level(closings: _Closings, leakage: float) -> _Level:
    """Offset for a known leakage, with a drift that is linear in time where that is known.

    Where the closing errors exceed what the noise explains the offset wanders; then it may be off
    by the spread of the intervals' own offsets outside of all anchors.
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
    return _Level(float(found[0]), slope, middle_s, variance, inflation, left)


def _broken(paths: list[tuple[Path, Anchors]], level: _Level) -> tuple[NDArray[np.bool_], ...]:
    """Intervals whose charge does not close, for each path."""
    far = (np.abs(level.left) > _OUTLIER * level.inflation) & (level.left.size >= _ROBUST)
    broken, first = [], 0
    for _, anchors in paths:
        count = max(anchors.at.size - 1, 0)
        gaps = np.zeros(anchors.at.size + 1, dtype=np.bool_)
        gaps[1 : 1 + count] = far[first : first + count]
        broken.append(gaps)
        first += count
    return tuple(broken)
