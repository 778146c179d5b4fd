"""`haselab analyse`: fits, designs and report again from the recorded data alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, tell_doubt, unverified_option
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_run import analyse_on_chip
from haselab.cli.study.recommended_mass import with_mass_limit
from haselab.cli.study.study_run import mark_found, tell, with_date
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import read_json
from haselab.store.session.reader import session_file
from haselab.store.session.writer import SessionReader
from haselab.study.chip.rows import with_chip_rows
from haselab.study.chip.trials import is_chip_session
from haselab.study.folder import write_findings
from haselab.study.run import analyse_session

__all__ = ["command"]


def _own_folder(parameters: Mapping[str, Any]) -> Path | None:
    """The folder of the session, whose derived files are written anew; None: it is not its own.

    The folder in which a copy of a session lies may hold the results of another one.
    """
    session: Path = parameters["session"]
    if session.is_dir():
        return session
    own = session.parent / "session.h5"
    if session.name == own.name or not session.exists():  # which the reader says
        return session.parent
    return session.parent if own.exists() and session.samefile(own) else None


def _check_ends(session: SessionReader, path: Path) -> None:
    """Refuse a recording that was cut short: half a trial must not pass for a whole one."""
    told = [what.partition(" ")[::2] for _, what in session.events()]
    ended = {name for verb, name in told if verb == "end"}
    cut = [name for verb, name in told if verb == "start" and name not in ended]
    if cut:
        raise InputError(
            f"The recording of {', '.join(cut)} was cut short; the analysis needs whole ones. Run "
            "the study again, or read what is there with 'haselab sense --experiment NAME' or "
            f"'haselab session export'. {path}"
        )


@click.command("analyse")
@click.argument("session", type=click.Path(path_type=Path))
@answer_options(OutputRule("folder", own=_own_folder), "Folder for the results.")
@unverified_option
def command(session: Path, unverified: bool, as_json: bool, out: Path | None) -> None:
    """Repeat all fits from SESSION, a run's folder or its session.h5, and write the report.

    The results go to a new folder --out, or over those in the folder of the session, whose
    recording is never changed. What the twin's truth
    was cannot be told from recorded data; where an earlier results.json has it, it is kept.
    """
    folder = _own_folder({"session": session})
    if out is None and folder is None:
        raise InputError(
            f"Results are written beside a session.h5; this file has another name, and the results "
            f"there may be those of another session. Give --out DIR. {session}"
        )
    target = out or folder
    assert target is not None
    refuse_linked_folders(target, "figures", "firmware")
    path = session_file(session)
    with SessionReader(path, unverified=unverified) as recorded:
        tell_doubt(recorded.doubt, path)
        _check_ends(recorded, path)
        doubt = recorded.doubt
        if is_chip_session(recorded.header):
            analyse_on_chip(recorded, target, as_json)
            return
    found, study, header = analyse_session(session, unverified=unverified)
    if study.is_reference:
        found = with_chip_rows(found, folder)
    found = with_mass_limit(found, study, header["rig_config"])
    noise_free = None if folder is None else _earlier_noise_free(folder)
    header = with_date(header, path.parent)
    results = write_findings(target, found, study, header, noise_free, doubt)
    mark_found(target, found, path.parent, simulated=bool(results["simulated"]))
    tell(results, target, as_json)


def _earlier_noise_free(folder: Path) -> dict[str, float] | None:
    """What the twin gave without noise, from the results that lie beside the session."""
    try:
        rows = read_json(folder / "results.json")["quantities"]
        return {row["id"]: row["noise_free"] for row in rows if "noise_free" in row} or None
    except (InputError, KeyError, TypeError):
        return None  # no results.json beside it: nothing to keep
