"""`haselab recover`: a recording whose program was killed becomes an ordinary one."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, emit
from haselab.store.session.recover import recover

__all__ = ["command"]


@click.command("recover")
@click.argument("folder", type=click.Path(path_type=Path))
@answer_options(out_help="Also write the JSON result to this file.")
def command(folder: Path, as_json: bool, out: Path | None) -> None:
    """Repair the recording in FOLDER after its program was killed.

    Verifies every block, seals the recording and marks it RECOVERED. A complete recording is
    compared with its manifest and left unchanged.
    """
    found = recover(folder)
    emit(asdict(found), as_json=as_json, out=out)
    if found.changed_files:
        raise InputError(
            f"{len(found.changed_files)} files are not those that were sealed: "
            f"{', '.join(found.changed_files[:5])}. Copy them again from where they were recorded. "
            f"{folder}"
        )
