"""`haselab example`: small data sets to try the commands with, and packages to start from."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, emit
from haselab.cli.output import OutputRule
from haselab.pipelines.examples.data_sets import DATA_SETS, find_data_set, write_data_set
from haselab.pipelines.examples.packages import PACKAGES, write_package

__all__ = ["command"]


@click.command("example")
@click.argument("name", required=False)
@answer_options(
    OutputRule("folder"), "It is a new folder for the example. Default: list the names."
)
def command(name: str | None, as_json: bool, out: Path | None) -> None:
    """List the examples, or write the one called NAME.

    An example is a data set, whose README shows the commands that use it, or a package that extends
    haselab, to start your own from. The data are simulated by the twin, always the same, and stored
    in the formats of other programs.
    """
    answer = {each.name: each.title for each in DATA_SETS} | PACKAGES
    if name is None:
        if out is not None:
            raise InputError(f"--out needs the NAME of an example. Use one of {', '.join(answer)}.")
        emit(answer, as_json=as_json, out=None)
        if not as_json:
            click.echo("\nWrite one with: haselab example NAME --out DIR")
        return
    data_set = None if name in PACKAGES else find_data_set(name, answer)
    if out is None:
        raise InputError(f"Missing option '--out': the folder for the example {name}.")
    out.mkdir(parents=True, exist_ok=True)
    if data_set is None:
        files = write_package(name, out)
        if as_json:
            emit({"files": [str(file) for file in files]}, as_json=True, out=None)
        else:
            place = out if out.is_absolute() else f"./{out}"  # otherwise pip looks in its index
            click.echo(f"Wrote the package to {out}. Install it with: pip install {place}")
        return
    files = write_data_set(data_set, out)
    if as_json:
        written = {"files": [str(file) for file in files], "commands": list(data_set.commands)}
        emit(written, as_json=True, out=None)
        return
    click.echo(f"Wrote {', '.join(file.name for file in files)} to {out}. Try in that folder:\n")
    for words in data_set.commands:
        click.echo(f"  haselab {words}")
