"""`haselab example`: small data sets to try the commands with."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, emit
from haselab.cli.output import OutputRule
from haselab.pipelines.examples.data_sets import DATA_SETS, find_data_set, write_data_set

__all__ = ["command"]


@click.command("example")
@click.argument("name", required=False)
@answer_options(
    OutputRule("folder"), "It is a new folder for the data set. Default: list the names."
)
def command(name: str | None, as_json: bool, out: Path | None) -> None:
    """List the example data sets, or write the one called NAME.

    The README of a data set shows the commands that use it. The data are simulated by the twin,
    always the same, and stored in the formats of other programs.
    """
    if name is None:
        if out is not None:
            listed = ", ".join(each.name for each in DATA_SETS)
            raise InputError(f"--out needs the NAME of a data set. Use one of {listed}.")
        answer = {each.name: each.title for each in DATA_SETS}
        emit(answer, as_json=as_json, out=None)
        if not as_json:
            click.echo("\nWrite one with: haselab example NAME --out DIR")
        return
    data_set = find_data_set(name)
    if out is None:
        raise InputError(f"Missing option '--out': the folder for the data set {name}.")
    out.mkdir(parents=True, exist_ok=True)
    files = write_data_set(data_set, out)
    if as_json:
        written = {"files": [str(file) for file in files], "commands": list(data_set.commands)}
        emit(written, as_json=True, out=None)
        return
    click.echo(f"Wrote {', '.join(file.name for file in files)} to {out}. Try in that folder:\n")
    for words in data_set.commands:
        click.echo(f"  haselab {words}")
