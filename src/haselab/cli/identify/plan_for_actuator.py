"""`haselab plan-experiment A.toml`: the study that determines a parameter of an actuator."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError, JsonObject, ResultError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.common import emit
from haselab.pipelines.planning.actuator_file import planner_of
from haselab.pipelines.planning.proposal import DETERMINED, Planner, Proposal
from haselab.store.folder import write_text
from haselab.store.toml import toml_text

__all__ = ["plan_for_actuator"]

_NOT_BELOW = 1.05  # a number times this one, with two digits, is never below the number


def plan_for_actuator(
    path: Path, goal: str, std: float | None, *, as_json: bool, out: Path | None
) -> None:
    """Propose a study for a parameter of `[model.physical]`, print it and write its file.

    Args:
        path: of the actuator file.
        goal: name of the parameter.
        std: relative standard deviation to be reached; None: `DETERMINED`.
        as_json: print JSON.
        out: study file to write; None: none.
    Raises:
        InputError: The file has no usable model, the parameter is unknown, or it is known well
            enough already.
        ResultError: No experiment improves what is known of the parameter, or none improves it
            enough; the best one is printed and written all the same.
    """
    wanted = DETERMINED if std is None else std
    if not 0.0 < wanted < float("inf"):
        raise InputError(f"--std is {wanted:g}. Use a relative standard deviation above 0.")
    planner = _planner(path)
    if goal not in planner.names():
        raise InputError(
            f"--goal is {goal}, but must be a parameter of [model.physical]: "
            f"{', '.join(planner.names())}. {path}"
        )
    before = planner.before()[goal]
    if before <= wanted:
        raise InputError(
            f"{goal} is known already, with a relative standard deviation of {before:.2g}; --std "
            f"is {wanted:g}. Set --std below {before:.2g}. {path}"
        )
    proposal = planner.propose(goal, wanted)
    if proposal is None:
        raise ResultError(
            f"No experiment of the catalogue reduces the standard deviation of {goal} by a tenth "
            f"within a drive of {planner.within.highest_v:g} V. Raise drive.high_v if the actuator "
            f"withstands more, or measure {goal} in another way. {path}"
        )
    text = toml_text(proposal.candidate.file(f"experiment for {goal}"))
    if out is not None:
        write_text(out, text)
    if as_json:
        emit(_answer(proposal, planner), as_json=True, out=None)
    else:
        click.echo("\n".join(_page(proposal, text)))
    if proposal.status != "ok":
        raise ResultError(
            f"{proposal.status}. Play that study and plan again, or raise --std to at least "
            f"{_NOT_BELOW * proposal.after:.2g}. {path}"
        )


def _planner(path: Path) -> Planner:
    tables = load_actuator(path)
    physical = None if tables.model is None else tables.model.physical
    if physical is None:
        raise InputError(
            "The actuator file has no [model.physical]. Add it with: haselab identify actuator "
            f"RUN --actuator {path}"
        )
    return planner_of(tables.actuator, physical, tables.drive_ends_v, path)


def _answer(proposal: Proposal, planner: Planner) -> JsonObject:
    return {"goal": proposal.parameter, **proposal.answer(), "highest_v": planner.within.highest_v}


def _page(proposal: Proposal, text: str) -> list[str]:
    return [
        f"{proposal.parameter}: {proposal.text}",
        *proposal.notes,
        "",
        text.rstrip(),
    ]
