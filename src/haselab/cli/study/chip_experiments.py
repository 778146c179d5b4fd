"""Microcontroller experiments of the reference study (rows S26, S28), each in its own process.

The processes load their modules while the study plays its first experiments. The experiments start
when it has designed its controllers, and run in parallel with the rest of it.
All their inputs are files in the run's folder, with which `haselab run` repeats them.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from haselab.base import HaselabError, to_plain
from haselab.cli.study.chip_run import record_on_chip
from haselab.control import LoopSetting, PidGains
from haselab.control.feedthrough import with_feedthrough
from haselab.firmware import FrontEnd
from haselab.models.filters import lfilter
from haselab.rig.chip import ChipFile, SupplyModel, read_design
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_file import load_twin
from haselab.runtime.scheduling import lower_priority
from haselab.store.actuator_file import ACTUATOR, write_sections
from haselab.store.folder import read_json, write_json, write_text
from haselab.store.toml import toml_text
from haselab.study.chip.loops import (
    FAST,
    SLOW,
    StepPlan,
    desktop_loop,
    loop_row,
    section_of,
)
from haselab.study.chip.miniature import MiniatureDesign, design_miniature
from haselab.study.chip.rows import CHIP, EXPERIMENTS, MINIATURE
from haselab.study.definition import StepStudy, Study, load_step_study, step_study_of
from haselab.study.experiment import ExperimentResult
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.loops import Loops
from haselab.study.fits.maps import Maps
from haselab.study.folder import write_design

__all__ = ["ChipExperiments", "main"]

_END_S = 10.0
_GO = b"\n"
_PLACE = EXPERIMENTS.parent


class ChipExperiments:
    """The processes that play the microcontroller experiments.

    Args:
        folder: of the run.
        study: whose step trials the microcontroller plays.
        config: of the twin.
        seed: of its noise.
        quick: one short trial each.
        keep_video: which frames are kept.
    """

    def __init__(
        self,
        folder: Path,
        study: Study,
        config: TwinConfig,
        seed: int,
        quick: bool,
        keep_video: str,
    ) -> None:
        self._folder, self._study, self._config = folder, study, config
        self._seed, self._quick, self._keep_video = seed, quick, keep_video
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._output: dict[str, IO[bytes]] = {}
        self._found: dict[type, object] = {}
        self._started = False

    def prepare(self) -> None:
        """Start the processes, which load their modules and wait."""
        for name in (CHIP, MINIATURE):
            output = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `stop`
            self._output[name] = output
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", __name__, str(self._folder), self._keep_video, name],
                stdin=subprocess.PIPE, stdout=output, stderr=output,
                process_group=0,  # Ctrl-C is for the study, whose end ends these
            )  # fmt: skip

    def start(self, outcome: ExperimentResult) -> None:
        """Start the experiments as soon as all their inputs are known.

        Args:
            outcome: of one fit of the study.
        Raises:
            DeviceError: a file cannot be written.
        """
        self._found |= {type(value): value for value in outcome.values}
        maps, dynamics = self._found.get(Maps), self._found.get(Dynamics)
        loops = self._found.get(Loops)
        if self._started or not (maps and dynamics and loops):
            return
        self._started = True
        assert isinstance(maps, Maps) and isinstance(dynamics, Dynamics)
        assert isinstance(loops, Loops)
        write_design(self._folder, maps, dynamics, loops, self._study)
        place = self._folder / _PLACE
        write_text(place / "twin.toml", toml_text(self._config.model_dump(mode="json")))
        steps = step_study_of(self._study, quick=self._quick)
        write_text(place / "chip-steps.toml", toml_text(steps.model_dump(mode="json")))
        rig = {
            "kind": "chip",
            "run": "..",
            "simulator": {
                "twin": "twin.toml",
                "seed": self._seed,
                "precondition_v": self._study.triangle.high_v,
            },
        }
        write_text(place / "chip.toml", toml_text(rig))
        for process in self._processes.values():
            assert process.stdin is not None
            with contextlib.suppress(OSError):  # a process that has ended is reported by `finish`
                process.stdin.write(_GO)
                process.stdin.flush()

    def finish(self) -> Mapping[str, str]:
        """Wait for the end.

        Returns:
            Why an experiment was left out, by its row; the report states it, too.
        """
        if not self._started:
            return {}
        parts = []
        for name, process in self._processes.items():
            path = self._folder / _part(name)
            if process.wait() == 0:
                parts.append(read_json(path))
                path.unlink()
            else:
                self._output[name].seek(0)
                lines = self._output[name].read().decode(errors="replace").strip().splitlines()
                why = f"its process ended early: {lines[-1] if lines else 'no message'}."
                parts.append({"left_out": {name: why}})
        known = _joined(parts)
        write_json(self._folder / EXPERIMENTS, known)
        left_out = known["left_out"]
        rows = ((CHIP, "S26"), (MINIATURE, "S28"))
        return {row: str(left_out[name]) for name, row in rows if name in left_out}

    def stop(self) -> None:
        """End the processes, whatever their state."""
        for process in self._processes.values():
            assert process.stdin is not None
            if not self._started:
                process.kill()  # it may still load its modules, and has opened nothing
            with contextlib.suppress(OSError):
                process.stdin.close()  # at the end of its input, it ends
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        for output in self._output.values():
            output.close()


def main(folder: Path, keep_video: str, name: str) -> None:
    """Play an experiment and write what is known of it; the chip's step also with desktop loops.

    Args:
        folder: of the run, with actuator.toml and the files of `ChipExperiments`.
        keep_video: which frames are kept.
        name: of the experiment.
    """
    place = folder / _PLACE
    steps = load_step_study(place / "chip-steps.toml")
    known = _joined([])
    try:
        if name == CHIP:
            file = _chip_file(place / "chip.toml")
            record_on_chip(steps, file, place / "chip.toml", folder / CHIP, keep_video)
            known["desktops"][CHIP] = _desktops(file, place, steps)
        else:
            design = _write_miniature(folder, steps)
            known["notes"][MINIATURE] = _scaled(design)
            at = place / "miniature.toml"
            smaller = load_step_study(place / "miniature-steps.toml")
            record_on_chip(smaller, _chip_file(at), at, folder / MINIATURE, keep_video)
    except HaselabError as error:  # which leaves the other experiment and the study as they are
        known["left_out"][name] = " ".join(str(error).split())
    write_json(folder / _part(name), to_plain(known))


def _part(name: str) -> Path:
    """What the process of an experiment leaves for `ChipExperiments.finish`."""
    return _PLACE / f"{name}.json"


def _joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Content of experiments.json."""
    known: dict[str, dict[str, Any]] = {"left_out": {}, "notes": {}, "desktops": {}}
    for part in parts:
        for key, found in part.items():
            known[key] |= found
    return known


def _chip_file(path: Path) -> ChipFile:
    file = load_rig(path)
    assert isinstance(file, ChipFile)
    return file


def _desktops(file: ChipFile, place: Path, steps: StepStudy) -> dict[str, Any]:
    """Play the same step with the desktop's loops, at 100 Hz and at the chip's rate."""
    assert file.simulator is not None
    found = read_design(place.parent, file.structure, FrontEnd())
    settings = found.settings
    trials = steps.step_trials
    plan = StepPlan(0.0, trials.step, trials.zero_s, trials.step_s, found.zero_length_m,
                    file.simulator.precondition_v)  # fmt: skip
    config, seed = load_twin(place / "twin.toml"), file.simulator.seed
    runs = [desktop_loop(config, seed, settings, desk, plan) for desk in (SLOW, FAST)]
    gains = None
    if settings.own is None:
        gains = PidGains(settings.kp, settings.ki, settings.kd, settings.derivative_filter_s)
    feedthrough = with_feedthrough(LoopSetting(), found.tables).feedthrough
    rows = [loop_row(run, gains, found.plant, feedthrough) for run in runs]
    section = section_of(runs, rows)
    return {"loops": section["loops"], "metrics": section["metrics"]}


def _write_miniature(folder: Path, steps: StepStudy) -> MiniatureDesign:
    """Write maps, gains, rig and steps of the miniature bench to files."""
    place, supply = folder / _PLACE, SupplyModel()
    chip = _chip_file(place / "chip.toml")
    assert chip.simulator is not None
    found = read_design(folder, chip.structure, FrontEnd())
    design = design_miniature(found.tables, supply, FrontEnd().gain)
    write_sections(place / MINIATURE / ACTUATOR, design.sections)
    rig = {
        "kind": "chip",
        "name": "miniature bench",
        "run": MINIATURE,
        "drive_high_v": design.drive_high_v,
        "rise_v_per_s": design.rise_v_per_s,
        "simulator": {
            **chip.simulator.model_dump(exclude_none=True),
            "supply": supply.model_dump(),
        },
    }
    write_text(place / "miniature.toml", toml_text(rig))
    scaled = steps.step_trials.model_copy(update={"step": design.step})
    changed = steps.model_copy(update={"step_trials": scaled, "name": "miniature bench"})
    write_text(place / "miniature-steps.toml", toml_text(changed.model_dump(mode="json")))
    return design


def _scaled(design: MiniatureDesign) -> str:
    return (
        f"the supply reaches {1e-3 * design.highest_v:g} kV, so the step is {design.step:g}, about "
        f"{1e-3 * design.baseline_v:.3g} to {1e-3 * design.top_v:.3g} kV in the model; its zero is "
        f"the study's strain of {design.zero_strain:.3g}"
    )


def _end_with_the_study() -> None:
    """End this process when the study, at the other end of its standard input, has ended."""
    while os.read(0, 4096):  # not by sys.stdin, whose lock would be held when this process ends
        pass
    os._exit(1)


if __name__ == "__main__":
    lower_priority()  # the study, which takes longest, goes first
    lfilter([1.0], [1.0], [0.0])  # loads scipy.signal, which the experiments need
    gc.freeze()  # the garbage collector need not look at the modules again
    if os.read(0, len(_GO)) != _GO:  # the study has ended without the experiments
        sys.exit(1)
    threading.Thread(target=_end_with_the_study, daemon=True).start()
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
