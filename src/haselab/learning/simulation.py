"""Many loops on twins, one update at a time: the physics and the sensing of the environments."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from haselab import _twin
from haselab.actuators import GRAVITY_M_S2
from haselab.base import InputError, is_real, shown
from haselab.controllers.network.controller import STRAIN_PER_ONE
from haselab.learning.tasks import find_task
from haselab.rig.twin.config import TwinConfig
from haselab.scoreboard.devices import ZERO_LENGTH_M, Device, drawn, find_device
from haselab.scoreboard.knowledge import TRAINED
from haselab.scoreboard.loop_class import CLASSES, STEP_S, noise_of
from haselab.scoreboard.plant import WITHOUT_EFFECT, fast_bench

__all__ = ["LARGEST_OBSERVATION", "OBSERVATIONS", "StrainSimulation", "whole_number"]

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

CHANGE_COST = 0.05
BREAKDOWN_COST = 100.0
OBSERVATIONS = (
    "strain", "strain_1", "strain_2", "reference", "drive_1", "drive_2",
)  # fmt: skip  # _1, _2: one and two updates ago
LARGEST_OBSERVATION = 10.0
_DEVICES = 64
_EPISODE_S = 5.0
_LOOP = CLASSES["host-100hz"]
_TRAIN_S, _REST_S = 20.0, 60.0
_MAP_KNOTS = 200
_USED = 0.85  # of the drive's range: no drawn device breaks down there
_REACH_UPDATES = 200
_FAULTS = {1: "breaks down", 2: "leaves the lengths in which its law is valid"}
_FASTEST_RAD_S = 1e4  # the compiled motion then takes about 2 s for the 140 s in which it settles


def whole_number(name: str, value: object, low: int, high: int) -> None:
    """Refuse what is not a whole number within limits.

    Args:
        name: of the value, for the message.
        value: anything.
        low: lowest number.
        high: highest one.
    Raises:
        InputError: It is none, or outside.
    """
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or not low <= int(value) <= high:  # type: ignore[call-overload]
        raise InputError(f"{name} is {shown(value)}. State a whole number from {low} to {high}.")


@dataclass(frozen=True)
class _Pool:
    """Settled devices. Arrays have the shape `(devices,)`."""

    benches: tuple[_twin.Bench, ...]
    switch_at: tuple[int, ...]
    zero_m: Floats  # length at rest, at the drive of strain 0
    zero_f: Floats  # capacitance there
    relative_noise: Floats
    load_n: Floats
    zero_v: Floats
    middle_v: Floats  # of the range of the drive
    scale_v: Floats  # half of the range


class StrainSimulation:
    """Closed loops on planar HASELs, with one action for each update of 10 ms.

    Args:
        task: name of a task.
        slots: number of loops.
        devices: how many different devices are drawn, or the devices; each episode takes one. A
            `TwinConfig` is driven from 0 to 2 V, and has strain 0 at 1.04 V, like the public twin.
            A warning names keys that differ from those of the public twin and have no effect.
        devices_seed: of the drawn devices.
        episode_s: duration of an episode, in s.
    Raises:
        InputError: The task is unknown, or a number is out of range.
    """

    def __init__(
        self,
        task: str,
        slots: int,
        *,
        devices: int | Sequence[Device | TwinConfig] = _DEVICES,
        devices_seed: int = 0,
        episode_s: float = _EPISODE_S,
    ) -> None:
        self.task = find_task(task)
        whole_number("The number of environments", slots, 1, 1_000_000)
        if not is_real(episode_s) or not 0.1 <= episode_s <= 3600.0:
            raise InputError(f"The episode lasts {shown(episode_s)} s. State 0.1 to 3600 s.")
        self._pool = _pool(devices, devices_seed)
        window = (_LOOP.steps, _LOOP.first, _LOOP.last)
        self._ensemble = _twin.Ensemble(self._pool.benches, self._pool.switch_at, slots, window)
        self._updates = round(episode_s / _LOOP.period_s)
        self._time_s: Floats = _LOOP.period_s * np.arange(1.0, self._updates + 2.0)
        self.slots = slots
        self._reference = np.zeros((slots, self._updates + 1))
        self.rewarded_reference = np.zeros(slots)  # strains that the last rewards compared with
        self._pull_n = np.zeros((slots, self._updates + 1))
        self._device = np.zeros(slots, dtype=np.int64)
        self._update = np.zeros(slots, dtype=np.int64)
        self._drive_v = np.zeros((2, slots))  # of this update, and of the one before
        self._middle_v, self._scale_v = np.zeros(slots), np.ones(slots)
        self._load_n = np.zeros(slots)
        self._strain = np.zeros((3, slots))
        self._capacitance_f, self.length_m = np.zeros(slots), np.zeros(slots)
        self._row = np.arange(slots)
        self._begun = np.zeros(slots, dtype=bool)
        nominal = find_device("hz").law
        lengths = np.linspace(0.85, 1.35, _MAP_KNOTS) * ZERO_LENGTH_M
        self._map_f = nominal.capacitance_f(lengths) / nominal.capacitance_f(ZERO_LENGTH_M)
        self._map_strain = lengths / ZERO_LENGTH_M - 1.0
        self._reach = _reach(self._pool)

    def __reduce__(self) -> NoReturn:
        """Refuse copies and pickles, with a message that says what to do instead.

        Raises:
            TypeError: always.
        """
        raise TypeError(
            "An environment of haselab cannot be copied or pickled: its twins are in compiled "
            "code. Give each process a function that makes one, such as "
            "lambda: gymnasium.make('haselab.learning:haselab/Track-v0')."
        )

    @property
    def period_s(self) -> float:
        """Time between two actions, in s."""
        return _LOOP.period_s

    @property
    def strain(self) -> Floats:
        """True strains now. Shape `(slots,)`."""
        return np.asarray(self.length_m / self._pool.zero_m[self._device] - 1.0)

    @property
    def reference(self) -> Floats:
        """Strains that the next update is to reach. Shape `(slots,)`."""
        return np.asarray(self._reference[self._row, self._update])

    @property
    def drive_v(self) -> Floats:
        """Drives that were set last, at the amplifier's input, in V. Shape `(slots,)`."""
        return np.asarray(self._drive_v[0])

    def reset(self, which: NDArray[np.int64], rng: np.random.Generator) -> None:
        """Begin episodes: each with a device, a reference and loads of its own.

        Args:
            which: slots.
            rng: of everything that is drawn.
        """
        pool = self._pool
        chosen = rng.integers(len(pool.benches), size=which.size)
        self._begin(which, chosen)
        low, high = self._reach
        for slot, device in zip(which.tolist(), chosen.tolist(), strict=True):
            reference, pull = self.task.draw(rng, self._time_s)
            self._reference[slot] = low[device] + (high[device] - low[device]) * reference
            self._pull_n[slot] = pool.load_n[device] * pull
        sensed = self._sense(np.asarray(pool.zero_f[chosen]), chosen, rng)
        self._strain[:, which] = sensed
        self.rewarded_reference[which] = self._reference[which, 0]

    def _begin(self, which: NDArray[np.int64], devices: NDArray[np.int64]) -> None:
        """Set loops to devices at rest, at the drive of strain 0."""
        pool = self._pool
        self._ensemble.reset(which, devices)
        self._device[which], self._update[which] = devices, 0
        self._begun[which] = True
        self._drive_v[:, which] = pool.zero_v[devices]
        self._middle_v[which], self._scale_v[which] = pool.middle_v[devices], pool.scale_v[devices]
        self._load_n[which] = pool.load_n[devices]
        self.length_m[which] = pool.zero_m[devices]

    def reset_alike(self, groups: int, rng: np.random.Generator) -> None:
        """Begin the same episodes in each of some groups of slots, to compare policies.

        Args:
            groups: number of groups, which divides that of the slots.
            rng: of everything that is drawn.
        """
        size = self.slots // groups
        first = np.arange(size)
        self.reset(first, rng)
        self._begin(np.arange(self.slots), np.tile(self._device[:size], groups))
        for values in (self._reference, self._pull_n):
            values[:] = np.tile(values[:size], (groups, 1))
        self._strain[:] = np.tile(self._strain[:, :size], (1, groups))

    def step(self, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Flags, Flags]:
        """Let one update pass in all loops.

        Args:
            actions: -1 to 1 over the range of the drive; values beyond count as the end. Shape
                `(slots,)`.
            rng: of the noise.
        Returns:
            Rewards; whether a device no longer works; whether the episode is at its end.
        Raises:
            InputError: An action is not finite, or an episode has not begun or is over.
        """
        drive = self._drive_v
        if not np.isfinite(actions).all():
            wrong = actions[~np.isfinite(actions)][0]
            raise InputError(
                f"An action is {wrong:g}. Actions are numbers from -1 to 1. Has the policy "
                "diverged?"
            )
        if not self._begun.all():
            raise InputError("The episode has not begun. Call reset() before step().")
        if (self._update > self._updates).any():
            raise InputError("The episode is over. Call reset() before step().")
        drive[1] = drive[0]
        drive[0] = self._middle_v + self._scale_v * np.clip(actions, -1.0, 1.0)
        pull_n = self._pull_n[self._row, self._update]
        self._ensemble.update(
            drive[1], drive[0], self._load_n + pull_n,
            self._capacitance_f, self.length_m,
        )  # fmt: skip
        self.rewarded_reference = self.reference
        error = (self.strain - self.rewarded_reference) / STRAIN_PER_ONE
        change = (drive[0] - drive[1]) / self._scale_v
        rewards = -np.abs(error) - CHANGE_COST * change**2
        terminated = np.zeros(self.slots, dtype=bool)
        if self._ensemble.any_fault:
            terminated = np.array([self._ensemble.fault(k) != 0 for k in range(self.slots)])
            rewards[terminated] = -BREAKDOWN_COST
        self._strain[1:] = self._strain[:-1].copy()
        self._strain[0] = self._sense(self._capacitance_f, self._device, rng)
        self._update += 1
        return rewards, terminated, self._update >= self._updates

    def observe(self) -> NDArray[np.float32]:
        """What a policy sees: `OBSERVATIONS`, strains over 0.05, drives from -1 to 1.

        Returns:
            Shape `(slots, 6)`.
        """
        found = np.empty((self.slots, len(OBSERVATIONS)), dtype=np.float32)
        found[:, 0:3] = self._strain.T / STRAIN_PER_ONE
        found[:, 3] = self.reference / STRAIN_PER_ONE
        found[:, 4:6] = ((self._drive_v - self._middle_v) / self._scale_v).T
        return np.clip(found, -LARGEST_OBSERVATION, LARGEST_OBSERVATION, out=found)

    def _sense(
        self, capacitance_f: Floats, device: NDArray[np.int64], rng: np.random.Generator
    ) -> Floats:
        """Strains by the map of the nominal device, from capacitances with noise."""
        relative = capacitance_f / self._pool.zero_f[device]
        noise = self._pool.relative_noise[device] * rng.standard_normal(device.size)
        return np.interp(relative * (1.0 + noise), self._map_f, self._map_strain)


def _pool(devices: int | Sequence[Device | TwinConfig], seed: int) -> _Pool:
    listed = [_device(one) for one in _listed(devices, seed)]
    if ignored := [name for name in WITHOUT_EFFECT if any(_changes(one, name) for one in listed)]:
        named = ", ".join(ignored)
        warnings.warn(
            f"The environments ignore {named} of the devices, so these values have no effect.",
            stacklevel=2,
        )
    switch_at = tuple(_switch_at(one, number) for number, one in enumerate(listed))
    settled = [_settled(one, number) for number, one in enumerate(listed)]
    low_v, high_v = (np.array([getattr(one, end) for one in listed]) for end in ("low_v", "high_v"))
    return _Pool(
        tuple(settled),
        switch_at,
        np.array([bench.length_m for bench in settled]),
        np.array([bench.capacitance(bench.length_m, one.zero_v * one.config.amplifier.gain)
                  for bench, one in zip(settled, listed, strict=True)]),
        np.array([_noise(one, bench.length_m)
                  for bench, one in zip(settled, listed, strict=True)]),
        np.array([GRAVITY_M_S2 * one.mass_kg for one in listed]),
        np.array([one.zero_v for one in listed]),
        0.5 * (high_v + low_v), 0.5 * (high_v - low_v),
    )  # fmt: skip


def _listed(devices: object, seed: int) -> Sequence[object]:
    """The given devices, or as many drawn ones as their number says."""
    if isinstance(devices, Sequence) and not isinstance(devices, str):
        if not devices:
            raise InputError("No devices are given. State at least one.")
        return devices
    whole_number("The number of devices", devices, 1, 100_000)
    whole_number("devices_seed", seed, 0, 2**63 - 1)
    rng = np.random.default_rng(seed)
    return [drawn(rng) for _ in range(cast("int", devices))]


def _device(given: object) -> Device:
    public = find_device("hz")
    if isinstance(given, TwinConfig):
        given = replace(public, config=given)
    if not isinstance(given, Device):
        raise InputError(
            f"The devices contain {shown(given)}. State a number of devices, or objects of "
            "haselab.scoreboard.devices.Device or haselab.rig.twin.config.TwinConfig."
        )
    if given.config.kind != public.config.kind:
        raise InputError(
            f"The devices contain a {given.config.kind}. The environments simulate planar HASELs "
            "only."
        )
    return given


def _changes(device: Device, name: str) -> bool:
    """Whether a key of a device differs from that of the public one."""
    value = attrgetter(name)
    return bool(value(device.config) != value(find_device("hz").config))


def _switch_at(device: Device, number: int) -> int:
    """Step of an update at which the output of the one before takes effect."""
    delay_s = device.config.acquisition.output_delay_s + device.late_s
    if not 0.0 <= delay_s <= _LOOP.period_s:
        raise InputError(
            f"Device {number} has an output delay of {1e3 * delay_s:.3g} ms. In the environments, "
            f"acquisition.output_delay_s and late_s together are 0 to {1e3 * _LOOP.period_s:g} ms."
        )
    return round(delay_s / STEP_S)


def _check_speed(device: Device, number: int) -> None:
    """Refuse a device whose simulation would take very long."""
    law, load = device.law, device.config.load
    losses, free_m = law.losses, law.free_length_m
    near_n = law.elastic_force_n(np.array([0.999, 1.001]) * free_m)
    held = 1.0 + losses.softening_share + sum(losses.branch_share)
    stiffness = abs(float(near_n[1] - near_n[0])) / (0.002 * free_m) * held
    if losses.hysteresis_n > 0.0:
        stiffness += 2.0 * losses.hysteresis_n / (losses.hysteresis_width * free_m)
    inertia_kg = load.mass_kg + load.added_inertia_kg + law.moving_mass_kg
    fastest = max(losses.damping_n_s_per_m / inertia_kg, math.sqrt(stiffness / inertia_kg))
    if fastest > _FASTEST_RAD_S:
        raise InputError(
            f"Device {number} moves too fast to be simulated in reasonable time: with an inertia "
            f"of {inertia_kg:.3g} kg, its resonance or the rate of its damper is "
            f"{fastest:.3g} rad/s, above the limit of {_FASTEST_RAD_S:g} rad/s. Raise its mass."
        )


def _reach(pool: _Pool) -> tuple[Floats, Floats]:
    """Strains at rest at the lowest drive and at `_USED` of the highest. Shapes `(devices,)`."""
    count = len(pool.benches)
    ends = _twin.Ensemble(
        pool.benches, pool.switch_at, count, (_LOOP.steps, _LOOP.first, _LOOP.last)
    )
    farad, length_m = np.empty(count), np.empty(count)
    found = []
    for share in (-1.0, 2.0 * _USED - 1.0):
        ends.reset(np.arange(count), np.arange(count))
        held = pool.middle_v + share * pool.scale_v
        for _ in range(_REACH_UPDATES):
            ends.update(held, held, pool.load_n, farad, length_m)
        if ends.any_fault:
            first = next(k for k in range(count) if ends.fault(k))
            end = "a lower high_v" if share > 0.0 else "another low_v"
            raise InputError(
                f"Device {first} {_FAULTS[ends.fault(first)]} at a drive of "
                f"{held[first]:.3g} V. Leave it out, or give a Device with {end}."
            )
        found.append(length_m / pool.zero_m - 1.0)
    return found[0], found[1]


def _noise(device: Device, length_m: float) -> float:
    farad = float(device.law.capacitance_f(length_m))
    return noise_of(_LOOP, device.config, farad) / farad


def _settled(device: Device, number: int) -> _twin.Bench:
    """A bench whose device was stretched once, and now hangs at the drive of strain 0."""
    _check_speed(device, number)
    bench = fast_bench(device.config)
    own_kg = device.config.load.added_inertia_kg + device.law.moving_mass_kg
    plan = ((TRAINED, 0.0, _TRAIN_S), (1.0, 0.0, _REST_S), (1.0, device.zero_v, _REST_S))
    for share, drive_v, duration_s in plan:
        mass_kg = share * device.mass_kg
        bench.inertia_kg = mass_kg + own_kg
        lengths = np.empty(round(duration_s / STEP_S))
        bench.move(np.array([drive_v]), 1, GRAVITY_M_S2 * mass_kg, lengths)
        if bench.broken:
            raise InputError(
                f"Device {number} {_FAULTS[2 if bench.outside else 1]} while it settles, at a "
                f"drive of {drive_v:.3g} V under {mass_kg:.3g} kg. Leave it out, or change it."
            )
    return bench
