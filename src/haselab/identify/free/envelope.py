"""Envelope of an oscillation: decay rate of its peaks, without a model of the decay between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.models.filters import lfilter

__all__ = ["Swing", "envelope_decay"]

Floats = NDArray[np.float64]
_WINDOW_RAD = 0.6
_ABOVE_NOISE = 5.0
_REFINEMENTS = 3


@dataclass(frozen=True)
class Swing:
    """Oscillation of one trial without offset and creep, turned so that its peaks are positive.

    Args:
        time_s: times from the first sample, in s. Shape `(N,)`.
        value: oscillation. Shape `(N,)`.
        peak_rad: phase `omega t` of a peak, in rad.
        height: expected height of a peak at time zero, to find where the peaks vanish in the noise.
        decay_per_s: expected decay, for the same.
    """

    time_s: Floats
    value: Floats
    peak_rad: float
    height: float
    decay_per_s: float


@dataclass(frozen=True)
class _Peaks:
    """Heights of the peaks of one trial and their covariance. `(P,)`, `(P,)`, `(P, P)`."""

    time_s: Floats
    height: Floats
    covariance: Floats


def envelope_decay(
    swings: Sequence[Swing], omega_rad_s: float, noise: tuple[Floats, float]
) -> Estimate | None:
    r"""Decay rate of the peaks by a weighted straight line through their logarithms.

    A peak counts while its expected height is above five standard deviations, so noise does not
    select the peaks; the line has a common slope and one level per trial.

    Args:
        swings: one per trial.
        omega_rad_s: damped angular frequency, in rad/s.
        noise: autoregressive polynomial and variance of the innovation of the noise.
    Returns:
        Decay rate, in 1/s; None unless one trial has two peaks.
    Source: logarithmic decrement; peak heights by parabolas of `+-0.6 rad` about each peak.
    """
    found = [_peaks(swing, omega_rad_s, noise) for swing in swings]
    kept = [peaks for peaks in found if peaks.time_s.size]
    if sum(peaks.time_s.size for peaks in kept) < len(kept) + 1:
        return None
    return _line(kept)


def _peaks(swing: Swing, omega_rad_s: float, noise: tuple[Floats, float]) -> _Peaks:
    time_s, half_s = swing.time_s, _WINDOW_RAD / omega_rad_s
    covariance = _covariance(noise, time_s.size)
    first = math.ceil((omega_rad_s * time_s[0] - swing.peak_rad) / (2.0 * math.pi))
    last = math.floor((omega_rad_s * time_s[-1] - swing.peak_rad) / (2.0 * math.pi))
    at_s: list[float] = []
    weights: list[Floats] = []
    for turn in range(first, last + 1):
        peak_s = (swing.peak_rad + 2.0 * math.pi * turn) / omega_rad_s
        inside = np.flatnonzero(np.abs(time_s - peak_s) <= half_s)
        if inside.size < 4:
            continue
        offset = (time_s[inside] - peak_s) / half_s
        columns = np.stack([np.ones(offset.size), offset, offset**2], axis=1)
        weight = np.asarray(np.linalg.pinv(columns)[0], dtype=np.float64)
        lags = np.abs(inside[:, None] - inside[None, :])
        std = math.sqrt(float(weight @ covariance[lags] @ weight))
        if swing.height * math.exp(-swing.decay_per_s * peak_s) <= _ABOVE_NOISE * std:
            break
        full = np.zeros(time_s.size)
        full[inside] = weight
        at_s.append(peak_s)
        weights.append(full)
    matrix = np.array(weights).reshape(len(weights), time_s.size)
    height = matrix @ swing.value
    known = height > 0.0
    spread = matrix[known] @ _toeplitz_times(covariance, matrix[known].T)
    return _Peaks(np.array(at_s)[known], height[known], spread)


def _covariance(noise: tuple[Floats, float], count: int) -> Floats:
    """Autocovariance at lags 0 to `count - 1` of an autoregressive process."""
    polynomial, variance = noise
    impulse = np.zeros(count)
    impulse[0] = 1.0
    response = np.asarray(lfilter([1.0], polynomial, impulse))
    size = 2 * count
    power = np.abs(np.fft.rfft(response, size)) ** 2
    return np.asarray(variance * np.fft.irfft(power, size)[:count])


def _toeplitz_times(covariance: Floats, columns: Floats) -> Floats:
    """Covariance matrix of a stationary process times columns."""
    count = covariance.size
    circle = np.concatenate([covariance, [0.0], covariance[:0:-1]])
    spectrum = np.fft.rfft(circle)[:, None] * np.fft.rfft(columns, 2 * count, axis=0)
    return np.asarray(np.fft.irfft(spectrum, 2 * count, axis=0)[:count])


def _line(trials: Sequence[_Peaks]) -> Estimate:
    """Slope of the logarithms of all trials, weighted by the expected heights."""
    size = sum(peaks.time_s.size for peaks in trials)
    matrix, target = np.zeros((size, 1 + len(trials))), np.zeros(size)
    covariance, height, begin = np.zeros((size, size)), np.zeros(size), 0
    for i, peaks in enumerate(trials):
        end = begin + peaks.time_s.size
        matrix[begin:end, 0], matrix[begin:end, 1 + i] = -peaks.time_s, 1.0
        target[begin:end] = np.log(peaks.height)
        covariance[begin:end, begin:end] = peaks.covariance
        height[begin:end], begin = peaks.height, end
    solution, expected = np.zeros(matrix.shape[1]), height
    for _ in range(_REFINEMENTS):
        # The logarithm of a noisy height is biased low by half its relative variance.
        relative = covariance / np.outer(expected, expected)
        variance = np.diag(relative)
        lifted = target + 0.5 * np.diag(covariance) / height**2
        weighted = matrix / variance[:, None]
        inverse: Floats = np.asarray(np.linalg.inv(weighted.T @ matrix), dtype=np.float64)
        solution = inverse @ (weighted.T @ lifted)
        expected = np.exp(matrix @ solution)
    spread = inverse @ weighted.T @ relative @ weighted @ inverse
    misfit = ((lifted - matrix @ solution) ** 2 / variance).sum() / max(size - matrix.shape[1], 1)
    std = math.sqrt(float(spread[0, 0]) * max(1.0, float(misfit)))
    return Estimate.normal(float(solution[0]), std, "1/s")
