"""Plays all controllers against all tasks, in several processes, and collects the results.

The results depend on the seed alone: not on the number of processes, nor on the order in which
they finish. Each task and seed has random numbers of its own, the same for all controllers.
"""

from __future__ import annotations

import math
import random
import signal
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from haselab.base import (
    DeviceError,
    HaselabError,
    InputError,
    Progress,
    ResultError,
    SilentProgress,
)
from haselab.controllers import CONTROLLERS, ChosenController, KnownActuator
from haselab.scoreboard.devices import Device, find_device
from haselab.scoreboard.entrants import Designed, designed
from haselab.scoreboard.knowledge import identified, known_by, true_actuator
from haselab.scoreboard.loop_class import CLASSES, LoopClass, noise_of
from haselab.scoreboard.play import Scenario, play
from haselab.scoreboard.processes import Lost, Workers, announce_limit
from haselab.scoreboard.tasks import TASKS, Task

__all__ = ["Entry", "Game", "Plan", "Played", "known_in_class", "play_board", "seeded"]

Floats = NDArray[np.float64]
Item = TypeVar("Item")
Result = TypeVar("Result")
_SHOWN_S = 4e-3  # between two points of a trace that is kept
_SLOWEST = 10.0  # times the duration of a task: a controller that takes longer does not return
_LEAST_S = 20.0
_BUSY = 4.0  # wall time over processor time that other programs explain
_GRACE = 1.5  # times the longest wall time: a process that still runs then is killed
_EXCESS = 1.02  # of the permitted field: what a sensed length may miss


@dataclass(frozen=True)
class Plan:
    """What is played.

    Args:
        controllers: names of kinds.
        tasks: names.
        classes: names.
        seed: of all random numbers.
        seeds: how often each task is played.
        workers: number of processes; 0: everything runs in this process, where a controller can
            affect other tasks.
    """

    controllers: tuple[str, ...]
    tasks: tuple[str, ...]
    classes: tuple[str, ...] = ("host-100hz", "chip-1khz")
    seed: int = 0
    seeds: int = 5
    workers: int = 0


@dataclass(frozen=True)
class Entry:
    """A controller in a class with its parameters, for one device.

    Args:
        controller: kind.
        loop: name of the class.
        device: public device whose model it was designed with.
        values: parameters by name.
        reason: why it has no design; empty: it has one.
    """

    controller: str
    loop: str
    device: str
    values: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""


@dataclass(frozen=True)
class Played:
    """One controller, task and seed.

    Args:
        controller: kind.
        loop: name of the class.
        task: name.
        index: of the seed.
        numbers: by the names of the task's metrics; NaN where the task was not done.
        bounds: physical limits of the device that was played.
        failure: why it ended early; empty: it did not.
        violates: whether it ended early, or the field was above the permitted one.
        trace: time, reference and strain, of the first seed. Shape `(3, N)`.
    """

    controller: str
    loop: str
    task: str
    index: int
    numbers: Mapping[str, float]
    bounds: Mapping[str, float]
    failure: str
    violates: bool
    trace: Floats | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class Game:
    """All that was played.

    Args:
        plan: of it.
        entries: designs.
        played: in the order of controllers, classes, tasks and seeds.
        identification: status of the fit of each public device.
    """

    plan: Plan
    entries: tuple[Entry, ...]
    played: tuple[Played, ...]
    identification: Mapping[str, str]


def known_in_class(known: KnownActuator, device: Device, loop: LoopClass) -> KnownActuator:
    """What controllers of a class know: for the oracle the truth, else the noise of the class.

    Args:
        known: identified.
        device: public device.
        loop: class.
    """
    if loop.true_states:
        known = true_actuator(device)
    noise_f = noise_of(loop, device.config, known.static_capacitance_f(0.0))
    return replace(known, capacitance_noise_f=noise_f)


# ---- jobs of the processes -----------------------------------------------------------------------


def _identify(name: str) -> tuple[KnownActuator | None, str]:
    """What is known of a device, and the status of its fit; None: the fit has no result."""
    device = find_device(name)
    try:
        fit = identified(device)
    except ResultError as error:
        return None, str(error)
    return known_by(device, fit), fit.status


@dataclass(frozen=True)
class _DesignJob:
    controller: str
    loop: str
    device: str
    known: KnownActuator | None
    status: str


def _design(job: _DesignJob) -> Entry:
    loop, device = CLASSES[job.loop], find_device(job.device)
    if job.known is None:
        return Entry(job.controller, job.loop, job.device, reason=job.status)
    known = known_in_class(job.known, device, loop)
    try:
        seed = zlib.crc32(f"{job.controller} {job.loop} {job.device}".encode())
        with seeded([seed]), _deadline(600.0, "the design"):
            found = designed(CONTROLLERS.find(job.controller), loop, known)
    except TimeoutError as error:
        found = Designed(None, str(error))
    values = {} if found.chosen is None else dict(found.chosen.values)
    return Entry(job.controller, job.loop, job.device, values, found.reason)


@dataclass(frozen=True)
class _PlayJob:
    entry: Entry
    task: str
    index: int
    seed: int
    known: KnownActuator | None
    lost: str = ""  # how its process ended when it was played; empty: it has not been played


def _play(job: _PlayJob) -> Played:
    entry, task, loop = job.entry, TASKS[job.task], CLASSES[job.entry.loop]
    device = find_device(task.device)
    rng = _random(job.seed, job.task, job.index)
    nothing = {metric.name: math.nan for metric in task.metrics}
    about = (entry.controller, entry.loop, job.task, job.index)
    if job.known is None:
        return Played(*about, nothing, {}, entry.reason, violates=False)
    scenario = task.scenario(job.known, rng)
    bounds = _bounds(task, scenario, loop)
    if entry.reason or job.lost:
        reason = entry.reason or f"Controller {entry.controller!r}: {job.lost}"
        return Played(*about, nothing, bounds, reason, violates=bool(job.lost))
    kind = CONTROLLERS.find(entry.controller)
    chosen = ChosenController(kind, tuple(entry.values.items()))
    known = known_in_class(job.known, device, loop)
    if loop.true_states:  # of the device that is played
        known = known_in_class(known, scenario.device, loop)
        known = replace(known, zero_length_m=scenario.zero_m)
    longest_s = max(_SLOWEST * (scenario.duration_s + scenario.lead_s), _LEAST_S)
    try:
        with (
            seeded(_seed(job.seed, job.task, job.index)),
            _deadline(longest_s, "the controller"),
        ):
            trace = play(scenario, chosen, loop, known, rng)
    except TimeoutError as error:
        return Played(*about, nothing, bounds, str(error), violates=True)
    numbers = nothing if trace.failure else {**nothing, **task.score(trace, scenario)}
    too_high = trace.peak_field_v_per_m > _EXCESS * scenario.device.field_v_per_m
    kept = None
    if job.index == 0:
        every = max(round(_SHOWN_S / 1e-3), 1)
        time_s = trace.time_s[::every]
        kept = np.stack([time_s, scenario.reference(time_s), trace.strain[::every]])
    return Played(*about, numbers, bounds, trace.failure, bool(trace.failure) or too_high, kept)


def _bounds(task: Task, scenario: Scenario, loop: LoopClass) -> Mapping[str, float]:
    true = replace(true_actuator(scenario.device), zero_length_m=scenario.zero_m)
    try:
        return task.bounds(true, scenario, loop)
    except HaselabError:  # of a drawn device that does not reach the strain
        return {}


def _random(seed: int, task: str, index: int) -> np.random.Generator:
    """Random numbers of a task and seed, the same for all controllers and classes."""
    return np.random.default_rng(_seed(seed, task, index))


def _seed(seed: int, task: str, index: int) -> list[int]:
    return [seed, zlib.crc32(task.encode()), index]


@contextmanager
def seeded(seed: Sequence[int]) -> Iterator[None]:
    """Seed the global generators that a controller may draw from, and restore them afterwards.

    Args:
        seed: whole numbers of at least 0.
    """
    before = random.getstate(), np.random.get_state(legacy=False)  # noqa: NPY002
    number = int(np.random.SeedSequence(seed).generate_state(1)[0])
    random.seed(number)
    np.random.seed(number)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002


@contextmanager
def _deadline(duration_s: float, what: str) -> Iterator[None]:
    """Raise `TimeoutError` in code that does not return, where the system can.

    Args:
        duration_s: of the processor; code that waits has `_BUSY` times as long.
        what: has this limit, for the error.
    """
    wall_s = _BUSY * duration_s
    longest_wall_s = _GRACE * wall_s

    def stop(number: int, frame: object) -> None:
        of_processor = number == signal.SIGPROF
        raise TimeoutError(
            f"{what} takes longer than {duration_s:.3g} s of processor time" if of_processor
            else f"{what} takes longer than {wall_s:.3g} s"
        )  # fmt: skip

    announce_limit(longest_wall_s, f"{what} takes longer than {longest_wall_s:.3g} s")
    try:
        timers = (
            (signal.ITIMER_PROF, signal.SIGPROF, duration_s),
            (signal.ITIMER_REAL, signal.SIGALRM, wall_s),
        )
        before = [signal.signal(number, stop) for _, number, _ in timers]
    except (AttributeError, ValueError):  # no such signals, or not the main thread
        yield
        return
    try:
        for timer, _, longest_s in timers:
            signal.setitimer(timer, longest_s)
        yield
    finally:
        for (timer, number, _), handler in zip(timers, before, strict=True):
            signal.setitimer(timer, 0.0)
            signal.signal(number, handler)


# ---- the whole -----------------------------------------------------------------------------------


def play_board(plan: Plan, progress: Progress | None = None) -> Game:
    """Identify the devices, design the controllers, and play.

    Args:
        plan: what is played.
        progress: of the jobs.
    Returns:
        All results, in the order of the plan.
    Raises:
        InputError: No controller is made for the loop of any class, or no class plays any task.
    """
    bar = progress or SilentProgress()
    tasks = [TASKS[name] for name in plan.tasks]
    devices = sorted({task.device for task in tasks})
    pairs = [
        (controller, loop) for controller in plan.controllers for loop in plan.classes
        if CLASSES[loop].suits(CONTROLLERS.find(controller))
    ]  # fmt: skip
    if not pairs:
        names = ", ".join(plan.controllers)
        raise InputError(
            f"{names} can only play in the loop of the microcontroller. Add --class chip-1khz."
        )
    plays = [
        (controller, loop, task, index)
        for controller, loop in pairs for task in tasks if loop in task.classes
        for index in range(plan.seeds)
    ]  # fmt: skip
    if not plays:
        raise InputError(
            f"{', '.join(plan.tasks)} is not played in the class {', '.join(plan.classes)}. Add "
            f"--class {tasks[0].classes[0]}."
        )
    bar.start(len(devices) + len(pairs) * len(devices) + len(plays))
    try:
        with _mapper(plan.workers, bar) as mapped:
            fits = _all_done(mapped("identify", _identify, devices))
            found = dict(zip(devices, fits, strict=True))
            jobs = [
                _DesignJob(controller, loop, device, *found[device])
                for controller, loop in pairs for device in devices
            ]  # fmt: skip
            entries = _entries(mapped, jobs)
            by_name = {(e.controller, e.loop, e.device): e for e in entries}
            played = _all_played(mapped, [
                _PlayJob(by_name[controller, loop, task.device], task.name, index, plan.seed,
                         found[task.device][0])
                for controller, loop, task, index in plays
            ])  # fmt: skip
    finally:
        bar.stop()
    statuses = {name: status for name, (_, status) in found.items()}
    return Game(plan, entries, played, statuses)


class _Mapped(Protocol):
    """A map that keeps the order."""

    def __call__(
        self, what: str, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> list[Result | Lost]: ...


@contextmanager
def _mapper(workers: int, bar: Progress) -> Iterator[_Mapped]:
    """A map that keeps the order, over processes or in this one."""

    def here(
        what: str, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> list[Result | Lost]:
        kept: list[Result | Lost] = []
        for item in items:
            kept.append(job(item))
            bar.advance(1.0, what)
        return kept

    if workers < 1:
        yield here
        return
    pool = Workers(workers)

    def there(
        what: str, job: Callable[[Item], Result], items: Sequence[Item]
    ) -> list[Result | Lost]:
        found: dict[int, Result | Lost] = {}
        for place, result in pool.each(job, items):
            found[place] = result
            bar.advance(1.0, what)
        return [found[place] for place in range(len(items))]

    try:
        yield there
    finally:
        pool.close()


def _all_done(found: list[Result | Lost]) -> list[Result]:
    """The results of jobs that run no code of other packages, so that each must have one."""
    lost = [one.reason for one in found if isinstance(one, Lost)]
    if lost:
        raise DeviceError(
            f"A job has no result: {lost[0]}. Check the memory of the computer, or use fewer "
            "workers."
        )
    return [one for one in found if not isinstance(one, Lost)]


def _entries(mapped: _Mapped, jobs: Sequence[_DesignJob]) -> tuple[Entry, ...]:
    return tuple(
        Entry(job.controller, job.loop, job.device, reason=f"no design: {one.reason}")
        if isinstance(one, Lost) else one
        for job, one in zip(jobs, mapped("design", _design, jobs), strict=True)
    )  # fmt: skip


def _all_played(mapped: _Mapped, jobs: Sequence[_PlayJob]) -> tuple[Played, ...]:
    """Play all tasks; one whose process ended counts as not done, with the reason."""
    found = mapped("play", _play, jobs)
    lost = {k: one.reason for k, one in enumerate(found) if isinstance(one, Lost)}
    again = mapped("play", _play, [replace(jobs[k], lost=reason) for k, reason in lost.items()])
    for k, one in zip(lost, _all_done(again), strict=True):
        found[k] = one
    return tuple(_all_done(found))
