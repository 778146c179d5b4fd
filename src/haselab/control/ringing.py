"""Ringing of a step response: detection, and averaging over one period."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

__all__ = ["Ringing", "average_out", "find_ringing", "smooth_lightly"]

_MOST_SAMPLES = 1500  # a longer trace is reduced to block means for the search
_SMALLEST_AMPLITUDE = 0.02  # of the trace's range; less does not affect a rise time
_LIKELIHOOD_GAIN = 30.0  # white noise of 1,500 samples reaches 2 ln(1500) = 15
_SLOWEST_DECAY_RATIO = 0.22  # decay / omega; above, less than a quarter remains after one period


@dataclass(frozen=True)
class Ringing:
    """A decaying oscillation `exp(-decay t) cos(omega t + phase)`.

    Args:
        omega_rad_s: damped angular frequency, in rad/s.
        decay_per_s: decay rate, in 1/s.
    """

    omega_rad_s: float
    decay_per_s: float

    @property
    def lasts(self) -> bool:
        """Whether a quarter or more remains after one period, so that averaging is needed."""
        return self.decay_per_s < _SLOWEST_DECAY_RATIO * self.omega_rad_s


def find_ringing(time_s: NDArray[np.float64], trace: NDArray[np.float64]) -> Ringing | None:
    """Find the ringing of a step response, if any.

    A smooth response (a constant and exponentials over a fixed set of time constants) and one
    decaying oscillation are fitted together; the oscillation starts at the spectral peak of the
    residual of the smooth response.

    Args:
        time_s: uniform time since the step, in s. Shape `(N,)`.
        trace: response, mean of the trials. Shape `(N,)`.
    Returns:
        The ringing, or None if it is below 2 % of the trace's range, not above the noise, or
        decayed within a period.
    """
    count = max(1, -(-trace.size // _MOST_SAMPLES))
    size = trace.size // count * count
    y = trace[:size].reshape(-1, count).mean(axis=1)
    t = time_s[:size].reshape(-1, count).mean(axis=1) - time_s[0]
    if y.size < 20 or np.ptp(y) == 0.0:
        return None
    spans = np.geomspace(t[-1] / 60.0, t[-1], 6)
    smooth = np.column_stack([np.ones(t.size), np.exp(-t[:, None] / spans)])
    basis = np.linalg.qr(smooth)[0]
    left = y - basis @ (basis.T @ y)

    def oscillation(omega: float, decay: float) -> NDArray[np.float64]:
        pair = np.exp(-decay * t) * np.array([np.cos(omega * t), np.sin(omega * t)])
        return np.asarray(pair.T)

    def fit(point: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pair = oscillation(*np.exp(point))
        pair_left = pair - basis @ (basis.T @ pair)
        weights = np.linalg.lstsq(pair_left, left, rcond=None)[0]
        return left - pair_left @ weights, weights

    guess = _spectral_peak(t, left)
    if guess is None:
        return None
    start = np.log([guess, 0.1 * guess])
    bounds = (start - np.array([0.4, 6.0]), start + np.array([0.4, 1.5]))
    found = least_squares(lambda p: fit(p)[0] / np.ptp(y), start, bounds=bounds)
    rest, weights = fit(found.x)
    ringing = Ringing(*(float(value) for value in np.exp(found.x)))
    gain = t.size * math.log((left @ left + 1e-300) / (rest @ rest + 1e-300))
    loud = math.hypot(*weights) > _SMALLEST_AMPLITUDE * np.ptp(y) and gain > _LIKELIHOOD_GAIN
    return ringing if loud and ringing.lasts else None


def _spectral_peak(t: NDArray[np.float64], left: NDArray[np.float64]) -> float | None:
    """Angular frequency of the largest peak with at least three periods in the record."""
    padded = 8 * t.size
    power = np.abs(np.fft.rfft(left, padded)) ** 2
    lowest = 3 * 8
    peaks = 1 + np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:]))
    peaks = peaks[peaks >= lowest]
    if peaks.size == 0:
        return None
    best = peaks[np.argmax(power[peaks])]
    return float(2.0 * np.pi * best / (padded * (t[1] - t[0])))


def average_out(
    trace: NDArray[np.float64], ringing: Ringing, rate_hz: float
) -> NDArray[np.float64]:
    """Average a response over one period of its ringing.

    At each time a straight line and the decaying oscillation are fitted to the period around
    it, and the line is kept. Away from the ends that is the average over one period; at the ends
    the window stays inside the record, so that data before the step are not included.

    Args:
        trace: response from the step on. Shape `(N,)`.
        ringing: ringing to average out.
        rate_hz: sampling rate of the trace, in Hz.
    Returns:
        The averaged response. Shape `(N,)`.
    """
    half = max(3, round(math.pi / ringing.omega_rad_s * rate_hz))
    half = min(half, (trace.size - 1) // 2)
    t = np.arange(-half, half + 1) / rate_hz
    phase = ringing.omega_rad_s * t
    decay = np.exp(-ringing.decay_per_s * t)
    line = np.column_stack([np.ones(t.size), t])
    design = np.column_stack([line, decay * np.cos(phase), decay * np.sin(phase)])
    return _apply(trace, line @ np.linalg.pinv(design)[:2])


def smooth_lightly(
    trace: NDArray[np.float64], window_s: float, rate_hz: float
) -> NDArray[np.float64]:
    """Smooth a response by a parabola over `window_s` around each time.

    Args:
        trace: response from the step on. Shape `(N,)`.
        window_s: width of the window, in s; below four samples the trace is unchanged.
        rate_hz: sampling rate of the trace, in Hz.
    Returns:
        The smoothed response. Shape `(N,)`.
    """
    half = min(int(0.5 * window_s * rate_hz), (trace.size - 1) // 2)
    if half < 2:
        return trace
    parabola = np.vander(np.linspace(-1.0, 1.0, 2 * half + 1), 3)
    return _apply(trace, parabola @ np.linalg.pinv(parabola))


def _apply(trace: NDArray[np.float64], fit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply the middle row of a window's fit at every sample, and its outer rows at the ends."""
    size, half = fit.shape[0], fit.shape[0] // 2
    return np.concatenate(
        [
            fit[:half] @ trace[:size],
            np.convolve(trace, fit[half, ::-1], mode="valid"),
            fit[half + 1 :] @ trace[-size:],
        ]
    )
