"""Which denominator each window of a spectrum gets: its own, a neighbouring resonance's, none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.identify.local_fit import Problem, solve, start_denominators, tune_denominators

__all__ = ["Centres", "centres"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
# Denominator of each window, its covariance, and the numbers that were searched in the window.
_Choice = tuple[Complexes, Complexes, NDArray[np.int_]]
_ORDER = 2
_CHUNK = 2048
# Windows of pure noise lose a fifth of their misfit to a denominator, by chance.
_WORTH_TUNING = 1.1
_RESONANT = 4.0
_REACH = 8.0
# What a searched denominator must gain in 2 R ln(misfit): its 4 numbers by BIC, and the best of
# several optima is taken, which counts like 2 more.
_PENALTY = 6.0


@dataclass(frozen=True)
class Centres:
    """First factors of all windows, which are the values at their centres.

    Args:
        value: first factor. Shape `(K,)`.
        variance: of its complex error. Shape `(K,)`.
        noise: variance of the complex noise on a row. Shape `(K,)`.
        spread: variance of the value at unit noise and known denominator. Shape `(K,)`.
        energy: sum of the squares of the first column. Shape `(K,)`.
    """

    value: Complexes
    variance: Floats
    noise: Floats
    spread: Floats
    energy: Floats


def centres(
    windows: Callable[[Floats], Problem], wanted_hz: Floats, half_hz: float, *, rational: bool
) -> Centres:
    """Values at the centres of windows about the wanted frequencies.

    A window keeps the denominator that it tells itself; where it tells none beyond noise it gets
    that of a resonance beside it, if this explains it better than none.

    Args:
        windows: makes the windows about some frequencies, in Hz.
        wanted_hz: rising frequencies, in Hz. Shape `(K,)`.
        half_hz: half the width of a window, in Hz.
        rational: whether there are denominators at all.
    """
    chunks = [wanted_hz[k : k + _CHUNK] for k in range(0, wanted_hz.size, _CHUNK)]
    told: list[_Told] = []
    resonances: list[_Resonance] = []
    for chunk_hz in chunks if rational else ():
        told.append(_told(windows(chunk_hz)))
        resonances += _resonances(told[-1], chunk_hz, half_hz)
    parts = []
    for k, chunk_hz in enumerate(chunks):
        problem, choice = windows(chunk_hz), _none(chunk_hz.size)
        if rational:
            choice = _chosen(problem, chunk_hz, half_hz, told[k], resonances)
        parts.append(_values(problem, choice))
    return Centres(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _values(problem: Problem, choice: _Choice) -> tuple[Complexes, Floats, Floats, Floats, Floats]:
    """The fields of `Centres`."""
    d, covariance, searched = choice
    rows, factors = problem.linear.shape[1:]
    solved = solve(problem, d)
    noise = solved.cost / (rows - factors - searched)
    by_d = solved.by_d[:, None, :]
    inherited = (by_d @ covariance @ by_d.conj().transpose(0, 2, 1))[:, 0, 0].real
    variance = noise * solved.spread + np.maximum(inherited, 0.0)
    energy = (np.abs(problem.linear[:, :, 0]) ** 2).sum(axis=1)
    return solved.first, variance, noise, solved.spread, energy


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
