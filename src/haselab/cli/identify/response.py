"""`haselab identify frequency-response` and `free-response`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import InputError, ResultError
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, REAL, answer_options, emit
from haselab.cli.identify.common import FILES, INPUT, OUTPUT, RATE, give, rate_hz_of, read_valid
from haselab.cli.plot import save_plot
from haselab.identify.charts import response_chart
from haselab.identify.free.response import FreeTrial, fit_free_response
from haselab.identify.frequency.fit import ResponseFit
from haselab.identify.frequency.response import RESPONSE_METHODS, estimate_frequency_response
from haselab.identify.transfer.layout import TransferStructure
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import Table

__all__ = ["free_response", "frequency_response"]


@click.command("frequency-response")
@FILES
@INPUT
@OUTPUT
@RATE
@click.option(
    "--method", type=click.Choice(RESPONSE_METHODS), default="rational", show_default=True,
    help="Local models (rational, polynomial), averaged segments (h1, h2, hv), whole periods.",
)  # fmt: skip
@click.option("--period-s", type=REAL, help="Period of the drive, for periodic.")
@click.option("--segment-s", type=REAL, help="Length of a segment, for h1, h2, hv.")
@click.option("--measured-input", is_flag=True, help="The input was measured, not held.")
@click.option("--fit", "fitted", is_flag=True, help="Fit a resonance with a delay to the lines.")
@click.option(
    "--slow-modes", type=INTEGER, default=0, show_default=True, help="Slow branches of that fit."
)
@column_options
@answer_options(plot=True)
def frequency_response(
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **choice: Any,
) -> None:
    """Bode estimate with coherence and standard deviations; several FILES are one estimate."""
    tables = [read_valid(file, [source, output], columns) for file in files]
    response = estimate_frequency_response(
        [table[source] for table in tables],
        [table[output] for table in tables],
        _common_rate_hz(tables, rate_hz, files),
        method=choice["method"],
        held=not choice["measured_input"],
        period_s=choice["period_s"],
        segment_s=choice["segment_s"],
    )
    answer = {"method": choice["method"], **response.answer()}
    if not choice["fitted"] or not response.succeeded:
        emit(answer, as_json=as_json, out=out)
        if not response.succeeded:
            raise ResultError(f"{response.status}: {' '.join(str(file) for file in files)}")
        save_plot(plot, lambda: response_chart("Frequency response", response, None))
        return
    fit = response.fit(TransferStructure(slow_modes=choice["slow_modes"]))
    if as_json or out is not None:
        # `design` and `export` read the plant; it has no covariance, so no share is reported.
        plant = {"plant": fit.plant.to_dict()} if _is_plant(fit) else {}
        emit(answer | {"fit": fit.answer()} | plant, as_json=as_json, out=out)
    if not as_json:
        emit(fit.answer(), as_json=False, out=None)
    if not fit.succeeded:
        raise ResultError(f"{fit.status}: {' '.join(str(file) for file in files)}")
    fitted = (
        fit.plant.frequency_response(2.0 * math.pi * response.frequency_hz)
        if _is_plant(fit)
        else None
    )
    save_plot(plot, lambda: response_chart("Frequency response and fit", response, fitted))


def _is_plant(fit: ResponseFit) -> bool:
    """Whether all numbers of the plant were estimated."""
    return fit.succeeded and all(math.isfinite(e.value) for e in fit.parameters.values())


def _common_rate_hz(tables: Sequence[Table], given: float | None, files: Sequence[Path]) -> float:
    rates = [rate_hz_of(table, given, file) for table, file in zip(tables, files, strict=True)]
    if max(rates) - min(rates) > 1e-6 * rates[0]:
        listed = ", ".join(f"{rate:g}" for rate in rates)
        raise InputError(
            f"The files have {listed} Hz; allowed is one rate. Resample them, or ask for each "
            f"alone: {' '.join(str(file) for file in files)}"
        )
    return rates[0]


@click.command("free-response")
@FILES
@click.option("--output", default="x", show_default=True, help="Column of the motion.")
@RATE
@click.option(
    "--creep/--no-creep", default=None, help="Fit an exponential beside the oscillation, or not; "
    "the data decide when not given.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def free_response(
    files: tuple[Path, ...],
    output: str,
    rate_hz: float | None,
    creep: bool | None,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Decay, damped and natural frequency (eqs. 6 and 7), hull curves; several FILES are trials."""
    trials = []
    for file in files:
        table = read_valid(file, [output], columns, ["--output"])
        rate = rate_hz_of(table, rate_hz, file)
        trials.append(FreeTrial(table[output], np.arange(table[output].size) / rate))
    fit = fit_free_response(trials, creep=creep)
    give(fit, files, as_json, out)
    save_plot(plot, lambda: fit.chart(("", output)))
