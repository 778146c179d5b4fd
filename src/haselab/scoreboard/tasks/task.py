"""What a task is: a scenario on a device, and numbers from its trace with their bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.controllers import KnownActuator
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.play import Scenario, Trace

__all__ = ["Metric", "Task", "staircase"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Metric:
    """One number of a task, the smaller the better.

    Args:
        name: in the results.
        unit: SI.
        title: for people.
    """

    name: str
    unit: str
    title: str


@dataclass(frozen=True)
class Task:
    """A task of the scoreboard.

    Args:
        name: in the results, such as `T1`.
        title: one line for people.
        device: public device that it is played on, and whose identified model controllers know.
        metrics: all numbers that `score` gives.
        scenario: makes the scenario from the public device's identified model, for the device that
            is played and with random numbers of the seed.
        score: numbers by the names of the metrics; NaN where the task was not done.
        bounds: physical limits by the names of the metrics, of the true device in a class of loop.
        drawn: whether each seed draws its own device about the public one.
        classes: in which it is played.
    """

    name: str
    title: str
    device: str
    metrics: tuple[Metric, ...]
    scenario: Callable[[KnownActuator, np.random.Generator], Scenario]
    score: Callable[[Trace, Scenario], Mapping[str, float]]
    bounds: Callable[[KnownActuator, LoopClass], Mapping[str, float]]
    drawn: bool = False
    classes: tuple[str, ...] = ("host-100hz", "chip-1khz", "oracle")


def staircase(points: tuple[tuple[float, float], ...]) -> Callable[[Floats], Floats]:
    """A reference that is constant between the times of some points.

    Args:
        points: times and strains from then on, rising; the first strain holds before it too.
    Returns:
        Strain at times.
    Example:
        >>> staircase(((0.0, 0.1), (1.0, 0.2)))(np.array([-1.0, 0.5, 1.0])).tolist()
        [0.1, 0.1, 0.2]
    """
    times_s, strains = (np.array(column) for column in zip(*points, strict=True))

    def reference(time_s: Floats) -> Floats:
        at = np.searchsorted(times_s, time_s + 1e-9, side="right") - 1
        return np.asarray(strains[np.maximum(at, 0)])

    return reference
