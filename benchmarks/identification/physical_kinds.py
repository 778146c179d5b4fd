"""Hidden laws of each kind of actuator, and what a camera and monitors would see of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.rows import CHECKOUT
from haselab.actuators import (
    GRAVITY_M_S2,
    ActuatorLaw,
    Drive,
    LawValues,
    SampledLaw,
    with_parameters,
)
from haselab.base import HaselabError, LimitError
from haselab.identify.physical import MotionRecord
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_file import load_twin

__all__ = ["KINDS", "Kind", "default_start", "seen", "shifted", "short_record", "started"]

Floats = NDArray[np.float64]
CAMERA_BIAS_M, CAMERA_SCALE_STD = 2e-6, 5e-5  # what `fit_actuator` assumes
_RANGE = 0.3
_RANGES = {
    "shell.length_m": 0.1,
    "dielectric.capacitance_exponent": 0.1,
    "dielectric.permittivity": 0.15,
    "shell.locking_stretch": 0.15,
    "mullins.stretch": 0.05,
    "actuator.pouch_length_m": 0.1,
    "actuator.cell_length_m": 0.1,
    "actuator.layer_thickness_m": 0.1,
}
_DRAWS = 100  # of a hidden law whose motion stays within its limits
_SHORT_BLOCKS = 6000
_LENGTH_STD_M, _CAPACITANCE_STD_F = 4e-6, 3e-13  # of the twin's camera and monitors
BRANCH = (0.05, 12.0)  # share and s of the branch that the starting law lacks


@dataclass(frozen=True)
class Kind:
    """What the benchmark needs of a kind of actuator.

    Args:
        name: of the kind.
        highest_v: of the short drives.
        loads: of the lifts, over the hung weight: least and most.
        stop_m: length over the free length from which the planted spring acts.
        stop_n_per_mm3: of that spring, cubic.
        electric: starts of the names of parameters that a wrong elastic force leaves alone.
        branches: key of the shares of the viscoelastic branches.
    """

    name: str
    highest_v: float
    loads: tuple[float, float]
    stop_m: float
    stop_n_per_mm3: float
    electric: tuple[str, ...]
    branches: str = "actuator.branch_share"

    @property
    def folder(self) -> Path:
        """Of its twin and study."""
        return CHECKOUT / "examples" / "kinds" / self.name

    @cached_property
    def config(self) -> TwinConfig:
        """Of the twin that is moved."""
        if self.name == "planar-hasel":
            return twin_of_reading("hz")
        return load_twin(self.folder / "twin.toml")

    @property
    def law(self) -> ActuatorLaw:
        """Of that twin, where the identification starts."""
        return self.config.law

    @property
    def mass_kg(self) -> float:
        """That hangs."""
        return self.config.load.mass_kg

    def branch(self, law: ActuatorLaw) -> dict[str, float]:
        """Share and relaxation time of one more branch than a law has."""
        k, times = len(law.losses.branch_share), self.branches.replace("share", "relaxation_s")
        return {f"{self.branches}[{k}]": BRANCH[0], f"{times}[{k}]": BRANCH[1]}

    def stopped(self, law: ActuatorLaw) -> ActuatorLaw:
        """The law with a cubic spring beyond a length."""
        from_m, stiffness = self.stop_m * self.law.free_length_m, self.stop_n_per_mm3

        class Stopped(type(law)):  # type: ignore[misc]
            def elastic_force_n(self, length_m: ArrayLike) -> Floats:
                beyond_mm = 1e3 * np.maximum(np.asarray(length_m) - from_m, 0.0)
                return np.asarray(super().elastic_force_n(length_m) + stiffness * beyond_mm**3)

            def on_grid(
                self, lengths_m: Floats, voltages_v: Floats, near: LawValues | None = None
            ) -> LawValues:
                found = super().on_grid(lengths_m, voltages_v, near)
                return replace(found, elastic_n=self.elastic_force_n(lengths_m))

        return Stopped(**{field.name: getattr(law, field.name) for field in fields(law)})

    def drawn(
        self, seed: int, planted: Callable[[ActuatorLaw], ActuatorLaw] = lambda law: law
    ) -> tuple[dict[str, float], MotionRecord]:
        """A hidden law under a short drive: its parameters, what is seen of it."""
        for attempt in range(_DRAWS):
            rng = np.random.default_rng([seed, attempt])
            truth = shifted(fitted_parameters(self.law), rng)
            try:
                hidden = with_parameters(self.law, truth)
                record, camera = seen(short_record(self, planted(hidden), seed), seed)
            except HaselabError:
                continue
            return {**truth, "load.added_inertia_kg": 0.0, **camera, "sensing.scale": 1.0}, record
        raise RuntimeError(f"None of {_DRAWS} draws of seed {seed} can be simulated.")


KINDS = {
    kind.name: kind
    for kind in (
        Kind("planar-hasel", 8000.0, (0.35, 2.8), 1.3, 3e-3, ("dielectric.",), "viscosity.share"),
        Kind(
            "peano-hasel", 7000.0, (0.3, 5.0), 1.012, 5e-2,
            ("actuator.permittivity", "actuator.half_zipped", "actuator.unzipped"),
        ),
        Kind(
            "curling-hasel", 8000.0, (0.2, 2.0), 1.005, 5e-2,
            ("actuator.permittivity", "actuator.half_zipped", "actuator.unzipped"),
        ),
        Kind("dea-stack", 9000.0, (0.2, 3.0), 1.1, 1e-3, ("actuator.permittivity",)),
    )
}  # fmt: skip


def shifted(values: dict[str, float], rng: np.random.Generator) -> dict[str, float]:
    """Move parameters, each by up to its range."""
    return {
        name: value * (1.0 + _RANGES.get(name, _RANGE) * rng.uniform(-1.0, 1.0))
        for name, value in values.items()
    }


def started(
    law: ActuatorLaw, truth: dict[str, float], rng: np.random.Generator
) -> ActuatorLaw | None:
    """A start up to 30 % off the truth, times and shares by up to 2; None outside the limits."""
    values = {}
    for name, value in truth.items():
        if "share" in name or "relaxation_s" in name:
            values[name] = value * 2.0 ** rng.uniform(-1.0, 1.0)
        else:
            values[name] = value * (1.0 + _RANGE * rng.uniform(-1.0, 1.0))
    try:
        return with_parameters(law, values)
    except LimitError:
        return None


def default_start(reading: str) -> tuple[ActuatorLaw, float | None]:
    """Law and added inertia of the default twin, where the identification starts."""
    config = twin_of_reading(reading)
    return config.law, config.load.added_inertia_kg or None


def short_drive(kind: Kind, seed: int, mass_kg: float, blocks: int) -> Drive:
    """Held random voltages, with lifts of the mass: blocks of 10 ms, a minute by default."""
    rng = np.random.default_rng([seed, 4])
    edge_s = 0.01 * np.arange(blocks + 1)
    block = np.arange(blocks)
    changes = rng.random(block.size) < np.where(block % 1000 < 300, 0.2, 0.003)
    held = np.maximum.accumulate(changes * block)
    volt = rng.uniform(0.0, kind.highest_v, block.size)[held]
    volt[:100] = 0.0
    pull_n = np.full(block.size, mass_kg * GRAVITY_M_S2)
    for k, share in enumerate(np.linspace(*kind.loads, 8), start=1):  # tell springs apart
        pull_n[block.size * k // 10 :][: blocks // 20] *= share
    volt[pull_n > 1.2 * pull_n[0]] = 0.0
    return Drive(edge_s, volt, pull_n, np.full(block.size, mass_kg), np.full(block.size, 5e3))


def short_record(
    kind: Kind,
    law: ActuatorLaw,
    seed: int,
    *,
    mass_kg: float | None = None,
    blocks: int = _SHORT_BLOCKS,
) -> MotionRecord:
    """What a camera and monitors would see of a law in a minute: the law itself, with noise.

    Args:
        kind: of the law.
        law: of the actuator.
        seed: of drive and noise.
        mass_kg: that hangs; None: the usual one.
        blocks: of 10 ms each.
    Raises:
        LimitError: The drive takes the actuator beyond the limits of its law.
    """
    drive = short_drive(kind, seed, mass_kg or kind.mass_kg, blocks)
    rng = np.random.default_rng([seed, 5])
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(0.0, float(drive.ripple_v2[0]), float(drive.load_n[0]))
    times_s = np.arange(0.0, float(drive.edge_s[-1]), 0.02)
    found = sampled.respond(drive, times_s, start)
    limits = law.length_limits_m
    if not limits.low < found.length_m.min() <= found.length_m.max() < limits.high:
        raise LimitError("The motion leaves the limits of the law.")
    count, frames = drive.voltage_v.size, times_s.size
    return MotionRecord(
        f"short {seed}", drive, times_s,
        found.length_m + _LENGTH_STD_M * rng.standard_normal(frames),
        np.full(frames, _LENGTH_STD_M), np.arange(count), np.arange(count),
        found.capacitance_f + _CAPACITANCE_STD_F * rng.standard_normal(count),
        np.full(count, _CAPACITANCE_STD_F), ("all",),
        np.zeros(frames, np.int64), np.zeros(count, np.int64),
    )  # fmt: skip


def seen(record: MotionRecord, seed: int) -> tuple[MotionRecord, dict[str, float]]:
    """A record with the errors of offset and scale that its camera is stated to have.

    The twin's camera has none, and an interval that allows for them would always be too wide.

    Returns:
        The record, and the two errors by name.
    """
    draws = np.random.default_rng([seed, 1]).standard_normal(2)
    offset_m, scale = CAMERA_BIAS_M * float(draws[0]), 1.0 + CAMERA_SCALE_STD * float(draws[1])
    return (
        replace(record, length_m=scale * record.length_m + offset_m),
        {"camera.offset_m": offset_m, "camera.scale": scale},
    )
