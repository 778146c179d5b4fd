"""`haselab identify hysteresis` and `creep`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import Estimate
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, REAL, answer_options, waiting
from haselab.cli.identify.common import (
    FILE,
    FILES,
    INPUT,
    OUTPUT,
    RATE,
    axis_names,
    emit_fit,
    rate_hz_of,
    read_valid,
    refuse_copies,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.creep.fit import CreepFit, fit_creep
from haselab.identify.hysteresis.fit import LoopRecord, fit_hysteresis
from haselab.identify.record import Record
from haselab.store.columns.selection import ColumnOptions

__all__ = ["creep", "hysteresis"]


@click.command("hysteresis")
@FILES
@INPUT
@OUTPUT
@RATE
@shared_option(
    "--model", type=click.Choice(["auto", "prandtl-ishlinskii", "bouc-wen"]), default="auto",
    show_default=True, detail="auto: the one that fits the data best.",
)  # fmt: skip
@click.option(
    "--operators",
    type=INTEGER,
    help="Set the number of play operators, 1 to 20. Default: chosen by BIC.",
)
@click.option(
    "--from-s", type=REAL, default=0.0, show_default=True,
    help="Ignore samples before this time, in s.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def hysteresis(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    model: str,
    operators: int | None,
    from_s: float,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit a hysteresis model, with its inverse, to loops.

    The answer includes the width of the loop and whether it depends on the rate. Several FILES,
    with loops at several rates, give one rate-dependent model.
    """
    records = []
    for file in files:
        table = read_valid(file, [source, output], columns)
        rate = rate_hz_of(table, rate_hz, file)
        records.append(LoopRecord(table[source], table[output], rate, from_s))
    refuse_copies(files, [record.y for record in records])
    with waiting("fit of the hysteresis"):
        fit = fit_hysteresis(records, model, operators=operators)
    emit_fit(fit, files, as_json, out)
    save_plot(plot, lambda: fit.chart(axis_names(source, output, table)))


@dataclass(frozen=True)
class _Forecast:
    """A creep fit whose answer includes a forecast."""

    fit: CreepFit
    after_s: float | None

    @property
    def status(self) -> str:
        return self.fit.status

    @property
    def succeeded(self) -> bool:
        return self.fit.succeeded

    def answer(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.fit.answer()
        if self.after_s is not None and self.succeeded:
            output: Estimate = self.fit.forecast(self.after_s)
            answer["forecast"] = {"after_s": self.after_s, "output": output}
        return answer


@click.command("creep")
@FILE
@INPUT
@OUTPUT
@RATE
@shared_option(
    "--model", type=click.Choice(["auto", "prony", "fractional", "logarithmic"]), default="auto",
    show_default=True, detail="prony: exponentials; auto: the one that fits the data best.",
)  # fmt: skip
@click.option(
    "--unit-step", is_flag=True,
    help="Use an input of 1 from the first row on instead of a column.",
)  # fmt: skip
@click.option(
    "--input-before", type=REAL,
    help="Set the constant input before the record. Default: 0 if the input never changes, else "
    "its first value.",
)  # fmt: skip
@click.option(
    "--leave-out-s", type=REAL, default=0.0, show_default=True,
    help="Leave out this time after each change of the input, in s.",
)  # fmt: skip
@click.option(
    "--forecast-s", type=REAL,
    help="Forecast the output this long after the end of the record, in s. Default: no forecast.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def creep(
    file: Path,
    source: str,
    output: str,
    rate_hz: float | None,
    model: str,
    unit_step: bool,
    input_before: float | None,
    leave_out_s: float,
    forecast_s: float | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit a creep law to the response to a held input.

    The laws are a sum of exponentials, a fractional law and a logarithm. FILE has the columns of
    input and output.
    """
    table = read_valid(file, [output] if unit_step else [source, output], columns)
    rate = rate_hz_of(table, rate_hz, file)
    u = np.ones(table[output].size) if unit_step else table[source]
    record = Record.sampled(u, table[output], rate, input_before)
    with waiting("fit of the creep"):
        fit = fit_creep(record, model, leave_out_s=leave_out_s)
    emit_fit(_Forecast(fit, forecast_s), [file], as_json, out)
    save_plot(plot, lambda: fit.chart(axis_names(source, output, table)))
