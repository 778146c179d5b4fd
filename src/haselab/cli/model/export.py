"""`haselab export`: a model in the form of another tool."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, emit
from haselab.cli.model.model_file import MAT_NAME, read_model
from haselab.store.columns.mat_struct import write_mat_struct

__all__ = ["command"]


@click.command("export")
@click.argument("model", type=click.Path(path_type=Path))
@click.option(
    "--to", "form", type=click.Choice(["json", "mat", "plant"]), required=True,
    help="json: numerator and denominator; mat: the same for tf(num,den,'InputDelay',delay); "
    "plant: the model.json of this program.",
)  # fmt: skip
@click.option("--input-name", help="Name of the input; that of the model when not given.")
@click.option("--output-name", help="Name of the output.")
@answer_options()
def command(
    model: Path,
    form: str,
    input_name: str | None,
    output_name: str | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """MODEL (model.json, the rational form, or .mat) in another form."""
    rational = read_model(model)
    names = {
        "input": input_name or rational.input_name,
        "output": output_name or rational.output_name,
    }
    data = rational.to_dict() | names
    if form == "plant":
        emit({"plant": rational.to_plant().to_dict()}, as_json=as_json, out=out)
        return
    if form == "json":
        emit(data, as_json=as_json, out=out)
        return
    if out is None:
        raise InputError(
            "--to mat needs a file to write; allowed is any path. Give --out FILE.mat."
        )
    fields = {
        "num": data["numerator"],
        "den": data["denominator"],
        "delay": data["delay_s"],
        "Ts": 0.0,
        "InputName": names["input"],
        "OutputName": names["output"],
    }
    write_mat_struct(out, MAT_NAME, fields)
    emit(data, as_json=as_json, out=None)
