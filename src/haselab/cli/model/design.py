"""`haselab design`: design gains for a model, with margins and the predicted step."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import InputError, ResultError
from haselab.cli.actuator_file import load_actuator, save_section, warn_misspelled_in
from haselab.cli.common import REAL, SEED, Real, answer_options, emit, waiting
from haselab.cli.identify.common import axis_names
from haselab.cli.model.doubts import sensed_loop
from haselab.cli.model.loop_options import loop_options
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.cli.run_path import MODEL_FILE
from haselab.control import (
    Design,
    DesignSpec,
    LoopSetting,
    design_controller,
)
from haselab.control.charts import loop_chart
from haselab.control.gains import gain_units
from haselab.control.plants.general import AnyPlant
from haselab.control.plausible_design import USUAL_STRUCTURE
from haselab.control.stability.margins import loop_margins
from haselab.controllers import (
    CONTROLLERS,
    ControllerKind,
    ControllerSetting,
    known_actuator,
)
from haselab.models.maps import allow_start
from haselab.models.posterior import PlantPosterior
from haselab.pipelines.design.answer import (
    design_answer,
    margins_answer,
    plausible_sentence,
)
from haselab.pipelines.design.feedback import default_note, feedback_of, read_controller
from haselab.pipelines.design.model_file import (
    loop_of,
    read_any_plant,
    read_loop,
    read_origin,
    read_posterior,
)
from haselab.pipelines.design.sections import (
    CONTROLLER_KEYS,
    MODEL_KEYS,
    controller_section,
    default_limits_note,
    demands_of,
    limits_of,
    other_controllers,
)
from haselab.pipelines.design.stated_margins import drive_doubt, model_doubt
from haselab.store.folder import write_text
from haselab.store.text_file import read_text

__all__ = ["command"]

_TIMING_TOLERANCE = 0.01
_FEW = 0.9  # share of plausible plants below which a design without --probability gets a warning
_GAINS = ("--kp", "--ki", "--kd", "--derivative-filter-s")  # options of haselab margins


class _DesignCommand(click.Command):
    """Leads gains, which are options of `haselab margins`, to that command."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; gains are refused with the command that takes them."""
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            if error.option_name not in _GAINS:
                raise
            raise click.UsageError(
                f"This command computes the gains, so it has no option '{error.option_name}'. For "
                "the margins of your own gains, use: haselab margins MODEL --kp KP --ki KI",
                ctx,
            ) from None


@click.command("design", cls=_DesignCommand)
@click.argument("model", type=MODEL_FILE)
@click.option(
    "--spec", type=click.Path(path_type=Path), metavar="SPEC.toml",
    help="Read the demands from this file. Default: those of the actuator file, or built-in ones.",
)  # fmt: skip
@shared_option(
    "--controller", "--structure", "structure", default=USUAL_STRUCTURE, show_default=True,
    detail="pi: as in the paper; pid: with the derivative of the filtered measurement. Other kinds "
    "need [model.physical]. For a kind without an automatic design, the command only computes the "
    "margins of the parameters in the file.",
)  # fmt: skip
@loop_options
@click.option(
    "--limits", type=(REAL, REAL), metavar="LOW HIGH",
    help="Limit the controller's output to this range, in the unit of the model's input. Default: "
    "the limits in the actuator file, else -0.05 0.1.",
)  # fmt: skip
@shared_option("--seed", type=SEED, default=0, show_default=True)
@click.option(
    "--probability", type=Real(0.0, 1.0, min_open=True, max_open=True),
    help="Require that this share of the plausible plants keeps phase and gain margin, for example "
    "0.97. Needs a model with its covariance. Default: only report the share.",
)  # fmt: skip
@click.option(
    "--draws", type=click.IntRange(50, 20_000), default=400, show_default=True,
    help="Draw this many plausible plants.",
)  # fmt: skip
@click.option(
    "--accept-shortfalls", is_flag=True,
    help="Write the best controller even if it does not meet the demands.",
)  # fmt: skip
@answer_options(
    None, "It is a new actuator file with model and controller. Default: none.", plot=True
)
def command(
    model: Path,
    spec: Path | None,
    accept_shortfalls: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **loop: Any,
) -> None:
    """Design controller gains for MODEL and report their margins.

    MODEL is a model.json, an actuator file, or the folder of a run. The command reads [model],
    [drive] and the demands of an actuator file and writes its [controller], but leaves the file
    unchanged if --out is given. The margins include the delay of the loop and the feedthrough of
    the sensed strain. If the model has a covariance, plausible plants are drawn from it, and the
    share of them that keeps the margins is reported.
    """
    warn_misspelled_in(model)
    if out is None and model.suffix.lower() == ".toml":
        load_actuator(model, to_write=True)
    if model.suffix.lower() == ".toml" and (doubt := drive_doubt(model)):
        click.echo(f"haselab: warning: {doubt}", err=True)
    if loop["structure"] not in ("pi", "pid"):
        kind = CONTROLLERS.find(loop["structure"])
        if kind.design is None:
            _judge(model, out, loop, as_json, plot)
        else:
            emit(_own_design(model, out, kind, loop), as_json=as_json, out=None)
        return
    if model.suffix.lower() == ".toml" and (doubt := model_doubt(model)):
        click.echo(f"haselab: warning: {doubt}", err=True)
    posterior = read_posterior(model)
    plant = read_any_plant(model)
    demands = demands_of(model, spec)
    rate_hz, delay_s = loop_of(model, loop["rate_hz"], loop["delay_s"])
    limits = limits_of(model, loop["limits"])
    if note := default_limits_note(model, loop["limits"], limits):
        click.echo(f"haselab: {note}", err=True)
    origin = read_origin(model)
    if loop["limits"] is not None and origin.input_range is not None and origin.input_unit == "V":
        low_v, high_v = origin.input_range
        click.echo(
            f"haselab: --limits count from the operating point of the model's records, whose input "
            f"is {low_v:.3g} to {high_v:.3g} V. File: {model}",
            err=True,
        )
    setting = sensed_loop(LoopSetting(rate_hz, delay_s, limits), model)
    if posterior is None and loop["probability"] is not None:
        raise InputError(
            f"--probability {loop['probability']:g} needs the covariance of the model, which the "
            "file does not have. Write the model again with `haselab identify transfer --out`, or "
            f"leave the option out: {model}"
        )
    design = _designed(plant, posterior, demands, setting, loop)
    if design.shortfalls and not accept_shortfalls:
        lower = "" if loop["probability"] is None else "lower --probability, "
        raise ResultError(
            f"No {loop['structure'].upper()} controller meets the demands; the best has "
            f"{'; '.join(design.shortfalls)}. Relax the demands in --spec, shorten --delay-s, "
            f"{lower}or accept it with --accept-shortfalls: {model}"
        )
    answer = design_answer(design)
    _save(model, out, controller_section(design, loop["structure"]), spec)
    if design.plausible is None:
        answer["uncertainty"] = "no uncertainty: the model has no covariance"
    else:
        if not as_json:
            answer["posterior"] = plausible_sentence(design.plausible)
        if loop["probability"] is None and design.plausible.share.value < _FEW:
            click.echo(
                f"haselab: warning: only {plausible_sentence(design.plausible)}. Use --probability "
                f"{_FEW:g} for more robust gains: {model}",
                err=True,
            )
    if remark := design.nominal.step.remark:
        click.echo(f"haselab: warning: {remark}: {model}", err=True)
    ends = origin.input_unit, origin.output_unit
    units = gain_units(*ends, strains=origin.is_of_strains)
    emit(answer, as_json=as_json, out=None, units=units)
    names = axis_names("Controller output", "Output", ends)
    if origin.is_of_strains:
        names = "Controller output, strain", "Strain"
    save_plot(plot, lambda: design.chart(names))


def _own_design(
    model: Path, out: Path | None, kind: ControllerKind, loop: dict[str, Any]
) -> dict[str, Any]:
    """Let a kind compute its parameters from the physical model, and write [controller]."""
    if model.suffix.lower() != ".toml":
        raise InputError(
            f"--controller {kind.name} reads [model.physical] of an actuator file. Name one: "
            f"{model}"
        )
    tables = load_actuator(model)
    actuator, usual = known_actuator(tables, model), LoopSetting()
    physical = None if tables.model is None else tables.model.physical
    if physical is not None and physical.status != "ok":
        click.echo(
            f"haselab: warning: the status of [model.physical], which the design uses, is: "
            f"{physical.status}. File: {model}",
            err=True,
        )
    stated = (None, None) if tables.model is None else (
        tables.model.rate_hz, tables.model.loop_delay_s
    )  # fmt: skip
    rate_hz, delay_s = (
        next(value for value in values if value is not None)
        for values in (
            (loop["rate_hz"], stated[0], usual.rate_hz),
            (loop["delay_s"], stated[1], usual.measurement_delay_s),
        )
    )
    low, high = strains = (-math.inf, math.inf)
    if actuator is not None:
        low, high = actuator.reachable()
        if not allow_start((low, high)):
            raise ResultError(
                f"A loop starts at zero strain, but by the physical model the drive of "
                f"{actuator.low_v:g} to {actuator.high_v:g} V reaches strains of {low:.3g} to "
                f"{high:.3g}. Change the limits of the drive, or define zero strain as the length "
                "at a drive within these limits (zero_length_m) and fit the maps and the model "
                f"again. {model}"
            )
        strains = actuator.sensed_range()
        if strains != (low, high):
            click.echo(
                f"haselab: The limits are strains of {strains[0]:.3g} to {strains[1]:.3g} instead "
                f"of {low:.3g} to {high:.3g}, which the drive reaches: for the rest, the drive is "
                "near 0 V, where the pouches are slack and the capacitance hardly depends on the "
                f"length. File: {model}",
                err=True,
            )
    if actuator is not None and kind.output == "voltage":
        low, high = actuator.low_v, actuator.high_v
    setting = ControllerSetting(1.0 / rate_hz, low, high, delay_s=delay_s, actuator=actuator)
    kind.check(setting)
    if kind.loop is not None:
        assert actuator is not None
        setting = kind.loop(actuator)
        _refuse_other_loop(kind, setting, loop)
        rate_hz, delay_s = 1.0 / setting.period_s, setting.delay_s or 0.0
    assert kind.design is not None
    with waiting(f"design of {kind.name}"):
        chosen = kind.choose(kind.design(setting), model)
    guaranteed = {} if kind.robustness is None else kind.robustness(setting, dict(chosen.values))
    section: dict[str, object] = {
        "kind": kind.name,
        "parameters": dict(chosen.values) or None,
        "limits": dict(zip(("low", "high"), strains, strict=True)) if actuator else None,
        "loop": {"rate_hz": rate_hz, "measurement_delay_s": delay_s},
        "margins": dict(guaranteed) or None,
    }
    _save(model, out, section, None)
    return {"kind": kind.name, "parameters": dict(chosen.values), "rate_hz": rate_hz,
            "delay_s": delay_s, **guaranteed,
            "robustness": _first_paragraph(kind.design)}  # fmt: skip


def _refuse_other_loop(
    kind: ControllerKind, setting: ControllerSetting, loop: dict[str, Any]
) -> None:
    """Refuse timing in the options that is not that of the kind's only loop."""
    own = {"rate_hz": 1.0 / setting.period_s, "delay_s": setting.delay_s or 0.0}
    for name, value in own.items():
        stated, option = loop[name], f"--{name.replace('_', '-')}"
        if stated is not None and abs(stated / value - 1.0) > _TIMING_TOLERANCE:
            raise InputError(
                f"{option} is {stated:g}, but {kind.name} is for the microcontroller, with "
                f"{value:g}. Leave out {option}, or design another kind."
            )


def _first_paragraph(design: Callable[..., object]) -> str:
    """What a design function says of itself."""
    text = (design.__doc__ or "").split("Args:")[0]
    return " ".join(text.split())


def _judge(
    model: Path, out: Path | None, loop: dict[str, Any], as_json: bool, plot: Path | None
) -> None:
    """Compute the margins of a controller other than PI and PID, without designing it."""
    kind = loop["structure"]
    if model.suffix.lower() != ".toml":
        raise InputError(
            f"--controller {kind} reads its parameters from [controller] of an actuator file, but "
            f"the model is not an actuator file. Name one: {model}"
        )
    held = read_controller(model, kind)
    if note := default_note(model, kind):
        click.echo(f"haselab: {note}", err=True)
    rate_hz, delay_s = loop_of(model, loop["rate_hz"], loop["delay_s"])
    limits = limits_of(model, loop["limits"])
    setting = sensed_loop(LoopSetting(rate_hz, delay_s, limits), model)
    plant, feedback = read_any_plant(model), feedback_of(held, rate_hz)
    found = loop_margins(plant, feedback, setting)
    if not found.stable:
        raise ResultError(
            f"The loop with the controller {kind!r} is unstable with a delay of {delay_s:g} s. "
            f"Change its parameters in [controller]: {model}"
        )
    answer = margins_answer(found, setting)
    shown = {name: value for name, value in answer.items() if name not in ("rate_hz", "delay_s")}
    section: dict[str, object] = {
        "kind": held.kind,
        "name": held.name or None,
        "parameters": held.parameters or None,
        "limits": {"low": setting.saturation.low, "high": setting.saturation.high},
        "loop": {"rate_hz": rate_hz, "measurement_delay_s": delay_s},
        "margins": shown,
    }
    _save(model, out, section, None)
    emit(answer | {"parameters": held.parameters, "searched": False}, as_json=as_json, out=None)
    save_plot(plot, lambda: loop_chart(plant, feedback, setting, found.crossover_rad_s))


def _save(model: Path, out: Path | None, section: dict[str, object], spec: Path | None) -> None:
    """Write [controller] into the actuator file of the model, or both into a new one."""
    own = model.suffix.lower() == ".toml"
    if out is not None:
        write_text(out, read_text(model) if own else "# Model and controller of haselab design\n")
        if not own:
            origin = read_origin(model).model_dump(exclude_defaults=True)
            table = {**origin, **read_any_plant(model).to_dict(), **_loop_and_covariance(model)}
            save_section(out, "model", table, [model], MODEL_KEYS)
    target = out or (model if own else None)
    if target is not None:
        inputs = [model] if spec is None else [model, spec]
        name = str(section.get("name") or section["kind"])
        section["alternatives"] = other_controllers(target, name) or None
        save_section(target, "controller", section, inputs, CONTROLLER_KEYS)


def _loop_and_covariance(model: Path) -> dict[str, object]:
    """The loop's rate and delay and the covariance in a model file."""
    if model.suffix.lower() == ".mat":
        return {}
    posterior = read_posterior(model)
    return {**read_loop(model), "covariance": None if posterior is None else posterior.to_dict()}


def _designed(
    plant: AnyPlant,
    posterior: PlantPosterior | None,
    demands: DesignSpec,
    setting: LoopSetting,
    loop: dict[str, Any],
) -> Design:
    return design_controller(
        posterior or plant,
        demands,
        setting,
        rng=np.random.default_rng(loop["seed"]),
        structure=loop["structure"],
        probability=loop["probability"],
        draws=loop["draws"],
        nominal=plant,
    )
