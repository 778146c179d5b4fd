"""Step trials on a microcontroller, which closes its own loop: for `run` and `analyse`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import cast

from haselab.base import JsonObject
from haselab.cli.bench.arming import Operator, armed_rig
from haselab.cli.common import progress_bar
from haselab.cli.interrupt import Interruptible
from haselab.cli.study.study_run import check_folder, kept_data_note, print_results
from haselab.rig.chip import ChipFile, opened_chip
from haselab.runtime.camera_recorder import KeepVideo
from haselab.safety.gate import Gate
from haselab.store.session.writer import SessionReader
from haselab.study.chip.trials import (
    Chip,
    analyse_chip_session,
    run_on_chip,
    write_chip_findings,
)
from haselab.study.definition import StepStudy
from haselab.study.run import RunOptions

__all__ = ["analyse_on_chip", "play_on_chip", "record_on_chip"]


def play_on_chip(
    study: StepStudy,
    file: ChipFile,
    path: Path,
    folder: Path,
    keep_video: str,
    operator: Operator | None,
    as_json: bool,
) -> None:
    """Play step trials on a microcontroller, write the folder, print the table.

    Args:
        study: what is played.
        file: the rig file.
        path: of it.
        folder: of the run.
        keep_video: which frames are kept.
        operator: who arms it; None: no confirmation is needed.
        as_json: print JSON.
    """
    print_results(record_on_chip(study, file, path, folder, keep_video, operator), folder, as_json)


def record_on_chip(
    study: StepStudy,
    file: ChipFile,
    path: Path,
    folder: Path,
    keep_video: str,
    operator: Operator | None = None,
) -> JsonObject:
    """Play step trials on a microcontroller and write the folder, without report and table.

    Args:
        study: what is played.
        file: the rig file.
        path: of it.
        folder: of the run.
        keep_video: which frames are kept.
        operator: who arms it; None: no confirmation is needed.
    Returns:
        The content of results.json.
    """
    check_folder(folder)
    options = RunOptions(folder, _seed(file), cast(KeepVideo, keep_video),
                         file.model_dump(mode="json"))  # fmt: skip
    with contextlib.ExitStack() as opening:
        opened = opening.enter_context(opened_chip(file, path, Gate()))
        controller = opened.rig.controller
        assert controller is not None
        controller.strain_limits.check([0.0, study.step_trials.step])
        bench = opening.enter_context(armed_rig(opened.rig, file, path, study, folder, operator))
        chip = Chip(opened.settings, opened.zero_length_m)
        progress = Interruptible(progress_bar())
        try:
            found, header = run_on_chip(study, bench, chip, options, progress)
        except KeyboardInterrupt as stop:
            stop.add_note(kept_data_note(folder))
            raise
        finally:
            bench.safe()
            progress.stop()
    return write_chip_findings(folder, found, header)


def _seed(file: ChipFile) -> int:
    return 0 if file.simulator is None else file.simulator.seed


def analyse_on_chip(session: SessionReader, target: Path, as_json: bool) -> None:
    """Repeat the results from the recorded session, and print the table.

    Args:
        session: of a run on a chip.
        target: folder of the results.
        as_json: print JSON.
    """
    found, header = analyse_chip_session(session)
    print_results(write_chip_findings(target, found, header, session.doubt), target, as_json)
