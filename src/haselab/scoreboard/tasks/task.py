"""What a task is: a scenario on a device, and numbers from its trace with their bounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.controllers import KnownActuator
from haselab.scoreboard.bounds import least_tracking_error
from haselab.scoreboard.loop_class import STEP_S, LoopClass
from haselab.scoreboard.plant import relative_noise_of
from haselab.scoreboard.play import TRACE_S, Scenario, Trace

__all__ = ["Metric", "Task", "no_bounds", "sensed_noise", "staircase", "tracking_limit"]

Floats = NDArray[np.float64]
_PERIOD_S = 1.0  # of all references whose tracking has a limit, or a multiple of theirs
_COARSE_S = 5e-3  # updates: with shorter ones, the force is no limit between them


@dataclass(frozen=True)
class Metric:
    """One number of a task, the smaller the better.

    Args:
        name: in the results.
        unit: SI.
        title: for people.
        limit: what its physical limit is and assumes; empty: there is none.
    """

    name: str
    unit: str
    title: str
    limit: str = ""


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
        bounds: physical limits by the names of the metrics, of the true device in a scenario and a
            class of loop.
        drawn: whether each seed draws its own device about the public one.
        classes: in which it is played.
    """

    name: str
    title: str
    device: str
    metrics: tuple[Metric, ...]
    scenario: Callable[[KnownActuator, np.random.Generator], Scenario]
    score: Callable[[Trace, Scenario], Mapping[str, float]]
    bounds: Callable[[KnownActuator, Scenario, LoopClass], Mapping[str, float]]
    drawn: bool = False
    classes: tuple[str, ...] = ("host-100hz", "chip-1khz", "oracle")


def no_bounds(known: KnownActuator, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    """Bounds of a task that has none."""
    return {}


def sensed_noise(known: KnownActuator, scenario: Scenario, loop: LoopClass, strain: float) -> float:
    """Standard deviation of one measured strain, by the noise that `FastPlant` adds.

    Args:
        known: true device.
        scenario: with the bench.
        loop: class.
        strain: at which it is measured.
    """
    noise_f = relative_noise_of(loop, scenario.device) * known.static_capacitance_f(strain)
    return replace(known, capacitance_noise_f=noise_f).length_noise_m(strain) / known.zero_length_m


def tracking_limit(
    known: KnownActuator, scenario: Scenario, loop: LoopClass, from_s: float
) -> float | None:
    """Least tracking error of a reference that repeats after 1 s; None: not a limit at that rate.

    Args:
        known: true device.
        scenario: with the reference.
        loop: class.
        from_s: beginning of a period, at an update.
    """
    if loop.period_s < _COARSE_S:
        return None
    time_s = np.asarray(from_s + TRACE_S * np.arange(round(_PERIOD_S / TRACE_S)), dtype=np.float64)
    wanted = scenario.reference(time_s)
    first_s = loop.switch_at * STEP_S
    return least_tracking_error(known, wanted, TRACE_S, loop.period_s, first_s)


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
