"""`haselab analyse`: repeat fits, design and report from a recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from haselab.base import InputError, table_at
from haselab.cli.common import answer_options, unverified_option, warn_unverified
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_run import analyse_on_chip
from haselab.cli.study.physical_model import identify_physical_model, note_no_model
from haselab.cli.study.recommended_mass import with_mass_limit
from haselab.cli.study.study_run import mark_found, print_results, require_complete, with_date
from haselab.store.claim import refuse_linked_folders
from haselab.store.folder import read_json
from haselab.store.session.reader import session_file
from haselab.store.session.writer import SessionReader
from haselab.study.chip.rows import with_chip_rows
from haselab.study.chip.trials import is_chip_session
from haselab.study.folder import write_findings
from haselab.study.physical.session import NOT_HERE, analysed, with_model_rows
from haselab.study.run import analyse_session

__all__ = ["check_ends", "command"]


def _own_folder(parameters: Mapping[str, Any]) -> Path | None:
    """The folder of the session, whose derived files are rewritten; None if it is not its own.

    A folder with a copy of a session may hold the results of another one.
    """
    session: Path = parameters["session"]
    if session.is_dir():
        return session
    own = session.parent / "session.h5"
    if session.name == own.name or not session.exists():  # the reader reports a missing file
        return session.parent
    return session.parent if own.exists() and session.samefile(own) else None


def check_ends(session: SessionReader, path: Path) -> None:
    """Refuse a recording that was cut short: half a trial must not count as a whole one.

    Args:
        session: the recording.
        path: of it.
    Raises:
        InputError: an experiment has no end.
    """
    if cut := session.cut_short():
        raise InputError(
            f"The recording of {', '.join(cut)} was cut short, but the analysis needs complete "
            "experiments. Run the study again, or read the recorded data with 'haselab sense "
            f"--experiment NAME' or 'haselab session export'. {path}"
        )


@click.command("analyse")
@click.argument("session", type=click.Path(path_type=Path))
@answer_options(
    OutputRule("folder", own=_own_folder),
    "It is a folder for the results. Default: the folder of SESSION.",
    force_detail="It applies to --out only. Without --out, the results in the folder of SESSION "
    "are replaced.",
)
@shared_option(
    "--physical-model/--no-physical-model", default=False, show_default=True,
    detail="Results S14 to S21 then follow from it. 'reproduce' does this by default.",
)  # fmt: skip
@unverified_option
def command(
    session: Path, unverified: bool, physical_model: bool, as_json: bool, out: Path | None
) -> None:
    """Repeat fits, design and report from a recording.

    SESSION is the folder of a run or its session.h5. The results replace those in that folder,
    unless --out is given; the recording itself is never changed. If the run ended early, the
    command analyses the complete experiments and exits with code 3. The noise-free reference values
    of a twin cannot be computed from recorded data; they are copied from an earlier results.json.
    """
    folder = _own_folder({"session": session})
    if out is None and folder is None:
        raise InputError(
            "The results would be written beside the file, but its name is not session.h5: results "
            f"there may belong to another session. Add --out DIR. {session}"
        )
    target = out or folder
    assert target is not None
    refuse_linked_folders(target, "figures", "firmware")
    path = session_file(session)
    with SessionReader(path, unverified=unverified) as recorded:
        warn_unverified(recorded.doubt, path)
        doubt = recorded.doubt
        on_chip = is_chip_session(recorded.header)
        if on_chip or not recorded.complete():
            check_ends(recorded, path)
        if on_chip:
            analyse_on_chip(recorded, target, as_json)
            return
    found, study, header = analyse_session(session, unverified=unverified)
    model = None
    if physical_model and not found.failed:
        model = identify_physical_model(path, study, found, unverified=unverified)
        found = model.joined(found)
    elif physical_model:
        note_no_model()
    if study.is_reference:
        by_model = NOT_HERE if folder is None else analysed(folder)
        found = with_model_rows(with_chip_rows(found, folder), by_model)
    found = with_mass_limit(found, study, table_at(header, "rig_config"))
    noise_free = None if folder is None else _earlier_noise_free(folder)
    header = with_date(header, path.parent)
    results = write_findings(target, found, study, header, noise_free, doubt)
    mark_found(target, found, path.parent, simulated=bool(results["simulated"]))
    if model is not None:
        model.save(target, path)
    print_results(results, target, as_json)
    require_complete(found, target)


def _earlier_noise_free(folder: Path) -> dict[str, float] | None:
    """Noise-free reference values from earlier results in the folder of the session."""
    try:
        rows = read_json(folder / "results.json")["quantities"]
        return {row["id"]: row["noise_free"] for row in rows if "noise_free" in row} or None
    except (InputError, KeyError, TypeError):
        return None  # there are no earlier results
