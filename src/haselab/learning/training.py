"""Train a network by evolution strategies (CMA-ES) on many twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, shown
from haselab.controllers.network.controller import STRAIN_PER_ONE
from haselab.controllers.network.weights import (
    FEATURES,
    HIDDEN,
    LARGEST_FEATURE,
    LARGEST_WEIGHT,
    ONE,
    WEIGHT_ONE,
    Network,
    features_of,
)
from haselab.learning.simulation import StrainSimulation, whole_number
from haselab.store.optional import library

__all__ = ["WEIGHTS", "Progress", "changes", "train"]

Floats = NDArray[np.float64]
WEIGHTS = HIDDEN * (FEATURES + 1) + HIDDEN + 1
_FIRST_SIGMA, _NEXT_SIGMA = 0.2, 0.1
_EPISODE_S = 3.0
_MOST = 1_000_000
# The longer the reference is constant, the more an error counts: up to 1 + `_MOST_PATIENCE` times.
_PATIENCE, _MOST_PATIENCE = 0.1, 4.0
_JUMP, _CONSTANT = 5e-3, 1e-9  # changes per update: a larger one is a step, a smaller one none


@dataclass(frozen=True)
class Progress:
    """How far a training is.

    Args:
        generation: that has ended, from 1.
        best: mean objective of an update, of its best network.
        median: the same of the median network.
        network: mean one of the search so far, as `train` would return it. Keep it if the training
            may be interrupted: another one can start from it.
    """

    generation: int
    best: float
    median: float
    network: Network


def _first_guess() -> Floats:
    """A network with one unit that integrates the error."""
    hidden = np.zeros((HIDDEN, FEATURES + 1))
    hidden[0, 0] = 1.0
    output = np.zeros(HIDDEN + 1)
    output[0] = 0.1
    return np.concatenate([hidden.ravel(), output])


def changes(weights: NDArray[np.int32], features: NDArray[np.int32]) -> NDArray[np.int32]:
    """What many networks answer, as `Network.change`.

    Args:
        weights: Shape `(P, WEIGHTS)`.
        features: Shape `(P, K, FEATURES)`.
    Returns:
        Shape `(P, K)`.
    """
    hidden = weights[:, : HIDDEN * (FEATURES + 1)].reshape(-1, HIDDEN, FEATURES + 1)
    output = weights[:, HIDDEN * (FEATURES + 1) :]
    clipped = np.clip(features, -LARGEST_FEATURE, LARGEST_FEATURE)
    total = np.matmul(clipped, hidden[:, :, :-1].transpose(0, 2, 1))
    total += ONE * hidden[:, None, :, -1]
    units = np.clip(total >> 5, -ONE, ONE)
    last = (units * output[:, None, :-1]).sum(axis=2, dtype=np.int32) + ONE * output[:, -1:]
    return np.asarray(np.clip(last >> 5, -ONE, ONE))


class _Objective:
    """What the search maximises in one episode: the rewards, weighted so that steps settle.

    Args:
        simulation: at the beginning of the episode.
        overshoot_cost: of a strain beyond a constant reference, relative to that of an error.
    """

    def __init__(self, simulation: StrainSimulation, overshoot_cost: float) -> None:
        self._simulation, self._overshoot_cost = simulation, overshoot_cost
        self._reference = simulation.reference
        self._held, self._direction = np.zeros(simulation.slots), np.zeros(simulation.slots)

    def of(self, rewards: Floats, terminated: NDArray[np.bool_]) -> Floats:
        """Of one update. Shapes `(slots,)`."""
        reference = self._simulation.reference
        jump = reference - self._reference
        self._reference = reference
        self._direction = np.where(np.abs(jump) > _JUMP, np.sign(jump), self._direction)
        self._held = np.where(np.abs(jump) < _CONSTANT, self._held + 1.0, 0.0)
        beyond = np.maximum(self._direction * (self._simulation.strain - reference), 0.0)
        found = rewards * (1.0 + np.minimum(_PATIENCE * self._held, _MOST_PATIENCE))
        found -= self._overshoot_cost * beyond / STRAIN_PER_ONE * (self._held > 0.0)
        return np.where(terminated, rewards, found)


class _Loops:
    """The networks of one generation, each in as many loops."""

    def __init__(
        self, simulations: list[StrainSimulation], population: int, overshoot_cost: float
    ) -> None:
        self._simulations, self._population = simulations, population
        self._overshoot_cost = overshoot_cost

    def returns(self, weights: NDArray[np.int32], seed: int) -> Floats:
        """Mean objective per update of each network. Shape `(P,)`."""

        def played(simulation: StrainSimulation) -> Floats:
            rng = np.random.default_rng(seed)
            simulation.reset_alike(self._population, rng)
            return self._play(simulation, weights, rng)

        # the compiled twin lets other threads run
        with ThreadPoolExecutor(len(self._simulations)) as threads:
            whole = sum(threads.map(played, self._simulations), np.zeros(self._population))
        return whole / len(self._simulations)

    def _play(
        self, simulation: StrainSimulation, weights: NDArray[np.int32], rng: np.random.Generator
    ) -> Floats:
        shape = (self._population, -1)
        total, ended, count = np.zeros(simulation.slots), False, 0
        alive = np.ones(simulation.slots, dtype=bool)
        drive = _to_one(simulation.observe()[:, 4])
        last = drive
        objective = _Objective(simulation, self._overshoot_cost)
        while not ended:
            seen = simulation.observe()
            strain = (_to_one(seen[:, 0]), _to_one(seen[:, 1]), _to_one(seen[:, 2]))
            features = np.stack(features_of(_to_one(seen[:, 3]), strain, drive, last), axis=1)
            change = changes(weights, features.reshape(*shape, FEATURES))
            last, drive = drive, np.clip(drive + (change.ravel() >> 1), -ONE, ONE)
            rewards, terminated, truncated = simulation.step(drive / ONE, rng)
            total += np.where(alive, objective.of(rewards, terminated), 0.0)
            alive &= ~terminated
            count += 1
            ended = bool(truncated.any())
        return np.asarray(total.reshape(shape).mean(axis=1) / count)


class _OwnRandom:
    """Random numbers of `numpy.random` that neither change those of the caller nor depend on them.

    CMA-ES draws from the global generator of numpy.
    """

    def __init__(self) -> None:
        self._own: dict[str, Any] | None = None

    def __enter__(self) -> None:
        self._callers = np.random.get_state(legacy=False)  # noqa: NPY002
        if self._own is not None:
            np.random.set_state(self._own)  # noqa: NPY002

    def __exit__(self, *_: object) -> None:
        self._own = np.random.get_state(legacy=False)  # noqa: NPY002
        np.random.set_state(self._callers)  # noqa: NPY002


def _to_one(values: NDArray[np.floating]) -> NDArray[np.int32]:
    return np.rint(ONE * values.astype(np.float64)).astype(np.int32)


def train(
    tasks: Sequence[str] = ("track", "gait"),
    *,
    seed: int = 1,
    generations: int = 400,
    population: int = 32,
    loops: int = 12,
    devices: int = 64,
    start: Network | None = None,
    overshoot_cost: float = 0.0,
    report: Callable[[Progress], None] | None = None,
) -> Network:
    """Train a network that closes the loop on drawn devices.

    The search maximises the mean reward. While the reference is constant, the weight of an error
    grows, to five times after 0.4 s, so that steps settle.

    Args:
        tasks: names, which count alike; or one name.
        seed: of devices, episodes and search.
        generations: of the search.
        population: networks in a generation.
        loops: in which each of them is tried, in each task.
        devices: different ones.
        start: network at which the search begins; None: one that integrates the error.
        overshoot_cost: of a strain beyond a constant reference, relative to that of an error.
        report: called after each generation.
    Returns:
        The mean network of the last generation's search.
    Raises:
        InputError: An argument is out of range, or cma is not installed.
    Source:
        Hansen, N. The CMA evolution strategy: a tutorial. arXiv:1604.00772, 2016.
    """
    cma: Any = library("cma", "learning")

    if not 0.0 <= overshoot_cost <= 100.0:
        raise InputError(f"overshoot_cost is {overshoot_cost:g}. State 0 to 100.")
    tasks = (tasks,) if isinstance(tasks, str) else tuple(tasks)
    if not tasks:
        raise InputError("No tasks are given. State at least one.")
    if not (start is None or isinstance(start, Network)):
        raise InputError(f"start is {shown(start)}. State a Network; Network.load reads a file.")
    whole_number("seed", seed, 0, 2**32 - 2)
    whole_number("generations", generations, 1, _MOST)
    whole_number("population", population, 2, _MOST)
    whole_number("loops", loops, 1, _MOST)
    simulations = [
        StrainSimulation(
            task, population * loops, devices=devices, devices_seed=seed, episode_s=_EPISODE_S
        )
        for task in tasks
    ]
    tried = _Loops(simulations, population, overshoot_cost)
    bound = LARGEST_WEIGHT / WEIGHT_ONE
    first = (_first_guess(), _FIRST_SIGMA) if start is None else (start.to_vector(), _NEXT_SIGMA)
    options = {"seed": seed + 1, "popsize": population, "bounds": [-bound, bound], "verbose": -9}
    random = _OwnRandom()
    with random:
        search = cma.CMAEvolutionStrategy(*first, options)
    for generation in range(generations):
        with random:
            asked = np.array(search.ask())
        weights = np.clip(np.rint(WEIGHT_ONE * asked), -LARGEST_WEIGHT, LARGEST_WEIGHT)
        returns = tried.returns(weights.astype(np.int32), 1000 * seed + generation)
        with random:
            search.tell(list(asked), (-returns).tolist())
        network = Network.from_vector(np.asarray(search.result.xfavorite))
        if report is not None:
            best, median = float(returns.max()), float(np.median(returns))
            report(Progress(generation + 1, best, median, network))
    return network
