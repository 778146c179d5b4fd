"""`haselab export`: convert a model for another tool."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.actuator_file import warn_misspelled_in
from haselab.cli.common import answer_options, emit
from haselab.cli.options import shared_option
from haselab.pipelines.design.model_file import MAT_NAME, read_model, read_origin
from haselab.store.columns.mat_struct import write_mat_struct

__all__ = ["command"]


@click.command("export")
@click.argument("model", type=click.Path(path_type=Path))
@shared_option(
    "--to", "form", type=click.Choice(["json", "mat", "plant"]), required=True,
    detail="json: numerator and denominator; mat: the same for MATLAB's "
    "tf(num,den,'InputDelay',delay); plant: a model.json of haselab.",
)  # fmt: skip
@click.option(
    "--input-name", metavar="NAME", help="Set the name of the input. Default: that of the model."
)
@click.option(
    "--output-name", metavar="NAME", help="Set the name of the output. Default: that of the model."
)
@answer_options(None, "It is the converted model; required for mat. Default: none.")
def command(
    model: Path,
    form: str,
    input_name: str | None,
    output_name: str | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Convert MODEL for another tool.

    MODEL is a model.json, an actuator file, or a .json or .mat file that this command has written.
    """
    warn_misspelled_in(model)
    rational = read_model(model)
    names = {
        "input": input_name or rational.input_name,
        "output": output_name or rational.output_name,
    }
    origin = read_origin(model).model_dump(exclude_defaults=True)
    data = rational.to_dict() | origin | names
    if form == "plant":
        emit({"plant": rational.to_plant().to_dict(), **origin}, as_json=as_json, out=out)
        return
    if form == "json":
        emit(data, as_json=as_json, out=out)
        return
    if out is None:
        raise InputError(
            "Missing option '--out': --to mat needs a file to write. Add --out FILE.mat."
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
