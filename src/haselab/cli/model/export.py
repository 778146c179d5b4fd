"""`haselab export`: convert a model for another tool."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import click

from haselab.base import InputError
from haselab.cli.actuator_file import warn_misspelled_in
from haselab.cli.common import answer_options, emit
from haselab.cli.options import shared_option
from haselab.cli.run_path import MODEL_FILE
from haselab.pipelines.design.model_file import MAT_NAME, read_model, read_origin
from haselab.rig.twin.fmu import FMI_VERSIONS, twin_fmu
from haselab.rig.twin.twin_file import load_twin
from haselab.store.columns.mat_struct import write_mat_struct
from haselab.store.folder import write_bytes

__all__ = ["command"]

_OF_FMU = ("inputs", "outputs", "parameters", "constants")


@click.command("export")
@click.argument("model", type=MODEL_FILE)
@shared_option(
    "--to", "form", type=click.Choice(["json", "mat", "plant", "fmu"]), required=True,
    detail="json: numerator and denominator; mat: the same for MATLAB's "
    "tf(num,den,'InputDelay',delay); plant: a model.json of haselab; fmu: the twin of a TWIN.toml "
    "or of an actuator file, for simulators that support the FMI standard.",
)  # fmt: skip
@click.option(
    "--fmi", "version", type=click.Choice(FMI_VERSIONS), help="Set the version of the FMI standard "
    "with --to fmu. Default: 3.",
)  # fmt: skip
@shared_option(
    "--seed", type=click.IntRange(0, 2**31 - 1),
    detail="It determines the noise of the monitors; used with --to fmu only. Default: 1.",
)  # fmt: skip
@click.option(
    "--input-name", metavar="NAME", help="Set the name of the input. Default: that of the model."
)
@click.option(
    "--output-name", metavar="NAME", help="Set the name of the output. Default: that of the model."
)
@answer_options(None, "It is the converted model; required for mat and fmu. Default: none.")
def command(
    model: Path,
    form: str,
    version: Literal["2", "3"] | None,
    seed: int | None,
    input_name: str | None,
    output_name: str | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Convert MODEL for another tool.

    MODEL is a model.json, an actuator file, the folder of a run, or a .json or .mat file that this
    command has written; with --to fmu a TWIN.toml or an actuator file with [model.physical].
    """
    if form == "fmu":
        _refuse({"--input-name": input_name, "--output-name": output_name}, form)
        path = _file_to_write(out, form)
        fmu = twin_fmu(load_twin(model), version=version or "3", seed=1 if seed is None else seed)
        write_bytes(path, fmu.content)
        answer = dataclasses.asdict(fmu)
        emit(
            {"fmi": version or "3"} | {name: answer[name] for name in _OF_FMU},
            as_json=as_json,
            out=None,
        )
        return
    _refuse({"--fmi": version, "--seed": seed}, form)
    warn_misspelled_in(model)
    rational = read_model(model)
    fitted = read_origin(model)
    names = {
        "input": input_name or fitted.input or rational.input_name,
        "output": output_name or fitted.output or rational.output_name,
    }
    origin = fitted.model_dump(exclude_defaults=True)
    data = rational.to_dict() | origin | names
    if form == "plant":
        emit({"plant": rational.to_plant().to_dict(), **origin}, as_json=as_json, out=out)
        return
    if form == "json":
        emit(data, as_json=as_json, out=out)
        return
    path = _file_to_write(out, form)
    fields = {
        "num": data["numerator"],
        "den": data["denominator"],
        "delay": data["delay_s"],
        "Ts": 0.0,
        "InputName": names["input"],
        "OutputName": names["output"],
    }
    write_mat_struct(path, MAT_NAME, fields)
    emit(data, as_json=as_json, out=None)


def _refuse(options: Mapping[str, object], form: str) -> None:
    """Refuse options that have no effect."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} {value} has no effect with --to {form}. Leave it out.")


def _file_to_write(out: Path | None, form: str) -> Path:
    if out is None:
        raise InputError(
            f"Missing option '--out': --to {form} needs a file to write. Add --out FILE.{form}."
        )
    return out
