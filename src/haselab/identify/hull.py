"""Hull of an oscillation: the decay through its peaks, without a model of the decay between."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate

__all__ = ["hull_decay"]

Floats = NDArray[np.float64]
_WINDOW_RAD = 0.6
_ABOVE_NOISE = 5.0


def hull_decay(
    swings: Sequence[tuple[Floats, Floats, float]], omega_rad_s: float, noise: float
) -> Estimate | None:
    r"""Decay rate of the peaks by a weighted straight line through their logarithms.

    Args:
        swings: for each trial times in s `(N,)`, oscillation without offset `(N,)`, and the phase
            `omega t` of a peak in rad.
        omega_rad_s: damped angular frequency, in rad/s.
        noise: standard deviation of one sample, in the unit of the oscillation.
    Returns:
        Decay rate, in 1/s; None unless one trial shows two peaks above five standard deviations.
    Source: logarithmic decrement; peak heights by parabolas of `+-0.6 rad` about each peak.
    """
    rows: list[tuple[int, float, float, float]] = []
    for trial, (time_s, swing, phase_rad) in enumerate(swings):
        first = math.ceil((omega_rad_s * time_s[0] - phase_rad) / (2.0 * math.pi))
        last = math.floor((omega_rad_s * time_s[-1] - phase_rad) / (2.0 * math.pi))
        for turn in range(first, last + 1):
            peak_s = (phase_rad + 2.0 * math.pi * turn) / omega_rad_s
            found = _peak(time_s, swing, peak_s, _WINDOW_RAD / omega_rad_s, noise)
            if found is None:
                break
            rows.append((trial, peak_s, *found))
    return _line(rows)


def _peak(
    time_s: Floats, swing: Floats, peak_s: float, half_s: float, noise: float
) -> tuple[float, float] | None:
    """Height of one peak and its standard deviation; None when it drowns or is not covered."""
    inside = np.abs(time_s - peak_s) <= half_s
    if inside.sum() < 4 or time_s[0] > peak_s or time_s[-1] < peak_s:
        return None
    offset = (time_s[inside] - peak_s) / half_s
    columns = np.stack([np.ones(offset.size), offset, offset**2], axis=1)
    inverse = np.linalg.pinv(columns)
    height, tilt, bend = inverse @ swing[inside]
    std = noise * float(np.linalg.norm(inverse[0]))
    if bend < 0.0:
        # The top of the parabola; at the peak its height moves only in second order.
        shift = np.clip(-tilt / (2.0 * bend), -1.0, 1.0)
        height = height + tilt * shift + bend * shift**2
    return (float(height), std) if height > _ABOVE_NOISE * std else None


def _line(rows: Sequence[tuple[int, float, float, float]]) -> Estimate | None:
    trials = sorted({row[0] for row in rows})
    if len(rows) < len(trials) + 1:
        return None
    matrix = np.zeros((len(rows), 1 + len(trials)))
    target, weight = np.zeros(len(rows)), np.zeros(len(rows))
    for i, (trial, peak_s, height, std) in enumerate(rows):
        matrix[i, 0], matrix[i, 1 + trials.index(trial)] = -peak_s, 1.0
        target[i], weight[i] = math.log(height), height / max(std, 1e-12 * height)
    inverse = np.linalg.inv((matrix * weight[:, None] ** 2).T @ matrix)
    solution = inverse @ ((matrix * weight[:, None] ** 2).T @ target)
    spare = len(rows) - matrix.shape[1]
    misfit = float((((target - matrix @ solution) * weight) ** 2).sum()) / max(spare, 1)
    std = math.sqrt(float(inverse[0, 0]) * max(1.0, misfit))
    return Estimate.normal(float(solution[0]), std, "1/s")
