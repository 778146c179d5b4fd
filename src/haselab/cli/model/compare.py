"""`haselab compare`: predict records that were not used for the fit of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np
from click.core import ParameterSource
from numpy.typing import NDArray

from haselab.base import InputError, ResultError
from haselab.cli.actuator_file import warn_misspelled_in
from haselab.cli.columns import column_options
from haselab.cli.common import POSITIVE, REAL, SEED, answer_options, emit, unverified_option
from haselab.cli.identify.common import (
    FILES,
    MONITOR_SCALE,
    RATE,
    axis_names,
    name_files_in_errors,
    output_name,
    read_recorded,
    unit_of_name,
    unit_text,
)
from haselab.cli.identify.recorded_motion import TableOptions
from haselab.cli.model.charts import prediction_chart
from haselab.cli.model.compare_runs import RunPair, refuse_runs_without_model
from haselab.cli.model.physical_comparison import (
    PhysicalOptions,
    compare_physical,
    refuse_for_linear,
)
from haselab.cli.model.physical_model import has_physical_model
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.run_path import MODEL_FILE, RUN_OR_MODEL
from haselab.identify.fit import Prediction
from haselab.identify.prediction import note_range, predict
from haselab.identify.record import HOLDS, Record
from haselab.identify.training_output import TrainingOutput, is_comparable
from haselab.models.actuator.model_tables import OriginTable
from haselab.pipelines.design.model_file import (
    read_any_plant,
    read_input_curve,
    read_origin,
    read_posterior,
)
from haselab.store.columns.selection import ColumnOptions

__all__ = ["command"]

_NO_BAND = "no uncertainty: the model has no covariance"
_NO_CURVE = (
    "none: a band needs the covariance of the curve (gain_2, gain_3) and of the linear part "
    "together, but a model file has only that of the linear part. So whether the error is larger "
    "than the uncertainty was not checked; fit_percent and rms_error are valid"
)
_NO_NOISE = (
    "none: the model file does not state residual_std, without which the band would be too narrow. "
    "Identify the model again"
)


@click.command("compare")
@click.argument("model", type=RUN_OR_MODEL)
@FILES
@click.option("--results", is_flag=True,
              help="Compare the results of two runs row by row; MODEL and FILES are their folders. "
              "Default: only if the first run has no physical model.")  # fmt: skip
@shared_option(
    "--input",
    "source",
    default="u",
    detail="Default: u; with a physical model u, voltage_v or voltage.",
)
@shared_option(
    "--output",
    "outputs",
    multiple=True,
    detail="With a physical model, give it twice for a length and a capacitance. Default: y; with "
    "a physical model the columns of length, strain and capacitance.",
)
@RATE
@shared_option(
    "--model", "which", type=click.Choice(["auto", "physical", "linear"]), default="auto",
    show_default=True,
    detail="auto: [model.physical] if MODEL has it, unless an option of linear models is given.",
)  # fmt: skip
@shared_option("--at-rest", is_flag=True, detail="Its state and offset are then taken as 0.")
@shared_option("--through-voltage-map", is_flag=True)
@MONITOR_SCALE
@shared_option("--hold", type=click.Choice(HOLDS), detail="Default: zero. Use the same value "
               "as in 'identify transfer'.")  # fmt: skip
@shared_option("--held-at-hz", type=REAL, detail="Default: the sampling rate of the file.")
@shared_option("--experiment", "experiments", multiple=True,
               detail="It selects what is compared. Repeat the option for more. "
               "Default: all.")  # fmt: skip
@click.option("--free-offset", is_flag=True,
              help="Estimate a constant offset of all measured lengths, for example after the "
              "camera was moved.")  # fmt: skip
@click.option("--longest-m", type=POSITIVE,
              help="State the longest length of the actuator before the record, in m. Default: its "
              "length at the start of the record.")  # fmt: skip
@shared_option("--mass-kg", type=REAL, detail="Used for tables only. Default: that of MODEL.")
@shared_option(
    "--gain-v-per-v", type=POSITIVE, detail="Used for tables only. Default: that of MODEL."
)
@shared_option("--zero-length-m", type=POSITIVE,
               detail="Used for tables with strains only. Default: that of MODEL.")  # fmt: skip
@unverified_option
@shared_option(
    "--seed", type=SEED, default=1, show_default=True, detail="Only the 95 % band uses it."
)
@column_options
@answer_options(plot=True)
@click.pass_context
def command(
    context: click.Context,
    model: Path,
    files: tuple[Path, ...],
    results: bool,
    source: str,
    outputs: tuple[str, ...],
    rate_hz: float | None,
    at_rest: bool,
    through_voltage_map: bool,
    volt_per_monitor_volt: float | None,
    which: str,
    hold: str | None,
    held_at_hz: float | None,
    experiments: tuple[str, ...],
    free_offset: bool,
    longest_m: float | None,
    mass_kg: float | None,
    gain_v_per_v: float | None,
    zero_length_m: float | None,
    unverified: bool,
    seed: int,
    columns: ColumnOptions,
    *,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Predict records in FILES that were not used for the fit of MODEL.

    MODEL is an actuator file, the folder of a run, or a model.json. With the physical model of
    'identify actuator', FILES are sessions, folders of runs, or tables with a voltage and a length,
    strain or capacitance. The command simulates the model with the recorded voltage and compares
    experiment by experiment. The exit code is 3 if the error is too large for the band, or if the
    model was identified from one of the files.

    With any other model, such as that of 'identify transfer' or 'identify arx', FILES are tables.
    The command reports the fit in percent, the rms error and the share of samples inside the 95 %
    band. For a Hammerstein model it first applies the curve to the input, and reports no band;
    other nonlinear models are refused. It estimates the initial state and the offset of each
    record, unless --at-rest is given. used_for_fit is the share of samples that were used for the
    fit; it is null if the command cannot tell a copy of the record from a repetition.

    With --results, MODEL and FILES are the folders of two runs. The command prints each result of
    both with its 95 % interval, the difference (second minus first) with its interval, and whether
    it is larger than noise explains. It lists rows that only one run has, and what else differs.
    The exit code is 3 if a difference is larger than noise explains.

    For a linear model, the exit code is 3 if used_for_fit is above 5 %, if the prediction is worse
    than the mean of the record, if the error is too large for the band, or if the record can be
    explained as well without its input. The page 'Your actuator' of the documentation has the exact
    rules.
    """
    runs = RunPair(model, files)
    if results or runs.is_meant(context):
        runs.compare(context, as_json=as_json, out=out)
        return
    model = MODEL_FILE.convert(model, None, context)
    linear = at_rest or through_voltage_map or held_at_hz is not None
    linear |= hold is not None or volt_per_monitor_volt is not None
    table = TableOptions(
        _given(context, "source", source), outputs, rate_hz,
        mass_kg, gain_v_per_v, zero_length_m, columns,
    )  # fmt: skip
    options = PhysicalOptions(experiments, free_offset, longest_m, unverified, table)
    if which == "physical" and linear:
        raise InputError(
            "--at-rest, --through-voltage-map, --volt-per-monitor-volt, --hold and --held-at-hz "
            "are for linear models. Leave them out, or use --model linear."
        )
    if volt_per_monitor_volt is not None and not through_voltage_map:
        raise InputError(
            "--volt-per-monitor-volt converts a monitor to the drive, which needs "
            "--through-voltage-map. Add it, or leave out --volt-per-monitor-volt. For the physical "
            "model, use --gain-v-per-v."
        )
    if which == "physical" or (which == "auto" and not linear and has_physical_model(model)):
        compare_physical(model, files, options, as_json=as_json, out=out, plot=plot)
        return
    refuse_for_linear(options)
    refuse_runs_without_model(model, files)
    if len(outputs) > 1:
        raise InputError(
            f"--output is given {len(outputs)} times, but a linear model has one output. Give it "
            "once."
        )
    output = outputs[0] if outputs else "y"
    warn_misspelled_in(model)
    plant, posterior, origin = read_any_plant(model), read_posterior(model), read_origin(model)
    noise_std = origin.residual_std
    no_band = _NO_BAND if posterior is None else _NO_NOISE if noise_std is None else ""
    curve = read_input_curve(model)
    no_band = no_band if curve is None else _NO_CURVE
    through = model if through_voltage_map else None
    records: list[Record] = []
    recorded: list[Record] = []
    for file in files:
        with name_files_in_errors(file):
            found = read_recorded(
                file, (source, output), rate_hz, held_at_hz, columns, hold=hold, through=through,
                to_strain=origin.output_unit != "m",
                volt_per_monitor_volt=volt_per_monitor_volt,
            )  # fmt: skip
            _check_units(origin, found.units, (source, output), through_voltage_map)
            recorded += found.records
            records += found.records if curve is None else map(curve.apply_to, found.records)
            measured_name = output_name(output, found.units[1], through_voltage_map)
            axes = axis_names(source, measured_name, found.units)
    with name_files_in_errors(*files):
        prediction = predict(
            plant,
            records,
            posterior=None if no_band else posterior,
            noise_std=noise_std or 0.0,
            free_start=not at_rest,
            training_output=_training_output(origin),
            rng=np.random.default_rng(seed),
        )
    prediction = note_range(prediction, recorded, origin.input_range)
    if math.isnan(prediction.used_for_fit):
        why = _why_unknown(_training_output(origin), records)
        click.echo(f"haselab: warning: {why}. File: {model}", err=True)
    emit(_answer(prediction, no_band), as_json=as_json, out=out)
    names = ", ".join(file.name for file in files)
    title = f"Prediction of {names}: {prediction.fit_percent:.1f} %"
    save_plot(plot, lambda: prediction_chart(prediction, _times(records), title, axes[1]))
    if prediction.status != "ok":
        raise ResultError(f"{prediction.status}. {' '.join(map(str, files))}")


def _why_unknown(known: TrainingOutput | None, records: Sequence[Record]) -> str:
    """Why it is not known whether some records were used for the fit."""
    if known is None:
        return (
            "the model does not state the samples that it was fitted to. Whether this record is "
            "new was not checked"
        )
    if not is_comparable([record.y for record in records], known):
        return (
            "this record is too short, or its output changes too little, to be compared with the "
            "record of the fit. Whether it is new was not checked"
        )
    return (
        "part of this record has the same values as the record of the fit. The steps of the "
        "converter are larger than the noise, so it can be a copy or a repetition. Use a record "
        "with another input"
    )


def _given(context: click.Context, parameter: str, value: str) -> str | None:
    """The value of an option that the user gave; None for the default."""
    usual = context.get_parameter_source(parameter) is ParameterSource.DEFAULT
    return None if usual else value


def _training_output(origin: OriginTable) -> TrainingOutput | None:
    known = origin.training_output
    if known is None:
        return None
    return TrainingOutput(known.cell, np.array(known.hashes, np.uint64), known.quantised)


def _check_units(
    origin: OriginTable, units: tuple[str, str], names: tuple[str, str], mapped: bool
) -> None:
    """Refuse columns whose units contradict those of the model."""
    stated = (
        origin.input_unit or unit_of_name(origin.input),
        origin.output_unit or unit_of_name(origin.output),
    )
    for end, column, wanted, unit in zip(("input", "output"), names, stated, units, strict=True):
        if not (wanted and unit) or wanted == unit:
            continue
        if end == "input" and mapped:
            raise InputError(
                f"The model's input is {unit_text(wanted)}, but --through-voltage-map gives a "
                "strain. Leave out the option"
            )
        advice = f"Name another column with --{end}"
        if (end, wanted, unit) == ("input", "1", "V"):
            advice = "Add --through-voltage-map"
        raise InputError(
            f"The model's {end} is {unit_text(wanted)}, but column {column} is {unit_text(unit)}. "
            f"{advice}"
        )


def _times(records: Sequence[Record]) -> NDArray[np.float64]:
    """Times of the outputs of records that follow each other."""
    parts, start_s = [], 0.0
    for record in records:
        parts.append(start_s + record.output_time_s)
        start_s = float(parts[-1][-1]) + 1.0 / record.input_rate_hz
    return np.concatenate(parts)


def _answer(found: Prediction, no_band: str) -> dict[str, object]:
    return {
        "fit_percent": found.fit_percent,
        "rms_error": found.rms_error,
        "inside_band": None if no_band else found.inside_band,
        "band": no_band or "95 %, from the covariance of the model and its residuals",
        "samples": found.measured.size,
        "used_for_fit": None if math.isnan(found.used_for_fit) else found.used_for_fit,
        "notes": list(found.notes),
        "status": found.status,
    }
