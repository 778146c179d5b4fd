"""The charge along a record, and its anchors: crossings of 0 V."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.charge.noise import Noise

__all__ = ["Anchors", "Path", "find_anchors", "runs_of"]

Floats = NDArray[np.float64]

_NEAR = 0.02  # of the largest voltage: counts as near 0 V
_CALM = 0.002  # of the largest voltage: counts as 0 V
_CLEAR_NOISE = 12.0  # standard deviations of the noise that count as near 0 V
_SHORT_RUN = 4  # points near 0 V
_LOW = 0.15  # of the largest voltage: range for the capacitance near 0 V
_DISTANCES = (1 / 64, 1 / 16, 1 / 4, 1.0)  # of a block, for the differences
_LOW_ERROR = 0.03  # relative error of that capacitance when it extrapolates an anchor to 0 V
_NODES = 6  # of the quadrature
# Extrapolation by a parabola through three values.
_BEYOND = ((3.0, -3.0, 1.0), (6.0, -8.0, 3.0), (10.0, -15.0, 6.0))
_MOST_WINDOW = 10  # largest number of points on either side of an anchor
_JUMP = (1.0 / 6.0, -5.0 / 6.0, 10.0 / 6.0)  # filter for a step; a quartic gives 0
_JUMP_NOISE = 7.0  # its variance over that of a point
_CLEAR_JUMP = 6.0
_STEP = 0.05  # of the voltage's range between two points: too fast to integrate the current


@dataclass(frozen=True)
class Anchors:
    """Points of known charge, in order; arrays of shape `(anchors,)`.

    Args:
        at: positions, in points.
        charge: of the path there, minus the charge at the voltage there.
        time: from the path's start, in s.
        area: integral of the voltage.
        variance: of the known charge.
        grown: accumulated variance of the path's charge.
    """

    at: Floats
    charge: Floats
    time: Floats
    area: Floats
    variance: Floats
    grown: Floats


@dataclass(frozen=True)
class Path:
    """Integrals over one run of blocks; arrays of shape `(points,)`, unit of the readings and s.

    Args:
        v: voltage.
        charge: integral of the current up to each point.
        time: from the first point.
        area: integral of the voltage.
        grown: variance of `charge` from noise and unresolved kinks.
        stepped: points after which the voltage steps faster than the record resolves.
        smoothing: points averaged over a hum's period, else 1.
        hum_hz: of the subtracted hum, or 0.
    """

    v: Floats
    charge: Floats
    time: Floats
    area: Floats
    grown: Floats
    stepped: NDArray[np.intp]
    smoothing: float
    hum_hz: float

    @classmethod
    def of(
        cls, v: Floats, i: Floats, point_s: float, skew_s: float, noise: Noise, hum_hz: float
    ) -> Path:
        """Integrate a run.

        Args:
            v: voltage, shape `(points,)`.
            i: current, each point `skew_s` later than that of the voltage.
            point_s: time between points.
            skew_s: delay from a voltage sample to its current sample.
            noise: of a point.
            hum_hz: frequency of a hum to subtract, or 0.
        """
        charge = _integral(i, point_s, skew_s / point_s)
        area = _integral(v, point_s, 0.0)
        time = point_s * np.arange(v.size, dtype=np.float64)
        jump = _jumps(i, noise.i_var)
        grown = np.cumsum(np.r_[0.0, noise.i_var + jump**2 / 12.0]) * point_s**2
        steep = np.abs(_jumps(v, noise.v_var)) > _STEP * float(np.ptp(v))
        width = 1.0
        if hum_hz:
            kernel = _mean_over(max(1.0, 1.0 / (hum_hz * point_s)))
            width = float(1.0 / (kernel @ kernel))
            share = np.convolve(np.ones(v.size), kernel, "same")
            v, charge, time, area = (
                np.convolve(x, kernel, "same") / share for x in (v, charge, time, area)
            )
        return cls(v, charge, time, area, grown, np.flatnonzero(steep), width, hum_hz)

    def tied(self, anchors: Anchors) -> tuple[Floats, Floats, Floats]:
        """Charge, time and area, each minus a line from anchor to anchor, shape `(points,)`.

        Before the first anchor and after the last one the line is level: there time and area are
        those since the anchor, between two anchors the time is 0.
        """
        points = np.arange(self.v.size)
        return tuple(  # type: ignore[return-value]
            whole - np.interp(points, anchors.at, there)
            for whole, there in (
                (self.charge, anchors.charge),
                (self.time, anchors.time),
                (self.area, anchors.area),
            )
        )

    def without_drift(self, anchors: Anchors, slope: float, from_s: float) -> tuple[Path, Anchors]:
        """The path and anchors without a current that grows linearly from 0 at a given time."""
        if slope == 0.0:
            return self, anchors

        def drawn(time: Floats) -> Floats:
            return np.asarray(0.5 * slope * (time - from_s) ** 2)

        path = replace(self, charge=self.charge - drawn(self.time))
        return path, replace(anchors, charge=anchors.charge - drawn(anchors.time))

    def fault(self, anchors: Anchors, bad: NDArray[np.bool_], part: slice) -> str:
        """Why the charge of a block cannot be used; empty if it can.

        Args:
            anchors: of the path.
            bad: intervals whose charge does not return to zero, shape `(anchors + 1,)`.
            part: points of the block.
        """
        first, last = np.searchsorted(anchors.at, (part.start, part.stop - 1))
        if bad[first : last + 1].any():
            return "charge does not return to zero between two crossings of 0 V"
        steps = np.searchsorted(anchors.at, self.stepped)
        if ((steps >= first) & (steps <= last)).any():
            return "voltage steps faster than the record resolves"
        return ""

    def walk_variance(self, anchors: Anchors, part: slice) -> float:
        """Variance of the sum of voltage times tied charge over a block.

        Between two anchors the error of the charge is a random walk fixed at both ends,
        outside it is fixed at one end; the anchors add their own errors.
        """
        cuts = np.clip(np.ceil(anchors.at).astype(np.intp), part.start, part.stop)
        edges = np.unique(np.r_[part.start, cuts, part.stop])
        own = np.zeros(anchors.at.size)
        total = 0.0
        for low, high in pairwise(edges.tolist()):
            gap = int(np.searchsorted(anchors.at, low, side="right"))
            total += self._segment(anchors, gap, low, high, own)
        return total + float(own**2 @ anchors.variance)

    def _segment(self, anchors: Anchors, gap: int, low: int, high: int, own: Floats) -> float:
        """Variance of points `[low, high)` of one interval; adds to the weights of its anchors."""
        w, grown = self.v[low:high], self.grown
        steps = np.diff(grown[low:high])
        whole = float(w.sum())
        heads = np.cumsum(w)[:-1]
        if gap == 0:  # before the first anchor
            after = float(anchors.grown[0] - grown[high - 1])
            own[0] += whole
            return float(steps @ heads**2) + max(after, 0.0) * whole**2
        left = anchors.at[gap - 1]
        before = max(float(grown[low] - anchors.grown[gap - 1]), 0.0)
        tails = whole - heads
        if gap == anchors.at.size:  # after the last
            own[-1] += whole
            return before * whole**2 + float(steps @ tails**2)
        right = anchors.at[gap]
        after = max(float(anchors.grown[gap] - grown[high - 1]), 0.0)
        share = (np.arange(low, high) - left) / (right - left)
        own[gap - 1] += float(w @ (1.0 - share))
        own[gap] += float(w @ share)
        mean = (max(low - left, 0.0) * whole + float(tails.sum())) / (right - left)
        inside = float(steps @ (tails - mean) ** 2)
        return float(before * (whole - mean) ** 2 + inside + after * mean**2)


def runs_of(good: NDArray[np.bool_]) -> list[slice]:
    """Runs of consecutive good blocks.

    Args:
        good: shape `(blocks,)`.
    Example:
        >>> runs_of(np.array([True, True, False, True]))
        [slice(0, 2, None), slice(3, 4, None)]
    """
    edges = np.flatnonzero(np.diff(np.r_[False, good, False].astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def find_anchors(path: Path, most: float, points: int, noise: Noise) -> Anchors:
    """Find the points where the voltage is near 0 V or changes its sign.

    Args:
        path: of a run.
        most: largest voltage of the record.
        points: of a block; anchors are at least a quarter of it apart.
        noise: of a point.
    """
    v_var = noise.v_var / path.smoothing
    gap = max(4, points // 4)
    kernels = _kernels(path.v, most, v_var**0.5, gap)
    low = _low_capacitance(path, most, v_var, points)
    rows = []
    last = -np.inf
    for index, weight in kernels:
        at = float(index @ weight)
        if at - last < gap:
            continue
        last = at
        held = low * float(path.v[index] @ weight)
        # Hum smoothing correlates the noise of a few points.
        variance = low**2 * v_var * float(weight @ weight) + (_LOW_ERROR * held) ** 2
        rows.append(
            (at, float(path.charge[index] @ weight) - held, float(path.time[index] @ weight),
             float(path.area[index] @ weight), variance, float(path.grown[index] @ weight))
        )  # fmt: skip
    return Anchors(*np.array(rows, dtype=np.float64).reshape(-1, 6).T)


def _kernels(v: Floats, most: float, std: float, gap: int) -> list[tuple[NDArray[np.intp], Floats]]:
    """Points and weights of each crossing of 0 V, in order.

    They are searched in a moving average long enough that noise splits none of them.
    """
    half = int(min((_CLEAR_NOISE * std / (_NEAR * most)) ** 2, 31, gap // 4)) // 2
    smooth = np.convolve(np.pad(v, half, "edge"), np.ones(2 * half + 1), "valid") / (2 * half + 1)
    std /= (2 * half + 1) ** 0.5
    calm = np.abs(smooth) <= max(_CALM * most, 3.0 * std)
    found, taken = [], np.zeros(v.size, dtype=np.bool_)
    for run in _merged(runs_of(np.abs(smooth) <= max(_NEAR * most, 3.0 * std)), gap // 8):
        short = run.stop - run.start < _SHORT_RUN
        if short and smooth[run].min() < 0.0 < smooth[run].max():
            continue  # a crossing, found below
        taken[max(run.start - 1, 0) : run.stop + 1] = True
        found += _windows(run, calm, gap, v.size)
    crossed = np.flatnonzero((smooth[:-1] * smooth[1:] < 0.0) & ~taken[:-1] & ~taken[1:])
    for n in crossed.tolist():
        share = smooth[n] / (smooth[n] - smooth[n + 1])
        low, high = max(n - half, 0), min(n + 2 + half, v.size)
        weight = np.ones(high - low)
        weight[0], weight[-1] = 1.0 - share, share
        found.append((np.arange(low, high), weight / weight.sum()))
    return sorted(found, key=lambda kernel: float(kernel[0][0]))


def _windows(
    run: slice, calm: NDArray[np.bool_], gap: int, size: int
) -> list[tuple[NDArray[np.intp], Floats]]:
    """Windows of a few points near 0 V: one, or several along a longer run."""
    still = run.start + np.flatnonzero(calm[run])
    start, stop = (int(still[0]), int(still[-1]) + 1) if still.size else (run.start, run.stop)
    half = min((stop - start) // 4, _MOST_WINDOW)
    middles = [(start + stop - 1) // 2]
    if stop - start > 2 * gap:
        count = max(2, (stop - start) // (gap + 1))
        middles = np.linspace(start + half, stop - 1 - half, count).astype(int).tolist()
    found = []
    for middle in middles:
        index = np.arange(max(middle - half, 0), min(middle + half + 1, size))
        found.append((index, np.full(index.size, 1.0 / index.size)))
    return found


def _merged(runs: list[slice], apart: int) -> list[slice]:
    """Merge runs that are separated by short gaps."""
    merged: list[slice] = []
    for run in runs:
        if merged and run.start - merged[-1].stop <= apart and apart > 1:
            merged[-1] = slice(merged[-1].start, run.stop)
        else:
            merged.append(run)
    return merged


def _low_capacitance(path: Path, most: float, v_var: float, points: int) -> float:
    """Slope of charge over voltage near 0 V, or over all voltages if the drive is too fast.

    Uses the distance between points that is least affected by the noise of the voltage.
    """
    for limit in (_LOW, np.inf):
        best, slope = 2.0, 0.0
        for apart in sorted({1, *(max(1, int(points * share)) for share in _DISTANCES)}):
            energy, idle, both = _moves(path, limit * most, v_var, apart)
            if energy - idle > best * idle:
                best, slope = (energy - idle) / idle, both / (energy - idle)
        if slope:
            return slope
    return 0.0


def _moves(path: Path, limit: float, v_var: float, apart: int) -> tuple[float, float, float]:
    """Squared changes of the voltage, their noise, and products with those of the charge.

    Both are averaged over as many points as they are apart; otherwise the limit on a noisy voltage
    would select by noise.
    """
    if path.v.size <= 2 * apart:
        return 0.0, 1.0, 0.0
    v, q = (
        (total[apart:] - total[:-apart]) / apart
        for total in (np.cumsum(path.v), np.cumsum(path.charge))
    )
    inside = (np.abs(v[apart:]) < limit) & (np.abs(v[:-apart]) < limit)
    dv, dq = (v[apart:] - v[:-apart])[inside], (q[apart:] - q[:-apart])[inside]
    if dv.size < 4:
        return 0.0, 1.0, 0.0
    dv, dq = dv - dv.mean(), dq - dq.mean()
    idle = max(2.0 * dv.size * v_var / apart, 1e-300)
    return float(dv @ dv), idle, float(dv @ dq)


def _integral(x: Floats, point_s: float, late: float) -> Floats:
    """Integral from the first point to each one; the samples of x are delayed by `late` points."""
    if x.size == 0:
        return np.empty(0)
    whole = int(np.floor(late))
    places = np.arange(_NODES) - (_NODES // 2 - 1) + (late - whole)
    powers = np.arange(_NODES)
    weights = np.linalg.solve(places[np.newaxis] ** powers[:, np.newaxis], 1.0 / (powers + 1.0))
    first = len(_BEYOND) - (_NODES // 2 - 1) - whole
    wanted = np.arange(first, first + x.size - 1 + _NODES - 1)
    longer = _extended(x)
    steps = np.convolve(longer[np.clip(wanted, 0, longer.size - 1)], weights[::-1], "valid")
    whole_charge = np.zeros(x.size)
    whole_charge[1:] = point_s * np.cumsum(steps[: x.size - 1])
    return whole_charge


def _extended(x: Floats) -> Floats:
    """Extend by a few values at both ends, by the parabola through the last three."""
    if x.size < 3:
        return np.pad(x, len(_BEYOND), "edge")
    before, after = np.array(_BEYOND) @ x[:3], np.array(_BEYOND) @ x[:-4:-1]
    return np.concatenate([before[::-1], x, after])


def _jumps(x: Floats, variance: float) -> Floats:
    """Steps between neighbouring points that are above the noise, else 0, shape `(points - 1,)`."""
    if x.size < 2 * len(_JUMP):
        return np.zeros(max(x.size - 1, 0))
    half = np.array(_JUMP)
    inner = np.convolve(x, np.r_[half, -half[::-1]], "valid")
    size = np.abs(np.r_[0.0, 0.0, inner, 0.0, 0.0])
    around = np.lib.stride_tricks.sliding_window_view(np.r_[0.0, 0.0, size, 0.0, 0.0], 5)
    clear = (size == around.max(axis=1)) & (size > _CLEAR_JUMP * (_JUMP_NOISE * variance) ** 0.5)
    return np.asarray(np.where(clear, size, 0.0), dtype=np.float64)


def _mean_over(width: float) -> Floats:
    """Kernel of a mean over a width in points, applied twice so that a parabola is preserved.

    With H the response of the mean, the result is 1 - (1 - H)^2; it is zero where H is zero.
    """
    whole = int(np.floor(width))
    part = width - whole
    mean = np.ones(whole) if part < 1e-6 else np.r_[part / 2.0, np.ones(whole), part / 2.0]
    mean /= mean.sum()
    if mean.size % 2 == 0:  # an even mean delays by half a point, applied twice by a whole one
        mean = 0.5 * (np.r_[mean, 0.0] + np.r_[0.0, mean])
    kernel = -np.convolve(mean, mean)
    middle = mean.size // 2
    kernel[middle : middle + mean.size] += 2.0 * mean
    return np.asarray(kernel, dtype=np.float64)
