"""`haselab identify transfer`: fit a transfer function in continuous time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import HaselabError, InputError, ResultError
from haselab.cli.actuator_file import load_actuator, save_section
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, REAL, SEED, actuator_option, answer_options, waiting
from haselab.cli.identify.common import (
    FILES,
    INPUT,
    MONITOR_SCALE,
    OUTPUT,
    RATE,
    axis_names,
    emit_fit,
    name_files_in_errors,
    output_name,
    read_recorded,
    refuse_copies,
    unit_text,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.control.plants.general import PlantScale
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit
from haselab.identify.record import HOLDS, Record
from haselab.identify.transfer.bootstrap import bootstrap_transfer
from haselab.identify.transfer.choice import TransferChoice, choose_transfer
from haselab.identify.transfer.fit import TransferFit, fit_transfer
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.nonlinear import NONLINEAR, fit_nonlinear
from haselab.pipelines.design.sections import MODEL_KEYS, model_section
from haselab.store.columns.selection import ColumnOptions

_RELATED = 1e-3  # probability below which the residuals follow the input
_SMALL = 0.1  # of the motion of the slow modes: residuals that do not change them
_FAR_GAIN = 5.0  # creep and a map of another loop change the gain by less

__all__ = ["transfer"]


def _delay(text: str) -> str | float:
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"--delay is {text}. Use auto or a number of seconds.") from error


def _fixed(pairs: Sequence[str]) -> dict[str, float]:
    """Parse the options `NAME=VALUE`."""
    fixed = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            fixed[name.strip()] = float(value)
            if not math.isfinite(fixed[name.strip()]):
                raise ValueError
        except ValueError as error:
            raise InputError(
                f"--fix is {pair}. Use NAME=NUMBER, for example damping_ratio=0.09."
            ) from error
    return fixed


@click.command("transfer")
@FILES
@INPUT
@OUTPUT
@RATE
@click.option(
    "--poles", type=INTEGER, default=2, show_default=True,
    help="Set the number of poles besides those of the slow modes, 1 to 6.",
)  # fmt: skip
@click.option(
    "--zeros", type=INTEGER, default=0, show_default=True,
    help="Set the number of zeros, 0 to the number of poles.",
)  # fmt: skip
@click.option(
    "--delay", default="auto", show_default=True, metavar="auto|S",
    help="Estimate the delay (auto), or fix it at this value in s.",
)  # fmt: skip
@shared_option("--slow-modes", type=INTEGER, default=0, show_default=True)
@click.option(
    "--fix", multiple=True, metavar="NAME=VALUE",
    help="Fix a parameter at a known value. Repeat the option for more. Default: none.",
)  # fmt: skip
@shared_option("--at-rest", is_flag=True, detail="Its initial state is then not estimated.")
@click.option("--no-offset", is_flag=True, help="Assume that the output has no constant offset.")
@click.option(
    "--choose", multiple=True,
    type=click.Choice(["poles", "zeros", "delay", "slow-modes", "nonlinear", "all"]),
    help="Choose this part of the structure by BIC, starting at the given value. Repeat the option "
    "for more. Default: none.",
)  # fmt: skip
@click.option(
    "--nonlinear", type=click.Choice(NONLINEAR),
    help="Add a nonlinear curve of the input (hammerstein), a cubic spring (duffing) or a curve of "
    "the output (wiener). Default: none.",
)  # fmt: skip
@shared_option("--hold", type=click.Choice(HOLDS), detail="Default: zero.")
@shared_option("--held-at-hz", type=REAL, detail="Default: the sampling rate of the file.")
@shared_option("--bootstrap", type=click.IntRange(2, 10_000), detail="Default: no bootstrap.")
@shared_option(
    "--seed", type=SEED, default=1, show_default=True, detail="Only --bootstrap uses it."
)
@shared_option("--through-voltage-map", is_flag=True)
@MONITOR_SCALE
@actuator_option("The command reads [drive.voltage_map] and writes [model] with its covariance.")
@column_options
@answer_options(plot=True)
def transfer(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    actuator: Path | None,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Fit a transfer function in continuous time.

    Several FILES give one model, each with its own initial state and offset: for example a chirp
    for the resonance and steps for the slow modes. A parameter that the files do not determine is
    reported as not identifiable.
    """
    structure = TransferStructure(
        poles=options["poles"],
        zeros=options["zeros"],
        delay=_delay(options["delay"]),
        slow_modes=options["slow_modes"],
        offset=not options["no_offset"],
        initial_state=not options["at_rest"],
        fixed=_fixed(options["fix"]),
    )
    if actuator is None and options["through_voltage_map"]:
        raise InputError(
            "--through-voltage-map needs the map in an actuator file. Name the file with "
            "--actuator."
        )
    if actuator is None and options["volt_per_monitor_volt"] is not None:
        raise InputError(
            "--volt-per-monitor-volt needs gain_v_per_v in [drive] of an actuator file. Name the "
            "file with --actuator."
        )
    if actuator is not None:
        if options["nonlinear"]:
            raise InputError(
                f"--nonlinear {options['nonlinear']} excludes --actuator: [model] of an actuator "
                "file is linear. Leave out --nonlinear, or write --out FILE in place of --actuator."
            )
        load_actuator(actuator, to_write=True)  # before a long fit
    records: list[Record] = []
    origins: list[Path] = []
    units = ("", "")
    for file in files:
        with name_files_in_errors(file):
            found_records = read_recorded(
                file,
                (source, output),
                rate_hz,
                options["held_at_hz"],
                columns,
                hold=options["hold"],
                through=actuator if options["through_voltage_map"] else None,
                drive_of_file=actuator,
                volt_per_monitor_volt=options["volt_per_monitor_volt"],
            )
            records += found_records.records
            origins += [file] * len(found_records.records)
            units = _agreed(units, found_records.units, (source, output))
    refuse_copies(origins, [record.y for record in records])
    outputs = sum(record.y.size for record in records)
    found: TransferFit | TransferChoice
    fit: TransferFit
    if options["nonlinear"] and options["choose"]:
        raise InputError(
            f"--nonlinear {options['nonlinear']} excludes --choose. Use --choose nonlinear to "
            "choose the nonlinear part by BIC."
        )
    if options["nonlinear"] and options["bootstrap"] is not None:
        raise InputError("--bootstrap needs a linear model. Leave out --bootstrap or --nonlinear.")
    with name_files_in_errors(*files), waiting(f"fit {outputs:,} outputs"):
        if options["nonlinear"]:
            found = fit = fit_nonlinear(records, structure, options["nonlinear"])
        elif options["choose"]:
            found = choose_transfer(records, structure, _varied(options["choose"]))
            fit = found.fit
        else:
            found = fit = fit_transfer(records, structure)
    modelled = "strain" if options["through_voltage_map"] else source
    measured = output_name(output, units[1], options["through_voltage_map"])
    more: dict[str, Any] = {"input": modelled, "output": measured}
    more |= {f"{end}_unit": unit for end, unit in zip(more, units, strict=True) if unit}
    if all(units):
        more["gain_unit"] = units[1] if units[0] == "1" else f"{units[1]}/{units[0]}"
    if options["bootstrap"] is not None and fit.succeeded:
        rng = np.random.default_rng(options["seed"])
        if isinstance(fit, NonlinearFit):
            raise InputError(
                f"--bootstrap needs a linear model, but {fit.kind} was chosen. Leave it out."
            )
        more["bootstrap"] = bootstrap_transfer(fit, options["bootstrap"], rng)
    section: dict[str, object] | None = None
    refused: HaselabError | None = None
    if actuator is not None and fit.succeeded:
        through = options["through_voltage_map"]
        try:
            section = _section(actuator, fit, (modelled, measured), units, through)
        except ResultError as error:
            refused = ResultError(f"{error}: {' '.join(str(file) for file in files)}")
            more["status"] = str(error)
        except InputError as error:
            refused, more["status"] = error, str(error)
        if through and (note := _note_on_slow_modes(fit)):
            said = found.answer()["notes"]
            more["notes"] = [*(said if isinstance(said, list) else []), note]
    emit_fit(found, files, as_json, out, more)
    if refused is not None:  # after the answer, whose status says so too
        raise refused
    if actuator is not None and section is not None:
        if options["through_voltage_map"]:
            _warn_of_gain(fit, output, units[1])
        save_section(actuator, "model", section, files, MODEL_KEYS)
    save_plot(plot, lambda: fit.chart(axis_names(modelled, measured, units)))


def _section(
    actuator: Path,
    fit: TransferFit,
    names: tuple[str, str],
    units: tuple[str, str],
    through_map: bool,
) -> dict[str, object]:
    """[model] of the actuator file."""
    if isinstance(fit, NonlinearFit):
        raise InputError(
            f"[model] was not changed: it needs a linear model, but --choose selected {fit.kind}. "
            f"Leave out --choose nonlinear (or all), or write the model with --out. {actuator}"
        )
    section = model_section(fit, names, units)
    used = load_actuator(actuator).drive.voltage_map if through_map else None
    section["through_voltage_map"] = None if used is None else used.coefficients
    return section


def _note_on_slow_modes(fit: TransferFit) -> str:
    """A note if the error of the voltage map is as large as the slow modes that were fitted.

    The map is a sum of two exponentials. Where its slope is off by 10 %, a step of the strain
    differs by as much as a creep of 10 %, and no interval contains this.
    """
    if fit.input_range is None or not fit.slow_modes or fit.input_correlation_p > _RELATED:
        return ""
    slow = sum(abs(gain.value) for gain, _ in fit.slow_modes)
    half = 0.5 * (fit.input_range[1] - fit.input_range[0])
    residual_std = float(np.sqrt(np.mean(np.concatenate(fit.residuals) ** 2)))
    if residual_std < _SMALL * slow * half:  # false for a slow mode that is not identifiable
        return ""
    return (
        "The residuals follow the input and are not small beside the slow modes, for example "
        "because the voltage map is not exact; the intervals of the slow modes do not include "
        "this. Fit the slow modes from the drive: leave out --through-voltage-map and --actuator, "
        "and add --nonlinear hammerstein-2. If its residuals are smaller beside its output, repeat "
        "this command with --fix slow_time_constant_s=... and --fix slow_gain=..., the slow gain "
        "of that fit divided by its gain."
    )


def _agreed(
    known: tuple[str, str], new: tuple[str, str], names: tuple[str, str]
) -> tuple[str, str]:
    """Units of input and output; files that state different ones are refused."""
    for name, one, other in zip(names, known, new, strict=True):
        if one and other and one != other:
            raise InputError(
                f"Column {name} is {unit_text(other)}, but in another file {unit_text(one)}. One "
                "model needs one quantity. Fit the files separately, or state the unit with --unit."
            )
    return known[0] or new[0], known[1] or new[1]


def _warn_of_gain(fit: TransferFit, output: str, unit: str) -> None:
    """Warn of a static gain far from 1 of a model that should be from strain to strain."""
    gain = PlantScale.of(fit.plant).gain
    if unit in ("", "1") and not 1.0 / _FAR_GAIN <= abs(gain) <= _FAR_GAIN:
        click.echo(
            f"haselab: warning: the static gain is {gain:.3g}; a model from strain (by the voltage "
            f"map) to strain has about 1. Is column {output} a strain of the same actuator? If "
            f"it is a displacement, state its unit: --unit '{output}=m', or mm.",
            err=True,
        )


def _varied(choices: Sequence[str]) -> list[str]:
    names = ["poles", "zeros", "delay", "slow_modes", "nonlinear"]
    return names if "all" in choices else [choice.replace("-", "_") for choice in choices]
