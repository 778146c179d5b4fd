"""Arm a rig: check the study against its limits, guard it, and ask the operator."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from haselab.base import InputError, SafetyError
from haselab.cli.options import shared_option
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.rig_file import ReplayFile, RigFile, opened_rig
from haselab.safety.armed import zero_at_end
from haselab.safety.gate import Gate
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.guardian.client import Guardians, guardian_command
from haselab.safety.rig_limits import safety_of
from haselab.safety.state_machine import ArmingRequest, Safety
from haselab.study.definition import StepStudy, Study
from haselab.study.feasibility import check_study_on_rig

__all__ = ["Operator", "acknowledge_option", "arm", "armed_rig", "arming_options", "gated_rig"]

F = TypeVar("F", bound=Callable[..., Any])


def arming_options(function: F) -> F:
    """Add `--yes` and `--acknowledge`, see `Operator`."""
    yes = shared_option(
        "--yes", is_flag=True, detail="High voltage WILL be applied at once; keep clear."
    )
    return yes(acknowledge_option(function))


def acknowledge_option(function: F) -> F:
    """Add `--acknowledge`, see `Operator`."""
    return click.option(
        "--acknowledge",
        is_flag=True,
        help="Acknowledge the reason of the last trip without being asked. Find and remove the "
        "cause first.",
    )(function)


@dataclass(frozen=True)
class Operator:
    """Who arms a bench: a person at the terminal, or options of the command line.

    Args:
        yes: energise without asking.
        acknowledge: acknowledge the reason of the last trip without asking.
    """

    yes: bool = False
    acknowledge: bool = False

    def acknowledged(self, reason: str) -> str:
        """Return the reason of the last trip, once it is acknowledged.

        Raises:
            SafetyError: the reason was not acknowledged.
        """
        if not reason:
            return ""
        if self.acknowledge:
            click.echo(f"Acknowledged: {reason}", err=True)
            return reason
        stated = f"The permission of the bench was revoked. Reason: {reason.rstrip('.')}."
        if not self.yes and _confirmed(f"{stated} Has the cause been removed?"):
            return reason
        raise SafetyError(
            f"{stated} Nothing was energised. Remove the cause, then run again with --acknowledge."
        )

    def confirm(self, request: ArmingRequest) -> None:
        """Ask whether to energise, the second step of arming.

        Raises:
            InputError: the answer is no.
        """
        warning = f"HIGH VOLTAGE WILL BE APPLIED to {request.limits} Keep clear."
        if not self.yes and not _confirmed(f"{warning} Energise?"):
            raise InputError("Not armed: the answer was no. Nothing was energised.")


def _confirmed(question: str) -> bool:
    """Ask a question at the terminal.

    Raises:
        InputError: there is no terminal, or its input has ended.
    """
    try:
        return click.confirm(question, err=True)
    except click.Abort as stop:
        if isinstance(stop.__context__, EOFError):
            raise InputError(
                "Not armed: no answer. Nothing was energised. Run in a terminal, or add --yes "
                "(and --acknowledge after a trip)."
            ) from stop
        stop.add_note("Nothing was energised.")
        raise


@contextlib.contextmanager
def gated_rig(file: RigFile, path: Path) -> Iterator[Rig]:
    """Open the rig of a file behind its gate; on exit, command 0 V and close all connections.

    Args:
        file: from `load_rig`.
        path: of the rig file.
    Raises:
        DeviceError: an instrument or its driver is missing, or another program uses the bench.
        InputError: another instrument answers than the file names.
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
    """Check a study against a rig, guard the rig, and arm it in two steps.

    A real bench gets two guardian processes, which log to `guardian.log` in the folder; a twin in
    this process needs none. A bench without a table [rating] is not checked: its limits are not
    known. A recorded session cannot energise anything, so no confirmation is needed.

    Args:
        rig: opened from the file.
        file: from `load_rig`.
        path: of the rig file.
        study: what will be played.
        folder: of the run.
        operator: who acknowledges and confirms; None: no confirmation is needed, as on a twin.
    Yields:
        The armed rig.
    Raises:
        LimitError: the study is not feasible on this bench.
        InputError: the operator did not confirm.
        SafetyError: the reason of the last trip was not acknowledged.
        DeviceError: a guardian does not start, or does not reach the bench.
    """
    judged = check_study_on_rig(file, study, path)
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
        with zero_at_end(guarded):
            arm(safety, None if isinstance(file, ReplayFile) else operator)
            yield guarded


def arm(safety: Safety, operator: Operator | None) -> None:
    """Arm a bench in two steps: request, then acknowledge and confirm.

    Args:
        safety: of the bench.
        operator: who acknowledges and confirms; None: no confirmation is needed.
    """
    request = safety.request()
    acknowledged = ""
    if operator is not None:
        acknowledged = operator.acknowledged(request.reason)
        operator.confirm(request)
    safety.arm(request, acknowledged)
