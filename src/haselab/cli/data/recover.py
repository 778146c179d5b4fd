"""`haselab recover`: repair a recording whose program was killed."""

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
@answer_options()
def command(folder: Path, as_json: bool, out: Path | None) -> None:
    """Repair the recording in FOLDER after its program was killed.

    The command verifies every block, seals the recording and marks it RECOVERED. A complete
    recording is only compared with its manifest.
    """
    found = recover(folder)
    emit(asdict(found), as_json=as_json, out=out)
    if found.changed_files:
        raise InputError(
            f"{len(found.changed_files)} files were changed after the recording was sealed: "
            f"{', '.join(found.changed_files[:5])}. Copy the original files again. "
            f"{folder}"
        )
