"""Drive signals: one value for each output update."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError, checked

__all__ = ["constant", "linear_chirp", "multisine", "prbs", "square", "triangle"]

# Feedback taps of maximal-length shift registers by their length: x^n + x^k + 1 and similar.
_TAPS = {
    5: (5, 3), 6: (6, 5), 7: (7, 6), 8: (8, 6, 5, 4), 9: (9, 5), 10: (10, 7), 11: (11, 9),
    12: (12, 11, 10, 4), 13: (13, 12, 11, 8), 14: (14, 13, 12, 2), 15: (15, 14),
    16: (16, 15, 13, 4),
}  # fmt: skip


_MOST_SAMPLES = 1e8


def _count(duration_s: float, rate_hz: float) -> int:
    if not (duration_s > 0.0 and rate_hz > 0.0):
        raise InputError(
            f"Duration {duration_s:g} s at {rate_hz:g} Hz gives no sample; both must be above 0."
        )
    count = duration_s * rate_hz
    if not 0.5 < count <= _MOST_SAMPLES:
        raise InputError(
            f"Duration {duration_s:g} s at {rate_hz:g} Hz gives {count:.3g} samples; it must be 1 "
            f"to {_MOST_SAMPLES:g}. Change the duration."
        )
    return round(count)


@checked
def constant(level: float, duration_s: float, rate_hz: float) -> NDArray[np.float64]:
    """Create a constant signal.

    Args:
        level: value of every sample, any unit.
        duration_s: length, in s.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample.
    Example:
        >>> constant(1.0, 0.03, 100.0)
        array([1., 1., 1.])
    """
    return np.full(_count(duration_s, rate_hz), float(level))


@checked
def triangle(
    low: float, high: float, frequency_hz: float, cycles: int, rate_hz: float
) -> NDArray[np.float64]:
    """Create a triangle from `low` up to `high` and back.

    Args:
        low: start, any unit.
        high: peak, same unit.
        frequency_hz: frequency of one rise and fall.
        cycles: number of cycles.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(cycles / frequency_hz * rate_hz),)`.
    Raises:
        InputError: no sample.
    Source: reference study, row S2.
    Example:
        >>> triangle(0.0, 2.0, 0.25, 1, 2.0)
        array([0. , 0.5, 1. , 1.5, 2. , 1.5, 1. , 0.5])
    """
    if not 0.0 < frequency_hz < np.inf:
        raise InputError(f"frequency_hz is {frequency_hz:g}; it must be above 0 Hz and finite.")
    time_s = np.arange(_count(cycles / frequency_hz, rate_hz)) / rate_hz
    phase = (time_s * frequency_hz) % 1.0
    rise: NDArray[np.float64] = 1.0 - np.abs(2.0 * phase - 1.0)
    return low + (high - low) * rise


@checked
def linear_chirp(
    start_hz: float, stop_hz: float, duration_s: float, rate_hz: float
) -> NDArray[np.float64]:
    r"""Create a sine of unit amplitude with linearly increasing frequency.

    $x = \sin 2\pi\,(f_0 t + (f_1 - f_0)\,t^2 / 2T)$

    Args:
        start_hz: frequency at the start.
        stop_hz: frequency at the end.
        duration_s: length, in s.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample, or a frequency at or above half the update rate.
    Source: reference study, row S2.
    Example:
        >>> linear_chirp(0.1, 10.0, 10.0, 100.0).shape
        (1000,)
    """
    if not 0.0 <= min(start_hz, stop_hz) <= max(start_hz, stop_hz) < 0.5 * rate_hz:
        raise InputError(
            f"Chirp {start_hz:g} to {stop_hz:g} Hz needs frequencies in [0, {0.5 * rate_hz:g}) Hz. "
            "Lower them or raise the update rate."
        )
    time_s = np.arange(_count(duration_s, rate_hz)) / rate_hz
    sweep_hz_s = (stop_hz - start_hz) / duration_s
    return np.sin(2.0 * np.pi * (start_hz * time_s + 0.5 * sweep_hz_s * time_s**2))


@checked
def square(frequency_hz: float, duration_s: float, rate_hz: float) -> NDArray[np.float64]:
    """Create a square wave of plus and minus one, plus first: signs for alternating polarity.

    Args:
        frequency_hz: frequency of one plus and one minus.
        duration_s: length, in s.
        rate_hz: updates per second.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample, or a frequency above half the update rate.
    Example:
        >>> square(25.0, 0.06, 100.0)
        array([ 1.,  1., -1., -1.,  1.,  1.])
    """
    if not 0.0 < frequency_hz <= 0.5 * rate_hz:
        raise InputError(
            f"A square wave of {frequency_hz:g} Hz must have a frequency in (0, {0.5 * rate_hz:g}] "
            "Hz. Lower it or raise the update rate."
        )
    halves = np.arange(_count(duration_s, rate_hz)) * (2.0 * frequency_hz / rate_hz)
    return np.where(np.floor(halves + 1e-9) % 2 == 0, 1.0, -1.0)


@checked
def prbs(
    bit_s: float, duration_s: float, rate_hz: float, register_start: int = 1
) -> NDArray[np.float64]:
    """Create a pseudo-random binary sequence of plus and minus one, by a maximal shift register.

    Args:
        bit_s: shortest time between two changes, in s; a whole number of updates is used.
        duration_s: length, in s; the shortest register that does not repeat is used.
        rate_hz: updates per second.
        register_start: content of the register at the start, above zero.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample, a bit shorter than an update, more bits than the longest register.
    Source: Ljung, System Identification, 2nd ed., sec. 13.3.
    Example:
        >>> bits = prbs(0.01, 0.31, 100.0)
        >>> bits.size, int(bits.sum())
        (31, 1)
    """
    count = _count(duration_s, rate_hz)
    held = round(bit_s * rate_hz)
    bits = -(-count // held) if held >= 1 else 0
    length = next((n for n in _TAPS if 2**n - 1 >= bits), 0)
    if bits == 0 or length == 0 or register_start % (1 << length) == 0:
        raise InputError(
            f"Bits of {bit_s:g} s over {duration_s:g} s from start {register_start}: bits must be "
            f"{1.0 / rate_hz:g} s or longer, at most 65535 of them, and the start must not be 0 in "
            "the register. Change bit_s."
        )
    register = register_start % (1 << length)
    signs = np.empty(bits)
    for k in range(bits):
        signs[k] = 1.0 if register & 1 else -1.0
        new = 0
        for tap in _TAPS[length]:
            new ^= register >> (length - tap)
        register = (register >> 1) | ((new & 1) << (length - 1))
    return np.repeat(signs, held)[:count]


@checked
def multisine(
    frequencies_hz: ArrayLike,
    duration_s: float,
    rate_hz: float,
    power: ArrayLike = 1.0,
    trials: int = 32,
) -> NDArray[np.float64]:
    r"""Create a sum of sines of peak one, with phases for a low crest factor.

    $x = \sum_k \sqrt{2 P_k} \cos(2\pi f_k t + \varphi_k)$; Schroeder's phases are tried, then
    random ones, and the lowest peak is kept.

    Args:
        frequencies_hz: lines, in Hz. Shape `(K,)`.
        duration_s: length, in s; lines at multiples of its inverse make it periodic.
        rate_hz: updates per second.
        power: of each line, any scale. Shape `(K,)` or one value for all.
        trials: number of random sets of phases.
    Returns:
        Samples, shape `(round(duration_s * rate_hz),)`.
    Raises:
        InputError: no sample, a line at or above half the update rate, no power.
    Source: Schroeder, IEEE Trans. Inf. Theory 16 (1970), 85.
    Example:
        >>> x = multisine([0.5, 1.0, 1.5, 2.0], 2.0, 100.0)
        >>> float(np.abs(x).max()), bool(np.std(x) > 0.5)
        (1.0, True)
    """
    lines_hz = np.atleast_1d(np.asarray(frequencies_hz, dtype=np.float64))
    share = np.asarray(power, dtype=np.float64)
    if share.shape not in ((), lines_hz.shape):
        raise InputError(
            f"power has shape {share.shape} for {lines_hz.size} lines. Give one value for each, or "
            "one for all."
        )
    share = np.broadcast_to(share, lines_hz.shape)
    inside = (lines_hz > 0.0) & (lines_hz < 0.5 * rate_hz)
    if not inside.all() or not (share >= 0.0).all() or not share.sum() > 0.0:
        raise InputError(
            f"A multisine must have lines in (0, {0.5 * rate_hz:g}) Hz and powers of 0 or more, "
            "some above 0. Lower the lines or raise the update rate."
        )
    share = share / share.sum()
    angle = 2.0 * np.pi * np.outer(np.arange(_count(duration_s, rate_hz)) / rate_hz, lines_hz)
    before = np.concatenate([[0.0], np.cumsum(share)[:-1]])
    schroeder = -2.0 * np.pi * np.cumsum(before)
    rng = np.random.default_rng(0)
    phases = [schroeder, *(rng.uniform(0.0, 2.0 * np.pi, lines_hz.size) for _ in range(trials))]
    sums = (np.cos(angle + phase) @ np.sqrt(share) for phase in phases)
    best = min(sums, key=lambda x: float(np.abs(x).max() / x.std()))
    return np.asarray(best / np.abs(best).max())
