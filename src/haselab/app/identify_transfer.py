"""`haselab identify transfer`: a transfer function in continuous time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from haselab.app.common import answer_options
from haselab.app.identify_common import FILES, INPUT, OUTPUT, RATE, give, rate_hz_of
from haselab.base import InputError
from haselab.identify.record import Record
from haselab.identify.transfer import TransferStructure, fit_transfer
from haselab.store.tables import read_table

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
@click.option("--poles", default=2, show_default=True, help="Poles of the fast part, 1 to 6.")
@click.option("--zeros", default=0, show_default=True, help="Its zeros, fewer than the poles.")
@click.option("--delay", default="auto", show_default=True, help="auto, or a known one in s.")
@click.option("--slow-modes", default=0, show_default=True, help="Slow branches beside it, 0 to 3.")
@click.option("--fix", multiple=True, metavar="NAME=VALUE", help="A known number; repeat it.")
@click.option("--at-rest", is_flag=True, help="Each record starts at rest, for sure.")
@click.option("--no-offset", is_flag=True, help="The output has no constant of its own.")
@answer_options
def transfer(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    as_json: bool,
    out: Path | None,
    **structure: Any,
) -> None:
    """Transfer function in continuous time, with intervals.

    Several FILES give one model, each with its own initial state and offset: a chirp for the
    resonance, steps for the slow branches.
    """
    wanted = TransferStructure(
        poles=structure["poles"],
        zeros=structure["zeros"],
        delay=_delay(structure["delay"]),
        slow_modes=structure["slow_modes"],
        offset=not structure["no_offset"],
        initial_state=not structure["at_rest"],
        fixed=_fixed(structure["fix"]),
    )
    records = []
    for file in files:
        table = read_table(file, [source, output])
        rate = rate_hz_of(table, rate_hz, file)
        records.append(Record.sampled(table[source], table[output], rate))
    give(fit_transfer(records, wanted), files, as_json, out)
