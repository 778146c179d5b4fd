"""A sampled loop about an equilibrium: how well it rejects a load, and how robust it is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import ResultError

__all__ = [
    "UNSTABLE",
    "Demands",
    "LinearLoop",
    "penalty",
    "refuse_missed",
    "sensitivity_of",
    "shares_of",
    "squared_error",
    "timed_error",
]

Floats = NDArray[np.float64]
_GRID = 120
_DOUBLINGS, _GONE = 24, 1e-12
UNSTABLE = 1e60
_STRICT = 20.0  # by 1 % missed, the cost rises by a fifth
_STEEP, _FARTHEST = 120.0, 1e7  # exponent up to which it does; factor at most from there on
_MISSED = 1.05  # of a demand, by parameters that are still used


@dataclass(frozen=True)
class LinearLoop:
    """A closed loop with one state vector for actuator and controller.

    Args:
        a: from one update to the next. Shape `(n, n)`.
        load: change of the state by a force of 1 N that acts on. Shape `(n,)`.
        noise: by an error of the sensed length of 1 m. Shape `(n,)`.
        added: by a unit that is added to the drive on its way to the actuator. Shape `(n,)`.
        length: of the state, in m. Shape `(n,)`.
        drive: computed from the state, in units of `added`. Shape `(n,)`.
        drive_noise: computed drive by the error of the sensed length, in the same update.
    """

    a: Floats
    load: Floats
    noise: Floats
    added: Floats
    length: Floats
    drive: Floats
    drive_noise: float


@dataclass(frozen=True)
class Demands:
    """What a loop must keep.

    Args:
        noise_m: standard deviation of one sensed length.
        shaken: highest standard deviation of the drive, by noise; infinite: any.
        peak_sensitivity: highest.
        moved: standard deviation of the length by noise, over that of one sensed length.
        changed: highest standard deviation of the drive's change in one update; infinite: any.
    """

    noise_m: float
    shaken: float
    peak_sensitivity: float = 1.8
    moved: float = 1.2
    changed: float = math.inf


def penalty(loop: LinearLoop, period_s: float, demands: Demands, missed: float = 0.0) -> float:
    """Factor on the cost of a loop: 1 if it keeps its demands, more by what it misses.

    Args:
        loop: closed.
        period_s: of an update.
        demands: of it.
        missed: by which a demand of the caller is missed, relative to it.
    Returns:
        At least 1; more than `UNSTABLE` for an unstable loop.
    """
    size = float(np.abs(np.linalg.eigvals(loop.a)).max())
    if not size < 1.0 - 1e-6:
        return 2.0 * UNSTABLE * size
    shares = shares_of(loop, period_s, demands).values()
    strict = _STRICT * (missed + sum(max(share - 1.0, 0.0) for share in shares))
    # far off it still rises, so that a search finds its way back, but never to UNSTABLE
    return math.exp(min(strict, _STEEP)) * min(max(strict / _STEEP, 1.0), _FARTHEST)


def shares_of(loop: LinearLoop, period_s: float, demands: Demands) -> dict[str, float]:
    """What a stable loop takes of each demand: above 1 it misses the demand.

    Args:
        loop: closed and stable.
        period_s: of an update.
        demands: of it.
    Returns:
        By the name of the demand, for messages.
    """
    a, direct = loop.a, loop.drive_noise
    noise = _gramian(a, loop.noise)
    moved = math.sqrt(_squares(noise, loop.length))
    shaken = math.hypot(math.sqrt(_squares(noise, loop.drive)), direct)
    first = float(loop.drive @ loop.noise) - direct
    later = _squares(noise, loop.drive @ a - loop.drive)
    changed = math.sqrt(direct * direct + first * first + later)
    return {
        "the peak sensitivity": float(np.abs(sensitivity_of(loop, period_s)[1]).max())
        / demands.peak_sensitivity,
        "the noise of the length": moved / demands.moved,
        "the noise of the drive": shaken * demands.noise_m / demands.shaken,
        "the change of the drive by noise": changed * demands.noise_m / demands.changed,
    }


def refuse_missed(
    found: Iterable[Mapping[str, float]], what: str, period_s: float, instead: str
) -> None:
    """Refuse parameters with which a loop misses a demand: the search found none that keep all.

    Args:
        found: of each loop, see `shares_of`.
        what: was searched, for the message.
        period_s: of an update.
        instead: what the user can do, for the message.
    Raises:
        ResultError: A demand is missed by more than 5 %.
    """
    share, name = max((share, name) for shares in found for name, share in shares.items())
    if share > _MISSED:
        raise ResultError(
            f"No {what} meet all demands with updates of {period_s:g} s: with the best ones found, "
            f"{name} is {share:.3g} times its limit. {instead}"
        )


def squared_error(loop: LinearLoop, period_s: float) -> float:
    """Root of the integral of the squared length after a load step of 1 N, in m s^0.5.

    Args:
        loop: closed and stable.
        period_s: of an update.
    """
    # a lasting load moves the loop to a new rest, in which the length is 0 again
    rest = np.asarray(np.linalg.solve(np.eye(loop.a.shape[0]) - loop.a, loop.load))
    return math.sqrt(_squares(_gramian(loop.a, rest), loop.length) * period_s)


def timed_error(loop: LinearLoop, period_s: float, for_s: float) -> float:
    """Root of the integral of time times the squared length after a load step of 1 N, in m s.

    A length that comes back late counts more than in `squared_error`.

    Args:
        loop: closed.
        period_s: of an update.
        for_s: how long it counts.
    """
    state, total = np.zeros(loop.load.size), 0.0
    for k in range(1, round(for_s / period_s) + 1):
        state = loop.a @ state + loop.load
        total += k * float(loop.length @ state) ** 2
    return math.sqrt(total) * period_s


def sensitivity_of(loop: LinearLoop, period_s: float) -> tuple[Floats, NDArray[np.complex128]]:
    """Response of the drive that acts to what is added to it.

    Args:
        loop: closed.
        period_s: of an update.
    Returns:
        Frequencies in rad/s, up to half the rate of the updates, and the sensitivity there.
    """
    omega = np.geomspace(1.0, math.pi / period_s, _GRID)
    z = np.exp(1j * omega * period_s)[:, None, None]
    into = np.broadcast_to(loop.added[:, None], (_GRID, loop.added.size, 1))
    states = np.linalg.solve(z * np.eye(loop.added.size) - loop.a, into)[:, :, 0]
    return np.asarray(omega), np.asarray(1.0 + states @ loop.drive)


def _gramian(a: Floats, start: Floats) -> Floats:
    """Sum over all steps of the outer square of the state after a start, by Smith's doubling."""
    total, power = np.outer(start, start), a
    for _ in range(_DOUBLINGS):
        total = total + power @ total @ power.T
        power = power @ power
        if np.abs(power).max() < _GONE:
            break
    return total


def _squares(gramian: Floats, row: Floats) -> float:
    """Sum over all steps of the squared output of a row of the state."""
    return max(float(row @ gramian @ row), 0.0)
