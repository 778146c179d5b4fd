"""Hidden twins of `physical_model`: drawn, played, and remembered as one motion each."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from haselab.actuators import (
    ADDED_INERTIA,
    GRAVITY_M_S2,
    ActuatorLaw,
    Drive,
    PlanarHasel,
    SampledLaw,
    with_parameters,
)
from haselab.base import HaselabError, LimitError, SilentProgress
from haselab.identify.physical import MotionRecord
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.pipelines.motion import motion_of_session
from haselab.rig.twin.config import READINGS, TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.reader import SessionReader
from haselab.store.toml import validated
from haselab.study.definition import builtin_study
from haselab.study.run import RunOptions, run_study

__all__ = [
    "CAMERA_BIAS_M",
    "CAMERA_SCALE_STD",
    "MASS_KG",
    "Twin",
    "default_start",
    "load_record",
    "save_record",
    "seen",
    "shifted",
    "short_record",
    "started",
    "true_values",
]

MASS_KG = 0.25
CAMERA_BIAS_M, CAMERA_SCALE_STD = 2e-6, 5e-5  # what `fit_actuator` assumes
_RANGE = 0.3
_RANGES = {
    "shell.length_m": 0.1,
    "dielectric.capacitance_exponent": 0.1,
    "dielectric.permittivity": 0.15,
    "shell.locking_stretch": 0.15,
    "mullins.stretch": 0.05,
}
_DRAWS = 50
_SHORT_BLOCKS = 6000
_LENGTH_STD_M, _CAPACITANCE_STD_F = 4e-6, 3e-13  # of the twin's camera and monitors
_DRIVE = ("edge_s", "voltage_v", "load_n", "mass_kg", "ripple_v2")
_SEEN = ("length_time_s", "length_m", "length_std_m", "window", "window_of", "capacitance_f",
         "capacitance_std_f", "length_experiment", "capacitance_experiment",
         "capacitance_later_s")  # fmt: skip


def shifted(values: dict[str, float], rng: np.random.Generator) -> dict[str, float]:
    """Move parameters, each by up to its range."""
    return {
        name: value * (1.0 + _RANGES.get(name, _RANGE) * rng.uniform(-1.0, 1.0))
        for name, value in values.items()
    }


def default_start(reading: str) -> tuple[PlanarHasel, float | None]:
    """Law and added inertia where the identification starts: those of the default twin."""
    config = twin_of_reading(reading)
    return config.planar_hasel, config.load.added_inertia_kg or None


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


class Twin:
    """A hidden twin in a folder: twin.json, truth.json, record.npz.

    Args:
        folder: of all files.
        reading: of the frequency axis.
        seed: of the parameters and of the noise.
        branch: share and relaxation time of a further branch; None: there is none.
    """

    def __init__(
        self, folder: Path, reading: str, seed: int, branch: tuple[float, float] | None = None
    ) -> None:
        self.folder, self.reading, self.seed, self.branch = folder, reading, seed, branch

    def _draw(self, attempt: int) -> tuple[TwinConfig, dict[str, float]]:
        rng = np.random.default_rng([self.seed, attempt])
        usual = READINGS[self.reading]
        truth = shifted(fitted_parameters(twin_of_reading(self.reading).planar_hasel), rng)
        if self.branch is not None:
            share, relaxation_s = self.branch
            truth |= {"viscosity.share[3]": share, "viscosity.relaxation_s[3]": relaxation_s}
        law = with_parameters(PlanarHasel(), truth)
        data: dict[str, Any] = {"reading": self.reading}
        for key, value in law.parameters().items():
            section, _, name = key.partition(".")
            data.setdefault(section, {})[name] = value
        inertia_kg = usual["load"]["added_inertia_kg"] * (1.0 + _RANGE * rng.uniform(-1.0, 1.0))
        data["load"] = {"mass_kg": MASS_KG, "added_inertia_kg": inertia_kg}
        return validated(TwinConfig, data, "hidden twin"), truth | {ADDED_INERTIA: inertia_kg}

    def record(self) -> MotionRecord:
        """The motion of a quick study, played unless it has been."""
        if not (self.folder / "record.npz").exists():
            self._play()
        return load_record(self.folder / "record.npz")

    @property
    def truth(self) -> dict[str, float]:
        """Parameters of the twin; read by the benchmark only."""
        found: dict[str, float] = json.loads((self.folder / "truth.json").read_text())
        return found

    def _play(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for attempt in range(_DRAWS):
            run = self.folder / "run"
            shutil.rmtree(run, ignore_errors=True)
            try:
                config, truth = self._draw(attempt)
                record = _played(config, self.seed, run)
            except HaselabError as error:
                print(f"seed {self.seed}, draw {attempt} cannot be played: {error}", flush=True)
                continue
            (self.folder / "truth.json").write_text(json.dumps(truth))
            (self.folder / "twin.json").write_text(config.model_dump_json())
            save_record(self.folder / "record.npz", record)
            shutil.rmtree(run)
            return
        raise RuntimeError(f"None of {_DRAWS} draws of seed {self.seed} can be played.")


def _played(config: TwinConfig, seed: int, run: Path) -> MotionRecord:
    """Play the quick study with frames and monitor samples, and join its experiments."""
    rig = guard(make_twin(config, seed), Safety(SafetySettings()))
    arm_simulated(rig)
    options = RunOptions(run, seed, "none", config.model_dump(mode="json"))
    run_study(builtin_study(quick=True), rig, options, SilentProgress())
    with SessionReader(run) as reader:
        return motion_of_session(reader, run)


def save_record(path: Path, record: MotionRecord) -> None:
    """Keep a motion without its raw samples."""
    arrays = {f"drive.{name}": getattr(record.drive, name) for name in _DRIVE}
    arrays |= {name: getattr(record, name) for name in _SEEN}
    np.savez_compressed(
        path, name=record.name, experiments=np.array(record.experiments),
        exposure_s=record.exposure_s, pixel_m=record.pixel_m, **arrays,
    )  # fmt: skip


def load_record(path: Path) -> MotionRecord:
    """Read what `save_record` kept."""
    with np.load(path) as kept:
        drive = Drive(*(kept[f"drive.{name}"] for name in _DRIVE))
        return MotionRecord(
            name=str(kept["name"]), drive=drive,
            experiments=tuple(map(str, kept["experiments"])),
            exposure_s=float(kept["exposure_s"]), pixel_m=float(kept["pixel_m"]),
            **{name: kept[name] for name in _SEEN},
        )  # fmt: skip


def short_drive(seed: int, mass_kg: float = MASS_KG) -> Drive:
    """A minute of held random voltages, with lifts of the mass: blocks of 10 ms."""
    rng = np.random.default_rng([seed, 4])
    edge_s = 0.01 * np.arange(_SHORT_BLOCKS + 1)
    block = np.arange(_SHORT_BLOCKS)
    changes = rng.random(block.size) < np.where(block % 1000 < 300, 0.2, 0.003)
    held = np.maximum.accumulate(changes * block)
    volt = rng.uniform(0.0, 8000.0, block.size)[held]
    volt[:100] = 0.0
    pull_n = np.full(block.size, mass_kg * GRAVITY_M_S2)
    for k in range(1, 9):  # loads tell the shell from the electrodes
        pull_n[block.size * k // 10 :][:300] *= 0.35 * k
    volt[pull_n > 1.2 * pull_n[0]] = 0.0
    return Drive(edge_s, volt, pull_n, np.full(block.size, mass_kg), np.full(block.size, 5e3))


def short_record(
    law: ActuatorLaw, seed: int, scale: float = 1.0, mass_kg: float = MASS_KG
) -> MotionRecord:
    """What a camera and monitors would see of a law in a minute: the law itself, with noise.

    Args:
        law: of the actuator.
        seed: of drive and noise.
        scale: measured over true capacitance.
        mass_kg: that hangs.
    Raises:
        LimitError: The drive takes the actuator beyond the limits of its law.
    """
    drive, rng = short_drive(seed, mass_kg), np.random.default_rng([seed, 5])
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(0.0, float(drive.ripple_v2[0]), float(drive.load_n[0]))
    times_s = np.arange(0.0, float(drive.edge_s[-1]), 0.02)
    found = sampled.respond(drive, times_s, start)
    if (
        not law.length_limits_m.low
        < found.length_m.min()
        <= found.length_m.max()
        < (law.length_limits_m.high)
    ):
        raise LimitError("The motion leaves the limits of the law.")
    count, frames = drive.voltage_v.size, times_s.size
    return MotionRecord(
        f"short {seed}", drive, times_s,
        found.length_m + _LENGTH_STD_M * rng.standard_normal(frames),
        np.full(frames, _LENGTH_STD_M), np.arange(count), np.arange(count),
        scale * found.capacitance_f + _CAPACITANCE_STD_F * rng.standard_normal(count),
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


def true_values(truth: dict[str, float], camera: dict[str, float]) -> dict[str, float]:
    """All true values that are known, by the names of the estimates."""
    return {**truth, **camera, "sensing.scale": 1.0}
