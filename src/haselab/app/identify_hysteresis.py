"""`haselab identify hysteresis` and `creep`."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.app.common import answer_options
from haselab.app.identify_common import FILES, INPUT, OUTPUT, RATE, give, rate_hz_of
from haselab.identify.hysteresis import LoopRecord, fit_hysteresis
from haselab.store.tables import read_table

__all__ = ["hysteresis"]


@click.command("hysteresis")
@FILES
@INPUT
@OUTPUT
@RATE
@click.option(
    "--model", type=click.Choice(["auto", "prandtl-ishlinskii", "bouc-wen"]), default="auto",
    show_default=True, help="Which model; the data decide when auto.",
)  # fmt: skip
@click.option("--operators", type=int, help="Play operators; chosen by BIC when not given.")
@answer_options
def hysteresis(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    model: str,
    operators: int | None,
    *,
    as_json: bool,
    out: Path | None,
) -> None:
    """Loops to a hysteresis model with an inverse: width, rate dependence, verdict.

    Several FILES, loops at several rates, give one rate-dependent model.
    """
    records = []
    for file in files:
        table = read_table(file, [source, output])
        rate = rate_hz_of(table, rate_hz, file)
        records.append(LoopRecord(table[source], table[output], rate))
    give(fit_hysteresis(records, model, operators), files, as_json, out)
