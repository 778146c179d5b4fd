"""Hidden twins of `physical_model`: drawn, played, and remembered as one motion each."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.identification.physical_kinds import Kind, shifted
from haselab.actuators import ADDED_INERTIA, Drive, with_parameters
from haselab.base import HaselabError, SilentProgress
from haselab.identify.physical import MotionRecord
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.pipelines.motion import motion_of_session
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.reader import SessionReader
from haselab.store.toml import validated
from haselab.study.definition import Study, builtin_study, load_study
from haselab.study.run import RunOptions, run_study

__all__ = ["Twin", "load_record", "save_record"]

_RANGE = 0.3  # of the added inertia
_DRAWS = 50
_DRIVE = ("edge_s", "voltage_v", "load_n", "mass_kg", "ripple_v2")
_SEEN = ("length_time_s", "length_m", "length_std_m", "window", "window_of", "capacitance_f",
         "capacitance_std_f", "length_experiment", "capacitance_experiment",
         "capacitance_later_s", "window_weight")  # fmt: skip


class Twin:
    """A hidden twin in a folder: twin.json, truth.json, record.npz.

    Args:
        folder: of all files.
        kind: of the actuator.
        seed: of the parameters and of the noise.
        reading: of the frequency axis, of a planar HASEL.
    """

    def __init__(self, folder: Path, kind: Kind, seed: int, reading: str = "hz") -> None:
        self.folder, self.kind, self.seed, self.reading = folder, kind, seed, reading

    @property
    def usual(self) -> TwinConfig:
        """The twin that is moved."""
        planar = self.kind.name == "planar-hasel"
        return twin_of_reading(self.reading) if planar else self.kind.config

    def _draw(self, attempt: int) -> tuple[TwinConfig, dict[str, float]]:
        rng = np.random.default_rng([self.seed, attempt])
        usual = self.usual
        truth = shifted(fitted_parameters(usual.law), rng)
        law = with_parameters(usual.law, truth)
        data: dict[str, Any] = usual.model_dump(mode="json")
        for key, value in law.parameters().items():
            section, _, name = key.partition(".")
            data[section][name] = value
        inertia_kg = usual.load.added_inertia_kg * (1.0 + _RANGE * rng.uniform(-1.0, 1.0))
        data["load"] |= {"added_inertia_kg": inertia_kg}
        return validated(TwinConfig, data, "hidden twin"), truth | {ADDED_INERTIA: inertia_kg}

    @property
    def study(self) -> Study:
        """In its quick form."""
        if self.kind.name == "planar-hasel":
            return builtin_study(quick=True)
        return load_study(self.kind.folder / "study.toml", quick=True)

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
                record = _played(config, self.study, self.seed, run)
            except HaselabError as error:
                print(f"seed {self.seed}, draw {attempt} cannot be played: {error}", flush=True)
                continue
            (self.folder / "truth.json").write_text(json.dumps(truth))
            (self.folder / "twin.json").write_text(config.model_dump_json())
            save_record(self.folder / "record.npz", record)
            shutil.rmtree(run)
            return
        raise RuntimeError(f"None of {_DRAWS} draws of seed {self.seed} can be played.")


def _played(config: TwinConfig, study: Study, seed: int, run: Path) -> MotionRecord:
    """Play the quick study with frames and monitor samples, and join its experiments."""
    rig = guard(make_twin(config, seed), Safety(SafetySettings()))
    arm_simulated(rig)
    options = RunOptions(run, seed, "none", config.model_dump(mode="json"))
    run_study(study, rig, options, SilentProgress()).require_complete()
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
