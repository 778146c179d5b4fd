"""`haselab identify transfer`: a transfer function in continuous time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import InputError
from haselab.cli.actuator_file import load_actuator, save_section
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, REAL, SEED, actuator_option, answer_options
from haselab.cli.identify.common import (
    FILES,
    INPUT,
    OUTPUT,
    RATE,
    about,
    give,
    recorded,
)
from haselab.cli.model.sections import MODEL_KEYS, model_section
from haselab.cli.plot import save_plot
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit
from haselab.identify.record import HOLDS, Record
from haselab.identify.transfer.bootstrap import bootstrap_transfer
from haselab.identify.transfer.choice import TransferChoice, choose_transfer
from haselab.identify.transfer.fit import TransferFit, fit_transfer
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.nonlinear import NONLINEAR, fit_nonlinear
from haselab.store.columns.selection import ColumnOptions

__all__ = ["transfer"]


def _delay(text: str) -> str | float:
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError as error:
        raise InputError(
            f"--delay = {text}; allowed is auto or a number of seconds. Correct the option."
        ) from error


def _fixed(pairs: Sequence[str]) -> dict[str, float]:
    """`name=value` options."""
    fixed = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            fixed[name.strip()] = float(value)
        except ValueError as error:
            raise InputError(
                f"--fix = {pair}; allowed is name=number, for example damping_ratio=0.09. "
                "Correct the option."
            ) from error
    return fixed


@click.command("transfer")
@FILES
@INPUT
@OUTPUT
@RATE
@click.option(
    "--poles", type=INTEGER, default=2, show_default=True, help="Poles of the fast part, 1 to 6."
)
@click.option(
    "--zeros", type=INTEGER, default=0, show_default=True, help="Its zeros, at most the poles."
)
@click.option("--delay", default="auto", show_default=True, help="auto, or a known one in s.")
@click.option(
    "--slow-modes",
    type=INTEGER,
    default=0,
    show_default=True,
    help="Slow branches beside it, 0 to 3.",
)
@click.option("--fix", multiple=True, metavar="NAME=VALUE", help="A known number; repeat it.")
@click.option("--at-rest", is_flag=True, help="Each record starts at rest, for sure.")
@click.option("--no-offset", is_flag=True, help="The output has no constant of its own.")
@click.option(
    "--choose", multiple=True,
    type=click.Choice(["poles", "zeros", "delay", "slow-modes", "nonlinear", "all"]),
    help="Let the records choose it (BIC), from the given one on; repeat it.",
)  # fmt: skip
@click.option(
    "--nonlinear", type=click.Choice(NONLINEAR),
    help="Fit a curve of the input (hammerstein), a cubic spring (duffing) or a curve of the "
    "output (wiener) beside the poles.",
)  # fmt: skip
@click.option(
    "--hold", type=click.Choice(HOLDS), default="zero", show_default=True,
    help="The input between its samples: held, straight lines, or measured without aliases.",
)  # fmt: skip
@click.option("--held-at-hz", type=REAL, help="Update rate of the converter, if below the file's.")
@click.option(
    "--bootstrap",
    type=click.IntRange(2, 10_000),
    help="Number of bootstrap replicates for the confidence intervals.",
)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of the bootstrap's noise.")
@click.option("--through-voltage-map", is_flag=True,
              help="Convert the input from V to strain by [drive.voltage_map].")  # fmt: skip
@actuator_option("[drive.voltage_map] is read, [model] is written with its covariance.")
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
    """Transfer function in continuous time, with intervals.

    Several FILES give one model, each with its own initial state and offset: a chirp for the
    resonance, steps for the slow branches. A number that the files do not determine is shown as
    not identifiable.
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
            "--through-voltage-map needs the map in an actuator file. Name it by --actuator."
        )
    if actuator is not None:
        load_actuator(actuator)  # before a long fit
    records: list[Record] = []
    notes: list[str] = []
    unit = ""
    for file in files:
        with about(file):
            found_records = recorded(
                file,
                (source, output),
                rate_hz,
                options["held_at_hz"],
                columns,
                hold=options["hold"],
                through=actuator if options["through_voltage_map"] else None,
            )
            records += found_records.records
            notes += found_records.notes
            unit = found_records.input_unit
    found: TransferFit | TransferChoice
    fit: TransferFit
    if options["nonlinear"] and options["choose"]:
        raise InputError(
            f"--nonlinear {options['nonlinear']} with --choose; allowed is one of them. Use "
            "--choose nonlinear to let the records choose."
        )
    if options["nonlinear"] and options["bootstrap"] is not None:
        raise InputError(
            "--bootstrap with --nonlinear; allowed is a linear model. Leave --bootstrap out."
        )
    with about(*files):
        if options["nonlinear"]:
            found = fit = fit_nonlinear(records, structure, options["nonlinear"])
        elif options["choose"]:
            found = choose_transfer(records, structure, _varied(options["choose"]))
            fit = found.fit
        else:
            found = fit = fit_transfer(records, structure)
    more: dict[str, Any] = {}
    if notes:
        more["notes"] = [*fit.notes, *notes]
    if options["bootstrap"] is not None and fit.succeeded:
        rng = np.random.default_rng(options["seed"])
        if isinstance(fit, NonlinearFit):
            raise InputError(
                f"--bootstrap with a {fit.kind} model; allowed is a linear one. Leave it out."
            )
        more["bootstrap"] = bootstrap_transfer(fit, options["bootstrap"], rng)
    give(found, files, as_json, out, more)
    if actuator is not None:
        modelled = "strain" if options["through_voltage_map"] else source
        _save(actuator, fit, (modelled, output), unit, files)
    save_plot(plot, lambda: fit.chart((source, output)))


def _save(
    actuator: Path,
    fit: TransferFit,
    names: tuple[str, str],
    unit: str,
    files: tuple[Path, ...],
) -> None:
    """Write [model] of the actuator file."""
    if isinstance(fit, NonlinearFit):
        raise InputError(
            f"--actuator with a {fit.kind} model, but [model] takes a linear one. Leave "
            f"--nonlinear out, or write the model with --out. {actuator}"
        )
    section = model_section(fit, *names, unit)
    save_section(actuator, "model", section, files, MODEL_KEYS)


def _varied(choices: Sequence[str]) -> list[str]:
    names = ["poles", "zeros", "delay", "slow_modes", "nonlinear"]
    return names if "all" in choices else [choice.replace("-", "_") for choice in choices]
