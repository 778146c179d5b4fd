"""Properties of a whole record: tones, and the step of its converter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, special

from haselab.models.filters import blackmanharris
from haselab.sensing.sensed import LockinConfig

__all__ = [
    "Lines",
    "converter_step",
    "dithered_error",
    "find_lines",
    "hum_text",
    "rounding_error",
    "strongest_tones",
]

Floats = NDArray[np.float64]

_MOST_BLOCKS = 16
_MOST_LINES = 8
_LOBE = 5  # bins to each side covered by a line of the window
_NEIGHBOURS = 60  # bins to each side that give the noise floor
_EACH = 4  # thinned bins per median
# Power of a line over the median of the floor; noise reaches it with probability exp(-60 ln 2).
_CLEAR = 60.0
_SAMPLE = 8000  # readings used to find the step of the converter
_RUNS = 16  # runs in which they are taken
_COARSE = 0.6  # noise and rounding together, in steps: below, rounding does not act as noise
_ONE_STEP, _ALTERNATING = 1.0, 0.25  # of the converter; largest variance of two values
_CLEAR_TONE = 1e3  # power of a tone over the median of the spectrum
_BESIDE_TONE = 0.05  # power of a second one over the first
_TONE_WIDTH = 3  # lines of the spectrum on either side


@dataclass(frozen=True)
class Lines:
    """Tones of a record other than the carrier and its harmonics.

    Args:
        hz: frequencies that a block separates from the carrier, the strongest first.
        peak: their amplitudes on the two monitors, `(lines, 2)`.
        modulation_hz: distance of side lines on both sides of the carrier; 0: none.
        hum_hz: 50 or 60 if that line is present, else 0.
        hum: its amplitude on the two monitors.
    """

    hz: tuple[float, ...]
    peak: Floats
    modulation_hz: float
    hum_hz: float
    hum: tuple[float, float]


def find_lines(readings: NDArray[np.generic], config: LockinConfig) -> Lines:
    """Find lines in the spectrum of successive blocks.

    Args:
        readings: blocks `(blocks, block_samples, 2)`, those with the largest disturbance.
        config: configuration of the lock-in.
    Returns:
        The significant lines.
    """
    flat = np.ascontiguousarray(readings[:_MOST_BLOCKS].reshape(-1, 2).T, dtype=np.float64)
    window = _window(flat.shape[1])
    n = fft.next_fast_len(window.size, real=True)
    spectrum = fft.rfft((flat - flat.mean(axis=1, keepdims=True)) * window, n=n)
    power = np.ascontiguousarray((spectrum.real**2 + spectrum.imag**2).T)
    bin_hz = config.rate_hz / n
    lobe = int(np.ceil(_LOBE * n / window.size))
    floor = _floor(power)
    shown = (power / floor).max(axis=1)
    carrier = config.carrier_hz / bin_hz
    scale = 2.0 / window.sum()
    hum_hz, hum = _hum(power, floor, bin_hz, lobe, scale)
    low = 1.5 * config.rate_hz / config.block_samples
    found: list[tuple[float, Floats]] = []
    sides: list[float] = []
    shown[: int(low / bin_hz)] = 0.0
    if config.blank[1] > config.blank[0]:
        _without_staircase(shown, config.rate_hz / config.block_samples / bin_hz, lobe)
    for _ in range(4 * _MOST_LINES):
        k = int(np.argmax(shown))
        if shown[k] < _CLEAR or len(found) >= _MOST_LINES:
            break
        shown[max(0, k - lobe) : k + lobe + 1] = 0.0
        order = k / carrier
        if order > 0.5 and abs(order - round(order)) * carrier <= lobe:
            continue
        hz = (k + _offset(power, k)) * bin_hz
        peaks = scale * np.sqrt(power[k])
        found.append((hz, peaks))
        sides.append(hz - config.carrier_hz)
    modulation_hz = _both_sides(sides, found, config)
    reach = 1.0 / config.block_s
    kept = [(hz, peaks) for hz, peaks in found if abs(hz - config.carrier_hz) > 0.8 * reach]
    return Lines(
        tuple(hz for hz, _ in kept),
        np.array([peaks for _, peaks in kept]).reshape(-1, 2),
        modulation_hz,
        hum_hz,
        hum,
    )


def _without_staircase(shown: Floats, spacing: float, lobe: int) -> None:
    """Remove lines at multiples of the block rate, which one update per block causes."""
    for k in np.rint(np.arange(spacing, shown.size - 1, spacing)).astype(int).tolist():
        around = shown[max(0, k - lobe) : k + lobe + 1]
        if shown[k - 1 : k + 2].max() >= around.max():
            around[:] = 0.0


@lru_cache(maxsize=8)
def _window(samples: int) -> Floats:
    return np.asarray(blackmanharris(samples))


def _floor(power: Floats) -> Floats:
    """Noise floor: median of the neighbours, robust against a line."""
    step = max(1, (2 * _NEIGHBOURS + 1) // 16)
    thin = np.pad(power[::step], ((8, 8), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(thin, 17, axis=0)[::_EACH]
    floor = np.median(windows, axis=2)
    at = np.minimum(np.arange(len(power)) // (step * _EACH), len(floor) - 1)
    overall = np.median(power, axis=0)
    return np.asarray(np.maximum(floor[at], 1e-6 * overall + 1e-300))


def _offset(power: Floats, k: int) -> float:
    """Offset of a line from its largest bin, by a parabola through the logarithms."""
    if not 0 < k < len(power) - 1:
        return 0.0
    a, b, c = np.log(power[k - 1 : k + 2].sum(axis=1) + 1e-300)
    return float(np.clip(0.5 * (a - c) / min(a - 2.0 * b + c, -1e-12), -0.5, 0.5))


def _both_sides(
    sides: list[float], found: list[tuple[float, Floats]], config: LockinConfig
) -> float:
    reach = 10.0 / config.block_s
    for k, side in enumerate(sides):
        for j, other in enumerate(sides):
            if (
                0.0 < side < reach
                and abs(side + other) < 0.05 * side + 4.0
                and (found[k][1] / found[j][1] > 0.3).all()
                and (found[k][1] / found[j][1] < 3.0).all()
            ):
                return side
    return 0.0


def _hum(
    power: Floats, floor: Floats, bin_hz: float, lobe: int, scale: float
) -> tuple[float, tuple[float, float]]:
    best, at = 0.0, (0.0, (0.0, 0.0))
    for hz in (50.0, 60.0):
        k = round(hz / bin_hz)
        near = power[max(0, k - 1) : k + 2].max(axis=0)
        beside = power[[max(0, k - lobe), min(len(power) - 1, k + lobe)]].max(axis=0)
        if (near > 20.0 * beside).any() and (near / floor[k]).max() > _CLEAR and near.max() > best:
            best = float(near.max())
            peaks = scale * np.sqrt(near)
            at = (hz, (float(peaks[0]), float(peaks[1])))
    return at


def hum_text(lines: Lines) -> str:
    """Text for the hum; empty without hum."""
    if not lines.hum_hz:
        return ""
    return f"hum of {max(lines.hum):.2g} V at {lines.hum_hz:g} Hz"


def strongest_tones(channel: Floats, rate_hz: float, least_hz: float) -> list[float]:
    """Frequencies of the largest tones of a record, at most two, in order.

    Args:
        channel: readings, shape `(samples,)`.
        rate_hz: samples per second.
        least_hz: lower tones are ignored.
    Example:
        >>> time_s = np.arange(4000) / 1e4
        >>> tones = np.sin(2 * np.pi * 950 * time_s) + np.sin(2 * np.pi * 1000 * time_s)
        >>> [round(hz) for hz in strongest_tones(tones, 1e4, 100.0)]
        [950, 1000]
    """
    if channel.size < 16 or not np.isfinite(channel).all():
        return []
    window = np.hanning(channel.size)
    power = np.abs(np.fft.rfft((channel - channel.mean()) * window)) ** 2
    hz = np.fft.rfftfreq(channel.size, 1.0 / rate_hz)
    power[hz < least_hz] = 0.0
    clear = _CLEAR_TONE * float(np.median(power[power > 0.0])) if (power > 0.0).any() else np.inf
    found: list[float] = []
    largest = float(power.max())
    for _ in range(2):
        at = int(power.argmax())
        if power[at] <= max(clear, _BESIDE_TONE * largest):
            break
        found.append(float(hz[at]))
        power[max(at - _TONE_WIDTH, 0) : at + _TONE_WIDTH + 1] = 0.0
    return sorted(found)


def converter_step(readings: NDArray[np.generic]) -> Floats:
    """Smallest step between values of each channel; 0 if values do not repeat.

    Args:
        readings: blocks `(blocks, block_samples, 2)`.
    Returns:
        Shape `(2,)`, in the unit of the readings.
    """
    if readings.dtype.kind in "iu":
        return np.ones(2)
    flat = readings.reshape(-1, 2)
    if len(flat) > _SAMPLE:  # runs from all over the record; a stride could sample one phase only
        starts = np.linspace(0, len(flat) - _SAMPLE // _RUNS, _RUNS).astype(np.intp)
        flat = np.concatenate([flat[k : k + _SAMPLE // _RUNS] for k in starts])
    flat = flat.astype(np.float64)
    steps = np.zeros(2)
    for channel in (0, 1):
        values = np.unique(flat[:, channel])
        gaps = np.diff(values)
        size = np.abs(values).max() if values.size else 0.0
        gaps = gaps[gaps > 1e-6 * size]
        if 1 <= gaps.size < 0.5 * len(flat):
            step = float(np.median(gaps[gaps < 1.5 * gaps.min()]))
            even = np.abs(gaps / step - np.round(gaps / step)) < 0.05
            steps[channel] = step if even.mean() > 0.95 else 0.0
    return steps


def dithered_error(amplitude: Floats, noise: Floats) -> Floats:
    r"""Error of a sine's amplitude due to a converter's steps, rms over the level.

    $\sum_k \frac{2}{\pi k} J_1(2\pi k A)\, e^{-2\pi^2 k^2 \sigma^2}\cos 2\pi k L$ in steps.

    Args:
        amplitude: peak, in steps.
        noise: standard deviation before the converter, in steps.
    Returns:
        Error, in steps.
    Source: B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, ch. 19 and app. G.
    """
    k = np.arange(1, 40)
    shape = (*np.shape(amplitude), 1)
    terms = 2.0 / (np.pi * k) * special.j1(2.0 * np.pi * k * np.reshape(amplitude, shape))
    terms *= np.exp(-2.0 * (np.pi * k * np.reshape(noise, shape)) ** 2)
    return np.asarray(np.sqrt(0.5 * (terms**2).sum(axis=-1)))


def rounding_error(amplitude: Floats, deviation: Floats, step: Floats) -> Floats:
    """Relative rms error of a sine's amplitude due to the converter's steps.

    Args:
        amplitude: peak on each channel, `(2, blocks)`.
        deviation: of a reading, noise and rounding together, `(2, blocks)`.
        step: step of the converter on each channel, 0 if not known, `(2,)`.
    Returns:
        Shape `(2, blocks)`; 0 where the noise spans several steps.
    """
    error = np.zeros_like(amplitude)
    for channel in np.flatnonzero(step > 0.0).tolist():
        total = deviation[channel] / step[channel]
        rough = total < _COARSE
        size = amplitude[channel, rough] / step[channel]
        # With less than a step, the readings may alternate between two values without any noise.
        rounding = np.where(size < _ONE_STEP, _ALTERNATING, 1.0 / 12.0)
        noise = np.sqrt(np.maximum(total[rough] ** 2 - rounding, 0.0))
        error[channel, rough] = dithered_error(size, noise) / np.maximum(size, 1e-300)
    return error
