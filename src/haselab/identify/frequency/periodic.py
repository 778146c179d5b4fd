"""Frequency response of a periodic drive: averaged periods, noise between the harmonics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from haselab.base import InputError
from haselab.identify.frequency.lines import EXCITED, Lines, Pair, hold_spectrum
from haselab.identify.frequency.local_models import harmonic_leakage

__all__ = ["periodic_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_REPEATS = 0.1  # largest share of the input's power that may differ between periods
_SAME = 0.1
_DISTORTED_P = 1e-3
_DISTORTED = 1.5
_DEGREES = 20


@dataclass(frozen=True)
class _Realisation:
    """One record at the excited lines: input of a period, response, its variance, coherence."""

    u: Complexes
    response: Complexes
    variance: Floats
    coherence: Floats


def periodic_response(pairs: Sequence[Pair], rate_hz: float, period_s: float, held: bool) -> Lines:
    r"""Mean response over whole periods; several records with different phases give the distortion.

    $\hat G = (Y - T)/U$ on the lines of the period. The lines between them, which the input does
    not excite, give the transient T and the variance of the noise, so no settling is needed. The
    spread between records of different drives, minus the noise, is the level of nonlinear
    distortion.

    Args:
        pairs: records of two whole periods or more; an incomplete period is left out at
            the start.
        rate_hz: sampling rate, in Hz.
        period_s: period, in s; a whole number of samples.
        held: whether the hold of the input is corrected for.
    Returns:
        Lines that every record excites with 5 % or more of its largest spectrum.
    Raises:
        InputError: a period that is not a whole number of samples, fewer than two periods, an input
            that does not repeat, records without a common line.
    Source: Pintelon and Schoukens, System Identification (2012), chapters 2 and 4.
    """
    size = _samples(rate_hz, period_s)
    wholes = [_whole(pair, size, period_s) for pair in pairs]
    harmonics = np.arange(1, (size + 1) // 2)
    inputs = [np.fft.fft(u) for u, _ in wholes]
    means = np.array([np.abs(u[:: u.size // size][harmonics]) / (u.size // size) for u in inputs])
    loud = (means >= EXCITED * means.max(axis=1, keepdims=True)).all(axis=0)
    if not loud.any():
        raise InputError(
            f"{len(pairs)} records excite no common line of 1/{period_s:g} s; the drives "
            "must have the same lines. Give records of one drive."
        )
    frequency_hz = harmonics[loud] * rate_hz / size
    parts = [
        _realisation(u, np.fft.fft(y), harmonics[loud], y.size // size)
        for u, (_, y) in zip(inputs, wholes, strict=True)
    ]
    lines = _pooled(frequency_hz, parts)
    if not held:
        return lines
    hold = hold_spectrum(frequency_hz, rate_hz)
    size_of_hold = np.abs(hold)
    return Lines(
        frequency_hz, lines.response / hold, lines.coherence, lines.std / size_of_hold,
        lines.distortion_std / size_of_hold, lines.notes,
    )  # fmt: skip


def _samples(rate_hz: float, period_s: float) -> int:
    samples = period_s * rate_hz
    if not (math.isfinite(samples) and samples >= 8.0 and abs(samples - round(samples)) < 1e-3):
        raise InputError(
            f"period_s = {period_s:g} s is {samples:g} samples at {rate_hz:g} Hz; it must be a "
            "whole number of 8 or more. Change the period, or synchronise the sampling with the "
            "drive."
        )
    return round(samples)


def _whole(pair: Pair, size: int, period_s: float) -> Pair:
    """The whole periods of a record."""
    count = pair[0].size // size
    if count < 2:
        raise InputError(
            f"The record has {pair[0].size / size:.3g} periods of {period_s:g} s; it must have 2 "
            "or more. Record longer, or use the method rational."
        )
    u, y = (x[x.size - count * size :] for x in pair)
    blocks = u.reshape(count, size)
    spread = float(((blocks - blocks.mean(axis=0)) ** 2).sum() / (blocks**2).sum())
    if spread > _REPEATS:
        raise InputError(
            f"The input does not repeat every {period_s:g} s: {100.0 * spread:.0f} % of its power "
            f"differs between periods; at most {100.0 * _REPEATS:.0f} % may."
        )
    return u, y


def _realisation(
    u: Complexes, y: Complexes, harmonics: NDArray[np.intp], periods: int
) -> _Realisation:
    source, output = u[periods * harmonics], y[periods * harmonics]
    leakage = harmonic_leakage(u, y, output / source, harmonics, periods)
    response = (output - leakage.value) / source
    power = np.abs(response * source) ** 2
    # The power of all periods together is larger by their number, at the same noise.
    coherence = power / np.maximum(power + periods * leakage.noise, 1e-300)
    variance = (leakage.noise + leakage.variance) / np.abs(source) ** 2
    return _Realisation(source / periods, response, variance, coherence)


def _smooth(values: Floats, degrees: int) -> Floats:
    """Means of neighbouring lines, wide enough for 20 degrees of freedom each."""
    half = min(math.ceil((_DEGREES / degrees - 1.0) / 2.0), (values.size - 1) // 2)
    if half <= 0:
        return values
    total = np.concatenate([[0.0], np.cumsum(values)])
    start = np.clip(np.arange(values.size) - half, 0, values.size - 2 * half - 1)
    return np.asarray((total[start + 2 * half + 1] - total[start]) / (2 * half + 1))


def _pooled(frequency_hz: Floats, parts: Sequence[_Realisation]) -> Lines:
    """Mean of the records, weighted by their noise, with the spread between them."""
    weight = np.array([1.0 / np.maximum(part.variance, 1e-300) for part in parts])
    responses = np.array([part.response for part in parts])
    response = (weight * responses).sum(axis=0) / weight.sum(axis=0)
    coherence = np.mean([part.coherence for part in parts], axis=0)
    noise = np.mean([part.variance for part in parts], axis=0)
    variance, distortion = 1.0 / weight.sum(axis=0), np.full(frequency_hz.size, np.nan)
    notes: list[str] = []
    if len(parts) > 1 and _same_drive(parts):
        notes.append("All records have the same drive, so nonlinear distortion is not visible.")
    elif len(parts) > 1:
        degrees = 2 * (len(parts) - 1)
        spread = (np.abs(responses - response) ** 2).sum(axis=0) / (len(parts) - 1)
        power = np.mean([np.abs(part.u) ** 2 for part in parts], axis=0)
        spread = _smooth(spread * power, degrees) / power
        distortion = np.sqrt(np.maximum(spread - noise, 0.0))
        variance = np.maximum(variance, spread / len(parts))
        notes += _distortion_notes(spread, noise, degrees)
    return Lines(frequency_hz, response, coherence, np.sqrt(variance), distortion, tuple(notes))


def _same_drive(parts: Sequence[_Realisation]) -> bool:
    first = parts[0].u
    size = float(np.linalg.norm(first))
    return all(float(np.linalg.norm(part.u - first)) < _SAME * size for part in parts[1:])


def _distortion_notes(spread: Floats, noise: Floats, degrees: int) -> list[str]:
    """A note where the records differ by more than noise, over all lines."""
    ratio = float(np.median(spread / np.maximum(noise, 1e-300)))
    limit = float(fdtri(degrees * spread.size, _DEGREES * spread.size, 1.0 - _DISTORTED_P))
    if ratio <= max(limit, _DISTORTED):
        return []
    return [
        f"Nonlinear distortion: records of different drives differ {math.sqrt(ratio):.2g} times "
        "more than noise. The response is the best linear one for drives of this kind and size."
    ]
