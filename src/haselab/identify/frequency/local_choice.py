"""Choice of denominator for each window of a spectrum: its own, a neighbour's, or none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.identify.frequency.local_fit import (
    LocalProblem,
    solve,
    start_denominators,
    tune_denominators,
)

__all__ = ["Centres", "centres"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_ORDER = 2
_CHUNK = 2048
# Windows of pure noise lose a fifth of their misfit when a denominator is fitted.
_WORTH_TUNING = 1.1
_RESONANT = 4.0
_REACH = 8.0
# Gain in 2 R ln(misfit) required of a searched denominator: its 4 parameters by BIC; the best of
# several optima is taken, which counts as 2 more.
_PENALTY = 6.0


@dataclass(frozen=True)
class Centres:
    """First factors of all windows; these are the values at the window centres.

    Args:
        value: first factor. Shape `(K,)`.
        noise: variance of the complex noise on a row. Shape `(K,)`.
        spread: variance of the value at unit noise and known denominator. Shape `(K,)`.
        energy: sum of the squares of the first column. Shape `(K,)`.
        by_row: derivatives of the value with respect to the rows of its window. Shape `(K, R)`.
        lender: index of the window that the denominator comes from; its own index for none.
            Shape `(K,)`.
        by_lender: derivatives of the value with respect to the rows of that window. Shape `(K, R)`.
    """

    value: Complexes
    noise: Floats
    spread: Floats
    energy: Floats
    by_row: Complexes
    lender: NDArray[np.intp]
    by_lender: Complexes

    def widened(self, factor: Floats) -> Centres:
        """The same values with their std multiplied by a factor. Shape `(K,)`."""
        return replace(
            self,
            spread=self.spread * factor**2,
            by_row=self.by_row * factor[:, None],
            by_lender=self.by_lender * factor[:, None],
        )

    @property
    def variance(self) -> Floats:
        """Variance of the complex error of the values. Shape `(K,)`."""
        alone = self.lender == np.arange(self.lender.size)
        whole = self.by_row + np.where(alone[:, None], self.by_lender, 0.0)
        lent = np.where(alone, 0.0, (np.abs(self.by_lender) ** 2).sum(axis=1))
        own = (np.abs(whole) ** 2).sum(axis=1)
        return np.asarray(self.noise * own + self.noise[self.lender] * lent)


@dataclass(frozen=True)
class _Choice:
    """Denominator of each window and its origin.

    Args:
        d: coefficients of the denominator. Shape `(K, 2)`.
        by_lender: their derivatives with respect to the rows of window `lender`. Shape `(K, 2, R)`.
        lender: index of the window that determined them; its own index for none. Shape `(K,)`.
        searched: number of coefficients that were searched in the window itself. Shape `(K,)`.
    """

    d: Complexes
    by_lender: Complexes
    lender: NDArray[np.intp]
    searched: NDArray[np.int_]


def centres(
    windows: Callable[[Floats], LocalProblem], wanted_hz: Floats, half_hz: float, *, rational: bool
) -> Centres:
    """Values at the centres of windows around the requested frequencies.

    A window uses its own denominator if that is significant; otherwise it uses
    the denominator of a neighbouring resonance, if that fits better than none.

    Args:
        windows: builds the windows around given frequencies, in Hz.
        wanted_hz: rising frequencies, in Hz. Shape `(K,)`.
        half_hz: half the width of a window, in Hz.
        rational: whether denominators are fitted at all.
    """
    chunks = [slice(k, k + _CHUNK) for k in range(0, wanted_hz.size, _CHUNK)]
    estimated: list[_Estimated] = []
    resonances: list[_Resonance] = []
    for chunk in chunks if rational else ():
        estimated.append(_estimated(windows(wanted_hz[chunk])))
        resonances += _resonances(estimated[-1], wanted_hz[chunk], half_hz, chunk.start)
    parts = []
    for k, chunk in enumerate(chunks):
        problem = windows(wanted_hz[chunk])
        choice = _none(problem, chunk.start)
        if rational:
            choice = _chosen(problem, choice, wanted_hz[chunk], half_hz, estimated[k], resonances)
        parts.append(_values(problem, choice))
    return Centres(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _values(problem: LocalProblem, choice: _Choice) -> tuple[NDArray[Any], ...]:
    """The fields of `Centres`."""
    rows, factors = problem.linear.shape[1:]
    solved = solve(problem, choice.d)
    noise = solved.cost / (rows - factors - choice.searched)
    spread = (np.abs(solved.by_row) ** 2).sum(axis=1)
    energy = (np.abs(problem.linear[:, :, 0]) ** 2).sum(axis=1)
    by_lender = (solved.by_d[:, None, :] @ choice.by_lender)[:, 0]
    return solved.first, noise, spread, energy, solved.by_row, choice.lender, by_lender


@dataclass(frozen=True)
class _Resonance:
    """A denominator that one window determines significantly, relative to its own line.

    Args:
        window: index of the window.
        frequency_hz: of its line, in Hz.
        d: coefficients of the denominator. Shape `(2,)`.
        by_row: their derivatives with respect to the rows of the window. Shape `(2, R)`.
    """

    window: int
    frequency_hz: float
    d: Complexes
    by_row: Complexes

    def about(self, wanted_hz: Floats, half_hz: float) -> tuple[Complexes, Complexes]:
        """The denominator relative to other lines, and its derivatives. `(K, 2)`, `(K, 2, R)`."""
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
        return moved, np.asarray(slope / middle[:, None, None] @ self.by_row)


@dataclass(frozen=True)
class _Estimated:
    """Denominators estimated from each window alone.

    Args:
        d: coefficients of the denominators. Shape `(K, 2)`.
        by_row: their derivatives with respect to the rows. Shape `(K, 2, R)`.
        cost: sum of the squared misfits. Shape `(K,)`.
        plain: the same without a denominator. Shape `(K,)`.
    """

    d: Complexes
    by_row: Complexes
    cost: Floats
    plain: Floats


def _estimated(problem: LocalProblem) -> _Estimated:
    plain = solve(problem, np.zeros((problem.y.shape[0], _ORDER), dtype=np.complex128)).cost
    d = start_denominators(problem)
    solved = solve(problem, d)
    worth = plain > _WORTH_TUNING * solved.cost
    if worth.any():
        d[worth] = tune_denominators(problem.at(worth), d[worth])
        solved = solve(problem, d)
    dual = solved.slopes.conj().transpose(0, 2, 1)
    by_row = np.linalg.pinv(dual @ solved.slopes, hermitian=True) @ dual
    return _Estimated(d, np.asarray(by_row), solved.cost, plain)


def _resonances(
    estimated: _Estimated, wanted_hz: Floats, half_hz: float, start: int
) -> list[_Resonance]:
    """The most significant denominators, one within each half window."""
    gain = estimated.plain / np.maximum(estimated.cost, 1e-300)
    found = []
    for k in np.flatnonzero(gain > _RESONANT):
        near = np.abs(wanted_hz - wanted_hz[k]) <= half_hz
        if gain[k] >= gain[near].max():
            at_hz = float(wanted_hz[k])
            found.append(_Resonance(start + int(k), at_hz, estimated.d[k], estimated.by_row[k]))
    return found


def _none(problem: LocalProblem, start: int) -> _Choice:
    """The choice of no denominator in any window."""
    count, rows = problem.y.shape
    return _Choice(
        np.zeros((count, _ORDER), dtype=np.complex128),
        np.zeros((count, _ORDER, rows), dtype=np.complex128),
        start + np.arange(count),
        np.zeros(count, dtype=np.int_),
    )


def _chosen(
    problem: LocalProblem,
    choice: _Choice,
    wanted_hz: Floats,
    half_hz: float,
    estimated: _Estimated,
    resonances: Sequence[_Resonance],
) -> _Choice:
    """The best denominator; a window's own one only if its gain is significant."""
    rows, own_number = problem.y.shape[1], choice.lender.copy()
    d, by_lender, lender, searched = (
        choice.d.copy(), choice.by_lender.copy(), choice.lender.copy(), choice.searched.copy()
    )  # fmt: skip
    least = estimated.plain.copy()
    for resonance in resonances:
        near = np.flatnonzero(np.abs(wanted_hz - resonance.frequency_hz) <= _REACH * half_hz)
        moved, slope = resonance.about(wanted_hz[near], half_hz)
        cost = solve(problem.at(near), moved).cost
        better = cost < least[near]
        at = near[better]
        d[at], by_lender[at], least[at] = moved[better], slope[better], cost[better]
        lender[at] = resonance.window
    limit = math.exp(_PENALTY * math.log(2.0 * rows) / (2.0 * rows))
    own = least > limit * estimated.cost
    d[own], by_lender[own] = estimated.d[own], estimated.by_row[own]
    lender[own], searched[own] = own_number[own], _ORDER
    return _Choice(d, by_lender, lender, searched)
