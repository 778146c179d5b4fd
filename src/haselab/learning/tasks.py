"""What a policy is to do: reference and load of an episode."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.scoreboard.tasks.tracking import trapezoid

__all__ = ["TASKS", "LearningTask", "find_task"]

Floats = NDArray[np.float64]
_LONGEST_HOLD_S, _SHORTEST_HOLD_S = 2.0, 0.4
_CHANGES = 64  # of held values, which are drawn together: the first ones last 26 s or more
_SINES_HZ = (0.1, 3.0)
_GAITS_HZ = (0.5, 2.0)
_PULL = 0.05  # largest


@dataclass(frozen=True)
class LearningTask:
    """One task.

    Args:
        name: in the id of the environment.
        title: what it is.
        draw: reference and additional pull of one episode, from a random generator and the times
            of the updates. The reference goes from 0 to 1 over the strains that the device reaches,
            the pull is over the weight of the mass. Shapes `(T,)`.
    """

    name: str
    title: str
    draw: Callable[[np.random.Generator, Floats], tuple[Floats, Floats]]


def _held(
    rng: np.random.Generator, time_s: Floats, low: float, high: float, first: float | None = None
) -> Floats:
    """Values that are held for a random time each."""
    edges = np.cumsum(rng.uniform(_SHORTEST_HOLD_S, _LONGEST_HOLD_S, _CHANGES))
    values = rng.uniform(low, high, _CHANGES + 1)
    values[0] = values[0] if first is None else first
    while edges[-1] < time_s[-1]:
        more = rng.uniform(_SHORTEST_HOLD_S, _LONGEST_HOLD_S, _CHANGES)
        edges = np.append(edges, edges[-1] + np.cumsum(more))
        values = np.append(values, rng.uniform(low, high, _CHANGES))
    return np.asarray(values[np.searchsorted(edges, time_s)])


def _steps(rng: np.random.Generator, time_s: Floats) -> Floats:
    """Levels that are held for a random time each."""
    return _held(rng, time_s, 0.0, 1.0)


def _sine(rng: np.random.Generator, time_s: Floats) -> Floats:
    """A sine within the range."""
    amplitude = rng.uniform(0.1, 0.4)
    centre = rng.uniform(amplitude, 1.0 - amplitude)
    frequency_hz = np.exp(rng.uniform(*np.log(_SINES_HZ)))
    phase = rng.uniform(0.0, 2.0 * np.pi)
    return np.asarray(centre + amplitude * np.sin(2.0 * np.pi * frequency_hz * time_s + phase))


def _track(rng: np.random.Generator, time_s: Floats) -> tuple[Floats, Floats]:
    draw = _steps if rng.random() < 0.5 else _sine
    return draw(rng, time_s), np.zeros(time_s.size)


def _hold(rng: np.random.Generator, time_s: Floats) -> tuple[Floats, Floats]:
    """A constant strain under a pull that changes at random times."""
    pulls = _held(rng, time_s, -_PULL, _PULL, first=0.0)
    return np.full(time_s.size, rng.uniform(0.3, 0.7)), pulls


def _gait(rng: np.random.Generator, time_s: Floats) -> tuple[Floats, Floats]:
    """The trapezoid gait of the scoreboard's T3, with random frequency, range and start."""
    frequency_hz, amplitude = rng.uniform(*_GAITS_HZ), rng.uniform(0.1, 0.4)
    centre = rng.uniform(amplitude, 1.0 - amplitude)
    start_s = rng.uniform(0.0, 1.0 / frequency_hz)
    return centre + trapezoid(time_s + start_s, frequency_hz, amplitude), np.zeros(time_s.size)


TASKS = {
    task.name: task
    for task in (
        LearningTask("track", "follow steps or a sine", _track),
        LearningTask("hold", "hold a strain under a pull that changes", _hold),
        LearningTask("gait", "follow a periodic trapezoid", _gait),
    )
}


def find_task(name: str) -> LearningTask:
    """A task by its name.

    Raises:
        InputError: There is none of this name.
    """
    if name not in TASKS:
        raise InputError(f"No task {name!r}. The tasks are {', '.join(TASKS)}.")
    return TASKS[name]
