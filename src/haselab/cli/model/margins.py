"""`haselab margins`: compute the stability margins of given gains."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path

import click

from haselab.base import InputError, ResultError
from haselab.cli.actuator_file import warn_misspelled_in
from haselab.cli.common import REAL, answer_options, emit
from haselab.cli.model.doubts import sensed_loop
from haselab.cli.model.loop_options import loop_options
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.run_path import MODEL_FILE
from haselab.control import LinearController, LoopSetting, PidGains
from haselab.control.charts import loop_chart
from haselab.control.stability.margins import loop_margins
from haselab.pipelines.design.answer import margins_answer
from haselab.pipelines.design.feedback import default_note, feedback_of, read_controller
from haselab.pipelines.design.model_file import loop_of, read_any_plant
from haselab.pipelines.design.sections import limits_of

__all__ = ["command"]


@click.command("margins")
@click.argument("model", type=MODEL_FILE)
@click.option(
    "--kp", type=REAL,
    help="Set the proportional gain, in units of the controller's output per unit of its input: "
    "V/m for a model from V to m, a pure number for one from strain to strain. Default: that of "
    "the actuator file.",
)  # fmt: skip
@click.option(
    "--ki", type=REAL,
    help="Set the integral gain, in the unit of --kp per second: V/(m s), or 1/s. Default: that of "
    "the actuator file.",
)  # fmt: skip
@click.option(
    "--kd", type=REAL,
    help="Set the derivative gain, in the unit of --kp times seconds: V s/m, or s. Default: 0.",
)  # fmt: skip
@click.option(
    "--derivative-filter-s", type=REAL,
    help="Set the time constant of the measurement's filter in s. Default: 0.",
)  # fmt: skip
@shared_option(
    "--controller", "kind",
    detail="It is the kind or the name of a controller in the actuator file. Default: that of "
    "[controller].",
)  # fmt: skip
@loop_options
@answer_options(plot=True)
def command(
    model: Path,
    kp: float | None,
    ki: float | None,
    kd: float | None,
    derivative_filter_s: float | None,
    kind: str | None,
    rate_hz: float | None,
    delay_s: float | None,
    *,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Compute the stability margins of a controller.

    MODEL is an actuator file, the folder of a run, or a model.json. The margins include the delay
    of the loop and the feedthrough of the sensed strain, for the nominal plant only. The controller
    is the PID of --kp and --ki, or one of the actuator file: PI, PID, or any kind whose controller
    has the method linear_feedback.
    """
    warn_misspelled_in(model)
    given, held = (kp, ki, kd, derivative_filter_s), None
    if model.suffix.lower() == ".toml" and all(value is None for value in given):
        held = read_controller(model, kind)
        if note := default_note(model, kind):
            click.echo(f"haselab: {note}", err=True)
    loop = None if held is None else held.loop
    usual = (None, None) if loop is None else (loop.rate_hz, loop.measurement_delay_s)
    setting = LoopSetting(*loop_of(model, rate_hz, delay_s, usual))
    if model.suffix.lower() == ".toml":
        with contextlib.suppress(InputError, ResultError):  # limits are no part of the margins
            setting = replace(setting, saturation=limits_of(model, None))
    setting = sensed_loop(setting, model)
    gains: PidGains | LinearController
    if any(value is not None for value in given):
        _refuse_incomplete(kp, ki, kind)
        gains = PidGains(*(value or 0.0 for value in given))
        if gains.kd and derivative_filter_s is None:
            click.echo(
                "haselab: warning: the derivative is not filtered. Set its filter with "
                "--derivative-filter-s",
                err=True,
            )
    elif held is not None:
        gains = feedback_of(held, setting.rate_hz)
    else:
        raise click.UsageError("Missing options '--kp' and '--ki': the file has no [controller].")
    plant = read_any_plant(model)
    found = loop_margins(plant, gains, setting)
    answer = margins_answer(found, setting)
    emit(answer, as_json=as_json, out=out)
    save_plot(plot, lambda: loop_chart(plant, gains, setting, found.crossover_rad_s))


def _refuse_incomplete(kp: float | None, ki: float | None, kind: str | None) -> None:
    """Refuse some gains without the others, or beside a controller of the file."""
    if kind is not None:
        raise click.UsageError(
            f"--controller {kind} is a controller of the file, and the options of gains describe "
            "another one. Leave out --controller or the gains."
        )
    for name, value in (("--kp", kp), ("--ki", ki)):
        if value is None:
            raise click.UsageError(
                f"Missing option '{name}': the margins of given gains need --kp and --ki. Give "
                f"{name} 0 for a controller without this part, or leave out all gains for the "
                "controller of the file."
            )
