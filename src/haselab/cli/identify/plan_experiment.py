"""`haselab plan-experiment`: design the next experiment within the limits of the bench."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from click.core import ParameterSource

from haselab.base import InputError, ResultError
from haselab.base.chart import Chart, Curve, Panel
from haselab.cli.common import LIMIT, REAL, answer_options, emit
from haselab.cli.identify.plan_for_actuator import plan_for_actuator
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.run_path import MODEL_FILE
from haselab.cli.study.run import rig_file
from haselab.identify.experiment_design.drives import BenchLimits
from haselab.identify.experiment_design.plan import (
    Accuracy,
    ExperimentPlan,
    goals_of,
    plan_experiment,
)
from haselab.models.actuator.model_tables import VoltagePlantTable
from haselab.models.plant import Plant
from haselab.models.voltage_plant import VoltagePlant
from haselab.pipelines.design.model_file import read_plant
from haselab.rig.twin.config import TwinConfig
from haselab.store.folder import read_json, write_text
from haselab.store.toml import validated

__all__ = ["command"]

_SHOWN = 8  # rows of the table
_BLOCK_DIGITS = 6
_OF_SIGNAL = (
    "duration_s", "baseline_v", "capacitance_f", "largest_output", "noise_std", "samples_per_s",
    "systematic", "plot",
)  # fmt: skip


@click.command("plan-experiment")
@click.argument("model", type=MODEL_FILE)
@shared_option(
    "--rig", type=click.Path(path_type=Path),
    detail="Default: none; MODEL is then an actuator file with [model.physical].",
)  # fmt: skip
@click.option(
    "--goal", required=True,
    help="Choose the goal. creep, reading, modes: separate the candidate models; all, or the name "
    "of a parameter: reduce its interval.",
)  # fmt: skip
@click.option(
    "--std", type=LIMIT, default=None,
    help="Set the relative standard deviation to reach for the parameter; only without --rig. "
    "Default: 0.1.",
)  # fmt: skip
@shared_option(
    "--duration-s",
    type=REAL,
    default=40.0,
    show_default=True,
    detail="It is the length of the drive signal.",
)
@click.option(
    "--baseline-v", type=REAL, default=1.0, show_default=True,
    help="Set the baseline drive, at which the actuator has settled at the start, in V; above 0 V.",
)  # fmt: skip
@shared_option(
    "--capacitance-f", type=REAL, default=1e-9, show_default=True, detail="Include the cable."
)
@click.option(
    "--largest-output", type=LIMIT, default=float("inf"),
    help="Limit the output to this value, in its own unit. Default: no limit.",
)  # fmt: skip
@click.option(
    "--noise-std", type=REAL, default=1e-4, show_default=True,
    help="Set the standard deviation of the output's noise, in the output's unit.",
)  # fmt: skip
@click.option(
    "--samples-per-s", type=REAL, default=2.0, show_default=True,
    help="Set the number of statistically independent output samples per second.",
)  # fmt: skip
@click.option(
    "--systematic", type=REAL, default=0.05, show_default=True,
    help="Set the expected model error, as a share of the output's standard deviation.",
)  # fmt: skip
@answer_options(
    None,
    "It is a CSV file of the drive signal (time_s, drive_v) or, without --rig, a study file. "
    "Default: none.",
    plot=True,
)
@click.pass_context
def command(
    context: click.Context,
    /,
    model: Path,
    rig: Path | None,
    goal: str,
    std: float | None,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: float,
) -> None:
    """Design the next experiment.

    With --rig, the command designs a drive signal within the limits of the bench. The signal
    separates candidate models, or reduces the confidence interval of a parameter, as well as
    possible. MODEL is the JSON file of `identify model-comparison` or `identify transfer`.

    Without --rig, it finds the shortest study that determines a parameter of the physical model,
    within the limits of [drive]. MODEL is an actuator file with [model.physical].
    """
    if rig is None:
        _only_with_rig(context, model)
        plan_for_actuator(model, goal, std, as_json=as_json, out=out)
        return
    if std is not None:
        raise InputError(
            "--std has no effect with --rig. Leave out --rig to plan for the physical model of an "
            "actuator file, or leave out --std."
        )
    plant = _plant(model, options["baseline_v"])
    if goal not in goals_of(plant):
        raise InputError(f"--goal is {goal}, but must be one of {', '.join(goals_of(plant))}.")
    config, _ = rig_file(rig)
    plan = plan_experiment(
        plant,
        goal,
        _limits(config, options["capacitance_f"], options["largest_output"]),
        accuracy=Accuracy(options["noise_std"], options["samples_per_s"], options["systematic"]),
        duration_s=options["duration_s"],
        baseline_v=options["baseline_v"],
    )
    if not plan.succeeded:
        raise ResultError(f"{plan.status}: {model}")
    if out is not None:
        write_text(out, _csv(plan))
    if as_json:
        emit(plan.answer(), as_json=True, out=None)
    else:
        click.echo("\n".join(_page(plan)))
    save_plot(plot, lambda: _chart(plan))


def _only_with_rig(context: click.Context, model: Path) -> None:
    """Refuse options that need a rig where none is given.

    Raises:
        InputError: One of them is given, or MODEL is not an actuator file.
    """
    if model.suffix != ".toml":
        raise InputError(
            f"{model} is not an actuator file (.toml), so the bench must be known. Add --rig "
            "RIG.toml."
        )
    for name in _OF_SIGNAL:
        if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
            raise InputError(
                f"--{name.replace('_', '-')} describes a drive signal, which needs --rig. Add "
                "--rig, or leave it out."
            )


def _chart(plan: ExperimentPlan) -> Chart:
    """The chosen drive in time."""
    drive_v = plan.chosen.drive_v
    time_s = np.arange(drive_v.size) / plan.update_hz
    panel = Panel("Time (s)", "Drive (V)", (Curve(time_s, drive_v, "", "steps"),))
    return Chart(f"Drive for {plan.goal}: {plan.chosen.name}", (panel,))


def _plant(path: Path, baseline_v: float) -> VoltagePlant:
    if path.suffix == ".toml":
        raise InputError(
            f"With --rig, MODEL must be a JSON file of 'identify model-comparison' or 'identify "
            f"transfer', but {path} is an actuator file. Leave out --rig to plan for its physical "
            "model."
        )
    data = read_json(path)
    if isinstance(data, dict) and "voltage_plant" in data:
        table = validated(VoltagePlantTable, data["voltage_plant"], path)
        return VoltagePlant.from_dict(table.model_dump())
    return _of_linear(read_plant(path), baseline_v)


def _of_linear(plant: Plant, baseline_v: float) -> VoltagePlant:
    """The voltage plant that agrees with a linear one for small changes about the baseline."""
    if not baseline_v > 0.0:
        raise InputError(f"--baseline-v is {baseline_v:g} V. Use a voltage above 0 V.")
    slow = max(plant.slow_modes, key=lambda mode: mode.gain, default=None)
    total = plant.gain + (slow.gain if slow else 0.0)
    share = slow.gain / total if slow and 0.0 < slow.gain < total else 0.0
    return VoltagePlant(
        "mechanical",
        (total / (2.0 * baseline_v),),
        plant.natural_frequency_rad_s,
        plant.damping_ratio,
        plant.delay_s,
        share,
        slow.time_constant_s if slow else 5.0,
    )


def _limits(config: TwinConfig, capacitance_f: float, largest_output: float) -> BenchLimits:
    """Drive range, slew rate and current limit of the rig."""
    if not capacitance_f > 0.0:
        raise InputError(f"--capacitance-f is {capacitance_f:g} F. Use a capacitance above 0 F.")
    amplifier, daq = config.amplifier, config.acquisition
    limits = BenchLimits.of_amplifier(
        (daq.drive_low_v, daq.drive_high_v),
        amplifier.gain,
        amplifier.slew_v_per_s,
        amplifier.current_limit_a,
        capacitance_f + amplifier.stray_f,
        daq.rate_hz / daq.block_samples,
    )
    return replace(limits, largest_output=largest_output)


def _csv(plan: ExperimentPlan) -> str:
    drive_v = plan.chosen.drive_v
    time_s = np.arange(drive_v.size) / plan.update_hz
    rows = [f"{t:.{_BLOCK_DIGITS}g},{v:.6g}" for t, v in zip(time_s, drive_v, strict=True)]
    return "\n".join([f"# rate_hz = {plan.update_hz:g}", "time_s,drive_v", *rows]) + "\n"


def _page(plan: ExperimentPlan) -> list[str]:
    """The answer as a table to read."""
    questions = any(planned.probability == planned.probability for planned in plan.ranked)
    figure = "probability  separation" if questions else "standard deviation"
    lines = [f"{'drive':32s} {figure}"]
    for planned in plan.ranked[:_SHOWN]:
        lines.append(f"{planned.name:32s} {_figure(planned, plan.goal)}")
    return [*lines, "", *plan.notes]


def _figure(planned: Any, goal: str) -> str:
    if planned.probability == planned.probability:
        return f"{planned.probability:11.2g} {planned.separation:11.2g}"
    if goal in planned.std:
        return f"{planned.std[goal]:18.2g}"
    return ", ".join(f"{name} {std:.2g}" for name, std in planned.std.items())
