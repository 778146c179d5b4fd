"""Local models of a spectrum: response and leakage are smooth about each line, noise is not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.identify.local_fit import Problem, solve, start_denominators, tune_denominators
from haselab.identify.response_lines import EXCITED, Lines

__all__ = ["Spectrum", "local_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
# Denominator of each window, its covariance, and the numbers that were searched in the window.
_Choice = tuple[Complexes, Complexes, NDArray[np.int_]]
_HALF_WINDOW = {"rational": 16, "polynomial": 6}
_ORDER = 2
_CHUNK = 2048
# Windows of pure noise lose a fifth of their misfit to a denominator, by chance.
_WORTH_TUNING = 1.1
_RESONANT = 4.0
_REACH = 8.0
# What a searched denominator must gain in 2 R ln(misfit): its 4 numbers by BIC, and the best of
# several optima is taken, which counts like 2 more.
_PENALTY = 6.0
# A line is left out when its variance is 1,000 times that of the plain ratio: the input there is
# itself leakage, and cannot be told from that of the output.
_BLIND = 1e3


@dataclass(frozen=True)
class Spectrum:
    """Spectra of one record on the lines above zero and below half the rate.

    Args:
        frequency_hz: frequencies, in Hz, multiples of the first. Shape `(M,)`.
        u: spectrum of the input. Shape `(M,)`.
        y: spectrum of the output. Shape `(M,)`.
    """

    frequency_hz: Floats
    u: Complexes
    y: Complexes


@dataclass(frozen=True)
class _Windows:
    """Lines about each wanted line, the records one after another.

    Args:
        place: distance from the wanted line, in half windows. Shape `(K, R)`.
        u: spectrum of the input. Shape `(K, R)`.
        y: spectrum of the output. Shape `(K, R)`.
        record: number of the record of each row. Shape `(R,)`.
    """

    place: Floats
    u: Complexes
    y: Complexes
    record: NDArray[np.intp]


def local_response(spectra: Sequence[Spectrum], method: str) -> Lines:
    r"""Least squares of $Y(k+r) = [N(r)\,U(k+r) + T(r)]/D(r)$ about each line.

    The lines are those of the longest record.

    N, T and D are of second order, T of each record its own. `polynomial` has $D = 1$. `rational`
    has the denominator that the window itself tells; where it tells none beyond noise, that of
    the resonance beside it, or none.

    Args:
        spectra: one a record, all of one system.
        method: "rational" or "polynomial".
    Returns:
        The lines where the input has 5 % or more of its largest spectrum and is told from leakage.
    Source: Pintelon and Schoukens, System Identification (2012), chapter 7; McKelvey and Guerin,
        SYSID 2012, for the rational form.
    """
    longest = max(spectra, key=lambda spectrum: spectrum.u.size)
    half = min(_HALF_WINDOW[method], longest.u.size // 2 - 1)
    half_hz = half * float(longest.frequency_hz[0])
    energy = _energy(spectra, longest.frequency_hz)
    wanted_hz = longest.frequency_hz[energy >= EXCITED**2 * energy.max()]
    chunks = [wanted_hz[k : k + _CHUNK] for k in range(0, wanted_hz.size, _CHUNK)]
    told: list[_Told] = []
    resonances: list[_Resonance] = []
    if method == "rational":
        for chunk_hz in chunks:
            told.append(_told(_problem(_windows(spectra, chunk_hz, half_hz))))
            resonances += _resonances(told[-1], chunk_hz, half_hz)
    parts = []
    for k, chunk_hz in enumerate(chunks):
        problem = _problem(_windows(spectra, chunk_hz, half_hz))
        chosen = _none(chunk_hz.size)
        if method == "rational":
            chosen = _chosen(problem, chunk_hz, half_hz, told[k], resonances)
        parts.append(_lines(problem, chunk_hz, chosen))
    frequency_hz, response, coherence, std = map(np.concatenate, zip(*parts, strict=True))
    return Lines(frequency_hz, response, coherence, std, np.full(std.size, np.nan))


def _energy(spectra: Sequence[Spectrum], frequency_hz: Floats) -> Floats:
    """Energy of the input on the nearest line of each record, summed."""
    total = np.zeros(frequency_hz.size)
    for spectrum in spectra:
        nearest = np.rint(frequency_hz / spectrum.frequency_hz[0]).astype(np.intp) - 1
        inside = (nearest >= 0) & (nearest < spectrum.u.size)
        total[inside] += np.abs(spectrum.u[nearest[inside]]) ** 2
    return total


def _windows(spectra: Sequence[Spectrum], wanted_hz: Floats, half_hz: float) -> _Windows:
    """The neighbours of a low line include negative frequencies, the conjugates; zero is left out,
    for the offset sits there. At the upper end the window is shifted inwards.
    """
    places, us, ys, owners = [], [], [], []
    for owner, spectrum in enumerate(spectra):
        step_hz = float(spectrum.frequency_hz[0])
        half = min(max(_ORDER, round(half_hz / step_hz)), spectrum.u.size // 2 - 1)
        below = slice(half - 1, None, -1)
        both_hz = np.concatenate([-spectrum.frequency_hz[below], spectrum.frequency_hz])
        nearest = np.rint(wanted_hz / step_hz).astype(np.intp) - 1
        start = np.clip(nearest, 0, both_hz.size - 2 * half - 1)
        window = start[:, None] + np.arange(2 * half + 1)[None, :]
        places.append((both_hz[window] - wanted_hz[:, None]) / half_hz)
        us.append(np.concatenate([spectrum.u[below].conj(), spectrum.u])[window])
        ys.append(np.concatenate([spectrum.y[below].conj(), spectrum.y])[window])
        owners.append(np.full(window.shape[1], owner))
    return _Windows(np.hstack(places), np.hstack(us), np.hstack(ys), np.concatenate(owners))


def _problem(windows: _Windows) -> Problem:
    powers = windows.place[:, :, None] ** np.arange(_ORDER + 1)
    own = windows.record[:, None] == np.arange(int(windows.record[-1]) + 1)
    columns = [powers * windows.u[:, :, None]]
    columns += [powers * own[None, :, k, None] for k in range(own.shape[1])]
    slopes = powers[:, :, 1:].astype(np.complex128)
    return Problem(np.concatenate(columns, axis=2), slopes, windows.y)


@dataclass(frozen=True)
class _Resonance:
    """A denominator that one window tells beyond doubt, about its own line.

    Args:
        frequency_hz: of the line, in Hz.
        d: numbers of the denominator. Shape `(2,)`.
        covariance: of `d`. Shape `(2, 2)`.
    """

    frequency_hz: float
    d: Complexes
    covariance: Complexes

    def about(self, wanted_hz: Floats, half_hz: float) -> tuple[Complexes, Complexes]:
        """The same denominator about other lines, and its covariance. `(K, 2)`, `(K, 2, 2)`."""
        shift = (wanted_hz - self.frequency_hz) / half_hz
        first, second = self.d
        middle = 1.0 + first * shift + second * shift**2
        middle = np.where(np.abs(middle) < 1e-12, 1e-12, middle)
        moved = np.stack([first + 2.0 * second * shift, np.full(shift.size, second)], axis=1)
        moved = np.asarray(moved, dtype=np.complex128) / middle[:, None]
        lift = np.stack([shift, shift**2], axis=1)
        slope = -moved[:, :, None] * lift[:, None, :]
        slope[:, 0, 0] += 1.0
        slope[:, 0, 1] += 2.0 * shift
        slope[:, 1, 1] += 1.0
        slope = slope / middle[:, None, None]
        covariance = slope @ self.covariance @ slope.conj().transpose(0, 2, 1)
        return moved, np.asarray(covariance, dtype=np.complex128)


@dataclass(frozen=True)
class _Told:
    """What the windows tell of their own denominators.

    Args:
        d: numbers of the denominators. Shape `(K, 2)`.
        covariance: of `d`. Shape `(K, 2, 2)`.
        cost: sum of the squared misfits. Shape `(K,)`.
        plain: the same without a denominator. Shape `(K,)`.
    """

    d: Complexes
    covariance: Complexes
    cost: Floats
    plain: Floats


def _told(problem: Problem) -> _Told:
    rows, factors = problem.linear.shape[1:]
    plain = solve(problem, np.zeros((problem.y.shape[0], _ORDER), dtype=np.complex128)).cost
    d = start_denominators(problem)
    solved = solve(problem, d)
    worth = plain > _WORTH_TUNING * solved.cost
    if worth.any():
        d[worth] = tune_denominators(problem.at(worth), d[worth])
        solved = solve(problem, d)
    variance = solved.cost / (rows - factors - _ORDER)
    covariance = np.linalg.pinv(solved.information, hermitian=True) * variance[:, None, None]
    return _Told(d, covariance, solved.cost, plain)


def _resonances(told: _Told, wanted_hz: Floats, half_hz: float) -> list[_Resonance]:
    """Denominators where they explain most, one within each half window."""
    gain = told.plain / np.maximum(told.cost, 1e-300)
    found = []
    for k in np.flatnonzero(gain > _RESONANT):
        near = np.abs(wanted_hz - wanted_hz[k]) <= half_hz
        if gain[k] >= gain[near].max():
            found.append(_Resonance(float(wanted_hz[k]), told.d[k], told.covariance[k]))
    return found


def _none(count: int) -> _Choice:
    return (
        np.zeros((count, _ORDER), dtype=np.complex128),
        np.zeros((count, _ORDER, _ORDER), dtype=np.complex128),
        np.zeros(count, dtype=np.int_),
    )


def _chosen(
    problem: Problem,
    wanted_hz: Floats,
    half_hz: float,
    told: _Told,
    resonances: Sequence[_Resonance],
) -> _Choice:
    """Denominator of each window, its covariance, and the numbers searched in the window."""
    rows = problem.y.shape[1]
    best, covariance, searched = _none(wanted_hz.size)
    least = told.plain.copy()
    for resonance in resonances:
        near = np.flatnonzero(np.abs(wanted_hz - resonance.frequency_hz) <= _REACH * half_hz)
        d, spread = resonance.about(wanted_hz[near], half_hz)
        cost = solve(problem.at(near), d).cost
        better = cost < least[near]
        at = near[better]
        best[at], covariance[at], least[at] = d[better], spread[better], cost[better]
    limit = math.exp(_PENALTY * math.log(2.0 * rows) / (2.0 * rows))
    own = least > limit * told.cost
    best[own], covariance[own], searched[own] = told.d[own], told.covariance[own], _ORDER
    return best, covariance, searched


def _lines(
    problem: Problem, wanted_hz: Floats, chosen: _Choice
) -> tuple[Floats, Complexes, Floats, Floats]:
    """Frequencies, responses, coherence and deviations."""
    d, covariance, searched = chosen
    rows, factors = problem.linear.shape[1:]
    solved = solve(problem, d)
    noise = solved.cost / (rows - factors - searched)
    energy = (np.abs(problem.linear[:, :, 0]) ** 2).sum(axis=1)
    power = np.abs(solved.first) ** 2 * energy / rows
    coherence = power / np.maximum(power + noise, 1e-300)
    by_d = solved.by_d[:, None, :]
    inherited = (by_d @ covariance @ by_d.conj().transpose(0, 2, 1))[:, 0, 0].real
    kept = solved.spread * energy <= _BLIND
    std = np.sqrt(noise * solved.spread + np.maximum(inherited, 0.0))
    return wanted_hz[kept], solved.first[kept], coherence[kept], std[kept]
