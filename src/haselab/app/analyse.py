"""`haselab analyse`: fits, designs and report again from the recorded data alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from haselab.app.chip_run import analyse_on_chip
from haselab.app.common import answer_options, tell_doubt, unverified_option
from haselab.app.output import OutputRule
from haselab.app.study_run import tell
from haselab.base import InputError
from haselab.store.folder import read_json
from haselab.store.session import SessionReader
from haselab.study.chip import is_chip_session
from haselab.study.folder import write_findings
from haselab.study.run import analyse_session

__all__ = ["command"]


def _own_folder(parameters: Mapping[str, Any]) -> Path:
    """The folder of the session, whose derived files are written anew."""
    session: Path = parameters["session"]
    return session if session.is_dir() else session.parent


def _check_ends(session: SessionReader, path: Path) -> None:
    """Refuse a recording that was cut short: half a trial must not pass for a whole one."""
    told = [what.partition(" ")[::2] for _, what in session.events()]
    ended = {name for verb, name in told if verb == "end"}
    cut = [name for verb, name in told if verb == "start" and name not in ended]
    if cut:
        raise InputError(
            f"The recording of {', '.join(cut)} was cut short; the analysis needs whole ones. Run "
            f"the study again, or read what is there with haselab.store.session. {path}"
        )


@click.command("analyse")
@click.argument("session", type=click.Path(path_type=Path))
@answer_options(OutputRule("any", own=_own_folder), "Folder for the results.")
@unverified_option
def command(session: Path, unverified: bool, as_json: bool, out: Path | None) -> None:
    """Repeat all fits from SESSION, a run's folder or its session.h5, and write the report.

    The results go to a new folder --out, or over those in the folder of the session, whose
    recording is never changed. What the twin's truth
    was cannot be told from recorded data; where an earlier results.json has it, it is kept.
    """
    folder = session if session.is_dir() else session.parent
    path = folder / "session.h5" if session.is_dir() else session
    with SessionReader(path, unverified=unverified) as recorded:
        tell_doubt(recorded.doubt, path)
        _check_ends(recorded, path)
        doubt = recorded.doubt
        if is_chip_session(recorded.header):
            analyse_on_chip(recorded, out or folder, as_json)
            return
    found, study, header = analyse_session(session, unverified=unverified)
    truth = None
    try:
        rows = read_json(folder / "results.json")["quantities"]
        truth = {row["id"]: row["truth"] for row in rows if "truth" in row} or None
    except (InputError, KeyError, TypeError):
        pass  # recorded without a results.json beside it: there is no truth to keep
    target = out or folder
    tell(write_findings(target, found, study, header, truth, doubt), target, as_json)
