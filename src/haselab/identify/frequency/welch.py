"""Frequency response from averaged, windowed segments: H1, H2, Hv."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import rfft

from haselab.base import InputError
from haselab.identify.frequency.lines import EXCITED, Lines, Pair, hold_spectrum

__all__ = ["averaged_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_LEAST = 16
_SEGMENTS = 8
# Half-overlapping Hann segments are correlated by 1/6: 1/(1 + 2/36) of their number counts.
_INDEPENDENT = 36.0 / 38.0
_SHARED = 0.3
_TELLING = 6
_SWEEP = (
    "The input is like a single sweep (or step): each frequency is excited in few segments, and "
    "averaged segments are not suitable. Use the method rational, or fit a transfer function."
)
_ALONE = "One segment alone gives no coherence and no standard deviation. Use shorter segments."


def averaged_response(
    pairs: Sequence[Pair], rate_hz: float, method: str, held: bool, segment_s: float | None
) -> Lines:
    r"""Response from the spectra of Hann segments that overlap by half, pooled over all records.

    $H_1 = S_{uy}/S_{uu},\quad H_2 = S_{yy}/S_{yu},\quad H_v = \sqrt{H_1 H_2}$,
    $\mathrm{var}\,H/|H|^2 = (1 - \gamma^2)/(\gamma^2 (n - 1))$ for n independent segments.

    Args:
        pairs: records.
        rate_hz: sampling rate, in Hz.
        method: "h1" for noise on the output, "h2" on the input, "hv" equal shares on both.
        held: whether the hold of the input is corrected for.
        segment_s: length of a segment, in s; an eighth of the longest record when not given.
    Returns:
        Lines where the input has 5 % or more of its largest spectrum.
    Raises:
        InputError: segments longer than the shortest record, or of fewer than 16 samples.
    Source: Bendat and Piersol, Random Data (2010), chapters 6 and 9; Rocklin, Crowley and Vold,
        IMAC 1985, for Hv; Welch, IEEE Trans. Audio 15 (1967), 70, for the overlap.
    """
    size = _size(pairs, rate_hz, segment_s)
    u, y = (np.concatenate([_spectra(pair[i], size) for pair in pairs]) for i in (0, 1))
    input_power, output_power = _power(u), _power(y)
    cross = np.einsum("sk,sk->k", u.conj(), y)
    frequency_hz = np.arange(size // 2 + 1) * rate_hz / size
    kept = (input_power >= EXCITED**2 * input_power.max()) & (frequency_hz > 0.0)
    kept &= 2.0 * frequency_hz < rate_hz
    frequency_hz, cross = frequency_hz[kept], cross[kept]
    input_power, output_power = input_power[kept], np.maximum(output_power[kept], 1e-300)
    coherence = np.clip(np.abs(cross) ** 2 / (input_power * output_power), 1e-12, 1.0)
    response = cross / input_power
    if method != "h1":
        response = response / (coherence if method == "h2" else np.sqrt(coherence))
    alone = u.shape[0] == 1
    spare = _INDEPENDENT * u.shape[0] - 1.0
    std = np.abs(response) * np.sqrt((1.0 - coherence) / (coherence * abs(spare)))
    std = np.full(std.size, np.inf) if alone else std
    if held:
        hold = hold_spectrum(frequency_hz, rate_hz)
        response, std = response / hold, std / np.abs(hold)
    notes = [_SWEEP] if _is_sweep(pairs, u, size) else []
    notes += [_ALONE] if alone else []
    unknown = np.full(frequency_hz.size, np.nan)
    return Lines(frequency_hz, response, coherence, std, unknown, tuple(notes))


def _size(pairs: Sequence[Pair], rate_hz: float, segment_s: float | None) -> int:
    shortest, longest = (pick(u.size for u, _ in pairs) for pick in (min, max))
    if segment_s is None:
        return int(min(shortest, max(64, longest // _SEGMENTS)))
    size = round(segment_s * rate_hz) if np.isfinite(segment_s) else 0
    if not _LEAST <= size <= shortest:
        raise InputError(
            f"segment_s = {segment_s:g} s is {size} samples; it must be {_LEAST} to {shortest}, "
            "the length of the shortest record."
        )
    return size


def _spectra(x: Floats, size: int) -> Complexes:
    """Spectra of the segments, each with its mean subtracted. Shape `(S, size // 2 + 1)`."""
    segments = sliding_window_view(x, size)[:: max(1, size // 2)]
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)
    freed = segments - segments.mean(axis=1, keepdims=True)
    freed *= window
    return np.asarray(rfft(freed, axis=1))


def _power(spectra: Complexes) -> Floats:
    return np.asarray((spectra.real**2 + spectra.imag**2).sum(axis=0))


def _is_sweep(pairs: Sequence[Pair], spectra: Complexes, size: int) -> bool:
    """Whether a typical excited line is excited in few of the segments."""
    if spectra.shape[0] < _TELLING:
        shorter = max(_LEAST, min(size, min(u.size for u, _ in pairs) // _SEGMENTS))
        spectra = np.concatenate([_spectra(u, shorter) for u, _ in pairs])
    power = spectra.real**2 + spectra.imag**2
    total = power.sum(axis=0)
    loud = total >= EXCITED * total.max()
    sharing = total[loud] ** 2 / (power[:, loud] ** 2).sum(axis=0)
    return bool(np.median(sharing) < _SHARED * spectra.shape[0])
