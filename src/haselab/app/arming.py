"""From a rig file to a rig that is guarded, judged and armed."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from haselab.app.feasibility import judge_rig, safety_of
from haselab.base import InputError
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.rig_file import RigFile
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.guardian import CommandHand, Guardian
from haselab.safety.state_machine import Safety
from haselab.study.definition import StepStudy, Study

__all__ = ["armed_rig", "bench_hand"]

_MAKE_SAFE_S = 10.0  # three instruments over a network


def bench_hand(path: Path) -> CommandHand:
    """What a guardian does to a real bench.

    Args:
        path: of the rig file.
    Returns:
        The command that waits, with its connections open.
    """
    command = (sys.executable, "-m", "haselab.app.stand_by", str(path.resolve()))
    return CommandHand(command, _MAKE_SAFE_S, waits=True)


@contextlib.contextmanager
def armed_rig(
    rig: Rig,
    file: RigFile,
    path: Path,
    study: Study | StepStudy,
    folder: Path,
    confirm: Callable[[str], bool] = lambda words: True,
) -> Iterator[GuardedRig]:
    """Judge a study on a rig, put the rig under guard, arm it in two steps.

    A real bench gets a guardian process whose log is `guardian.log` in the folder; a twin in this
    process ends with it. A bench without a table [rating] is not judged: nobody knows its limits.

    Args:
        rig: opened from the file.
        file: from `load_rig`.
        path: of the rig file.
        study: what will be played.
        folder: of the run.
        confirm: the second step, asked with what would be energised.
    Raises:
        LimitError: the study is not feasible on this bench.
        InputError: the second step was refused.
        DeviceError: the guardian does not start, or a hand of it reaches nothing.
    """
    judged = judge_rig(file, study, path)
    if judged is not None:
        judged.require()
    with contextlib.ExitStack() as opened:
        guardian = None
        if isinstance(file, BenchConfig):
            guardian = opened.enter_context(Guardian([bench_hand(path)], folder / "guardian.log"))
        settings = safety_of(file, getattr(file, "safety", {}), path)
        guarded = guard(rig, Safety(settings, guardian))
        permit = guarded.safety.request()
        if not confirm(permit.words):
            raise InputError(f"Not armed: the answer was no ({permit.words}). Nothing was done.")
        guarded.safety.arm(permit)
        try:
            yield guarded
        finally:
            guarded.safe()
            guarded.safety.rest()
