"""Poles of the rational function that fits the spectra, for many delays at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from haselab.identify.record import Record

__all__ = ["Lines", "lines_of", "rational_poles"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_REFINEMENTS = 4  # weighted by the denominator of the round before
_INSTRUMENTS = 3  # rounds in which the modelled output replaces the measured one
_MAX_LINES = 400

_CHUNK = 16  # delays computed at once


@dataclass(frozen=True)
class Lines:
    """One record on an even grid, and the spectral lines that contain its energy.

    Args:
        record: the experiment.
        grid_s: even times of the output, in s. Shape `(N,)`.
        y: spectrum of the output at the lines. Shape `(L,)`.
        picked: indices of the lines, counted from the first above 0 Hz. Shape `(L,)`.
    """

    record: Record
    grid_s: Floats
    y: Complexes
    picked: NDArray[np.intp]

    @property
    def step_s(self) -> float:
        """Time between two outputs, in s."""
        return float(self.grid_s[1] - self.grid_s[0])

    @property
    def s(self) -> Complexes:
        """Complex angular frequencies of the lines, in rad/s. Shape `(L,)`."""
        return np.asarray(2j * np.pi * (self.picked + 1) / (self.step_s * self.grid_s.size))

    def input_at(self, delay_s: float) -> Floats:
        """Held and delayed input at the middle of each output's interval. Shape `(N,)`."""
        return _input_at(self.record, self.grid_s + 0.5 * self.step_s - delay_s)

    def inputs(self, delays_s: Floats) -> Complexes:
        """Spectra of the input for each delay. Shape `(D, L)`."""
        late = np.array([self.input_at(float(delay_s)) for delay_s in delays_s])
        half = np.exp(-0.5 * self.s * self.step_s)
        return np.asarray(rfft(late, axis=1)[:, 1:][:, self.picked] * half)


def _input_at(record: Record, times_s: Floats) -> Floats:
    index = np.floor(times_s * record.input_rate_hz).astype(np.intp)
    held = record.u[np.clip(index, 0, record.u.size - 1)]
    held[index < 0] = record.input_before or 0.0
    return held


def lines_of(record: Record, share: float, most: int = _MAX_LINES) -> Lines:
    """Lines of the band that contains `share` of the output's energy.

    Of more than `most` lines, half are the strongest ones and the others evenly spaced.
    """
    times_s = record.output_time_s
    step_s = float(times_s[-1] - times_s[0]) / (times_s.size - 1)
    grid_s = times_s[0] + step_s * np.arange(times_s.size)
    even = float(np.abs(grid_s - times_s).max()) < 1e-3 * step_s
    y = record.y if even else np.interp(grid_s, times_s, record.y)
    y_hat, u_hat = rfft(y)[1:], rfft(_input_at(record, grid_s + 0.5 * step_s))[1:]
    energy = np.cumsum(y_hat.real**2 + y_hat.imag**2)
    reach = np.cumsum(u_hat.real**2 + u_hat.imag**2)
    inside = int(np.searchsorted(energy, share * energy[-1])) + 1
    excited = int(np.searchsorted(reach, share * reach[-1]))
    count = min(max(12, 3 * inside, excited), y_hat.size)
    picked = np.arange(count)
    if count > most:
        strong = np.argsort(np.abs(y_hat[:count]))[-(most // 2) :]
        even_lines = np.rint(np.linspace(0, count - 1, most // 2)).astype(np.intp)
        picked = np.unique(np.concatenate([strong, even_lines]))
    return Lines(record, grid_s, y_hat[picked], picked)


def rational_poles(
    records: Sequence[Lines], order: int, zeros: int, delays_s: Floats, *, refined: bool
) -> Complexes:
    """Poles of the rational function that fits the spectra at each delay, made stable.

    Args:
        records: lines of each experiment; each has its own transient.
        order: poles.
        zeros: zeros, at most as many.
        delays_s: delays, in s. Shape `(D,)`.
        refined: whether to refine by instrumental variables, which are not biased by noise.
    Returns:
        Poles, in rad/s. Shape `(1, D, order)`; `(2, D, order)` where refined, before and after.
    Source: Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963), 56; transients after
        Pintelon and Schoukens, System Identification (2012), chapter 6; the last rounds are
        refined instrumental variables, Young and Jakeman, Int. J. Control 29 (1979), 1.
    """
    parts = [
        _poles_of_chunk(records, order, zeros, delays_s[k : k + _CHUNK], refined)
        for k in range(0, delays_s.size, _CHUNK)
    ]
    return np.concatenate(parts, axis=1)


def _poles_of_chunk(
    records: Sequence[Lines], order: int, zeros: int, delays_s: Floats, refined: bool
) -> Complexes:
    scale = max(float(np.abs(r.s).max()) for r in records) / 3.0
    lines = sum(r.s.size for r in records)
    top = zeros + 1
    count = order + top + order * len(records)
    y = np.concatenate([r.y for r in records])
    powers = (np.concatenate([r.s for r in records]) / scale)[:, None] ** np.arange(order + 1)
    u = np.concatenate([r.inputs(delays_s) for r in records], axis=1)
    matrix = np.zeros((delays_s.size, lines, count), np.complex128)
    matrix[:, :, :order] = -powers[:, :order] * y[:, None]
    matrix[:, :, order : order + top] = powers[:, :top] * u[:, :, None]
    at = 0
    for i, r in enumerate(records):
        first, rows = order + top + order * i, slice(at, at + r.s.size)
        largest = float(np.abs(r.y).max()) or 1.0
        matrix[:, rows, first : first + order] = powers[rows, :order] * largest
        at += r.s.size
    size = np.sqrt((matrix.real**2 + matrix.imag**2).sum(axis=1)) + 1e-300
    matrix /= size[:, None, :]
    target = powers[:, order] * y
    square = np.broadcast_to((1.0 + np.abs(powers[:, 1]) ** 2) ** order, u.shape)
    instrument = matrix
    ridge = 1e-12 * np.eye(count)
    rounds = _REFINEMENTS + _INSTRUMENTS * refined
    kept: list[Floats] = []
    for k in range(rounds):
        weighted = np.conj(instrument) / square[:, :, None]
        gram = np.matmul(weighted.transpose(0, 2, 1), matrix).real
        right = np.matmul(weighted.transpose(0, 2, 1), target).real
        level = np.trace(gram, axis1=1, axis2=2) / count
        level = np.where(level > 0.0, level, 1.0)
        gram = gram + level[:, None, None] * ridge
        factors = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
        bottom = np.concatenate(
            [factors[:, :order] / size[:, :order], np.ones((delays_s.size, 1))], axis=1
        )
        # The magnitude of the denominator does not change when its roots are mirrored to the left,
        # so their stability does not matter here.
        shown = bottom @ powers.T
        square = np.maximum(shown.real**2 + shown.imag**2, 1e-18)
        if k in (_REFINEMENTS - 1, rounds - 1):
            kept.append(bottom)
        if refined and k >= _REFINEMENTS - 1:
            modelled = np.matmul(matrix[:, :, order:], factors[:, order:, None])[:, :, 0] / shown
            instrument = matrix.copy()
            instrument[:, :, :order] = (
                -powers[:, :order] * modelled[:, :, None] / size[:, None, :order]
            )
    return np.array([_stable_roots(bottom, order) * scale for bottom in kept])


def _stable_roots(bottom: Floats, order: int) -> Complexes:
    """Roots of polynomials of rising powers, mirrored to the left. Shape `(D, order)`."""
    companion = np.zeros((bottom.shape[0], order, order))
    companion[:, np.arange(1, order), np.arange(order - 1)] = 1.0
    finite = np.asarray(np.isfinite(bottom).all(axis=1))
    companion[:, :, -1] = -np.where(finite[:, None], bottom, 1.0)[:, :-1]
    roots = np.linalg.eigvals(companion)
    stable = -np.abs(roots.real) - 1e-4 * np.abs(roots) - 1e-9 + 1j * roots.imag
    return np.asarray(stable, dtype=np.complex128)
