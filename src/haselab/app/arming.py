"""From a rig file to a rig that is guarded, judged and armed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from haselab.app.feasibility import judge_rig, safety_of
from haselab.base import InputError, SafetyError
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.rig_file import RigFile, opened_rig
from haselab.safety.gate import Gate
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.guardian import Guardians, guardian_command
from haselab.safety.state_machine import ArmingRequest, Safety
from haselab.study.definition import StepStudy, Study

__all__ = ["Operator", "arm", "armed_rig", "arming_options", "gated_rig"]

F = TypeVar("F", bound=Callable[..., Any])


def arming_options(function: F) -> F:
    """Add `--yes` and `--acknowledge`, see `Operator`."""
    yes = click.option(
        "--yes",
        is_flag=True,
        help="Skip the confirmation. High voltage WILL be applied; keep clear.",
    )
    acknowledge = click.option(
        "--acknowledge",
        is_flag=True,
        help="Acknowledge without a question why the bench was made safe. Remove the cause first.",
    )
    return yes(acknowledge(function))


@dataclass(frozen=True)
class Operator:
    """Who arms a bench: a person at the terminal, or options of the command line.

    Args:
        yes: the second step needs no answer.
        acknowledge: the reason of the last trip needs no answer.
    """

    yes: bool = False
    acknowledge: bool = False

    def acknowledged(self, reason: str) -> str:
        """The reason for which the bench was made safe, once it was acknowledged.

        Raises:
            SafetyError: it was not.
        """
        if not reason:
            return ""
        if self.acknowledge:
            click.echo(f"Acknowledged: {reason}", err=True)
            return reason
        if not self.yes and click.confirm(
            f"The bench was made safe: {reason}. Has the cause been removed?", err=True
        ):
            return reason
        raise SafetyError(
            f"The bench was made safe: {reason}. Nothing was energised. Remove the cause, then "
            "run again with --acknowledge."
        )

    def confirm(self, request: ArmingRequest) -> None:
        """The second step of arming.

        Raises:
            InputError: the answer was no.
        """
        question = f"High voltage will be applied ({request.limits}). Keep clear. Energise?"
        if not self.yes and not click.confirm(question, err=True):
            raise InputError("Not armed: the answer was no. Nothing was energised.")


@contextlib.contextmanager
def gated_rig(file: RigFile, path: Path) -> Iterator[Rig]:
    """The rig of a file behind its gate; leaving the context is 0 V and all connections closed.

    Args:
        file: from `load_rig`.
        path: of the rig file.
    Raises:
        DeviceError: an instrument or its driver is missing, or another program uses the bench.
        InputError: another instrument than the file names.
    """
    with opened_rig(file, path, Gate()) as rig:
        yield rig


@contextlib.contextmanager
def armed_rig(
    rig: Rig,
    file: RigFile,
    path: Path,
    study: Study | StepStudy,
    folder: Path,
    operator: Operator | None = None,
) -> Iterator[GuardedRig]:
    """Judge a study on a rig, put the rig behind its safety chain, arm it in two steps.

    A real bench gets two guardian processes whose log is `guardian.log` in the folder; a twin in
    this process ends with it. A bench without a table [rating] is not judged: its limits are not
    known.

    Args:
        rig: opened from the file.
        file: from `load_rig`.
        path: of the rig file.
        study: what will be played.
        folder: of the run.
        operator: who acknowledges and confirms; None: nobody has to, as on a twin.
    Raises:
        LimitError: the study is not feasible on this bench.
        InputError: the second step was refused.
        SafetyError: the reason of the last trip was not acknowledged.
        DeviceError: a guardian does not start, or does not reach the bench.
    """
    judged = judge_rig(file, study, path)
    if judged is not None:
        judged.require()
    settings = safety_of(file, getattr(file, "safety", {}), path)
    with contextlib.ExitStack() as opened:
        guarded = guard(rig, Safety(settings))
        safety = guarded.safety
        if isinstance(file, BenchConfig):
            safety.guardians = opened.enter_context(
                Guardians(guardian_command(path), folder / "guardian.log", safety.gate.interlock)
            )
        arm(safety, operator)
        try:
            yield guarded
        finally:
            guarded.safe()
            safety.end_run()


def arm(safety: Safety, operator: Operator | None) -> None:
    """Both steps of arming.

    Args:
        safety: of the bench.
        operator: who acknowledges and confirms; None: nobody has to.
    """
    request = safety.request()
    acknowledged = ""
    if operator is not None:
        acknowledged = operator.acknowledged(request.reason)
        operator.confirm(request)
    safety.arm(request, acknowledged)
