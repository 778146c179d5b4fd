"""`haselab identify frequency-response` and `free-response`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import Estimate, InputError, ResultError
from haselab.base.chart import gain_label
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, REAL, answer_options, emit
from haselab.cli.identify.common import (
    FILES,
    INPUT,
    OUTPUT,
    RATE,
    axis_names,
    emit_fit,
    rate_hz_of,
    read_valid,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.free.response import FreeTrial, fit_free_response
from haselab.identify.frequency.fit import ResponseFit
from haselab.identify.frequency.response import (
    RESPONSE_METHODS,
    FrequencyResponse,
    estimate_frequency_response,
)
from haselab.identify.record import Record
from haselab.identify.transfer.layout import TransferStructure
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import Table

__all__ = ["free_response", "frequency_response"]


@click.command("frequency-response")
@FILES
@INPUT
@OUTPUT
@RATE
@shared_option(
    "--method", type=click.Choice(RESPONSE_METHODS), default="rational", show_default=True,
    detail="rational, polynomial: local models; h1, h2, hv: averaged segments; periodic: whole "
    "periods of the drive.",
)  # fmt: skip
@click.option(
    "--period-s", type=REAL,
    help="Set the period of the drive in s, for the method periodic. Default: none.",
)  # fmt: skip
@click.option(
    "--segment-s", type=REAL,
    help="Set the length of a segment in s, for h1, h2 and hv. Default: 1/8 of the longest record.",
)  # fmt: skip
@click.option(
    "--measured-input", is_flag=True,
    help="Treat the input as measured instead of held between its samples.",
)  # fmt: skip
@click.option("--fit", "fitted", is_flag=True, help="Fit a resonance with a delay to the response.")
@shared_option("--slow-modes", type=INTEGER, default=0, show_default=True, detail="Needs --fit.")
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
    """Estimate the frequency response (Bode plot).

    The answer includes coherence and standard deviations. Several FILES give one estimate.
    """
    tables = [read_valid(file, [source, output], columns) for file in files]
    rate = _common_rate_hz(tables, rate_hz, files)
    hold = "band-limited" if choice["measured_input"] else "zero"
    response = estimate_frequency_response(
        [Record.sampled(table[source], table[output], rate, hold=hold) for table in tables],
        method=choice["method"],
        period_s=choice["period_s"],
        segment_s=choice["segment_s"],
    )
    answer = {"method": choice["method"], **response.answer()}
    names = axis_names(source, output, tables[0])
    if not choice["fitted"] or not response.succeeded:
        unit = gain_label("", *names).strip(" ()")
        emit(answer, as_json=as_json, out=out, shorter=_peak(response, unit))
        if not response.succeeded:
            raise ResultError(f"{response.status}: {' '.join(str(file) for file in files)}")
        save_plot(plot, lambda: response.chart(names=names))
        return
    fit = response.fit(TransferStructure(slow_modes=choice["slow_modes"]))
    if as_json or out is not None:
        # `design` and `export` read the plant. It has no covariance.
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
    save_plot(plot, lambda: response.chart(fitted, names))


def _peak(response: FrequencyResponse, unit: str) -> dict[str, Any]:
    """Frequency range and highest magnitude, of the lines whose phase is known within 0.5 rad."""
    hz, size = response.frequency_hz, np.abs(response.response)
    known = response.succeeded & (hz > 0.0) & (response.magnitude_std < 0.5 * size)
    if not np.any(known):
        return {}
    at = int(np.argmax(np.where(known, size, -np.inf)))
    return {
        "range_hz": [float(hz.min()), float(hz.max())]
        if len(response.bands) == 1
        else response.bands_text,
        "peak_frequency_hz": float(hz[at]),
        "peak_magnitude": Estimate.normal(float(size[at]), float(response.magnitude_std[at]), unit),
    }


def _is_plant(fit: ResponseFit) -> bool:
    """Whether all parameters of the plant are identifiable."""
    return fit.succeeded and all(math.isfinite(e.value) for e in fit.parameters.values())


def _common_rate_hz(tables: Sequence[Table], given: float | None, files: Sequence[Path]) -> float:
    rates = [rate_hz_of(table, given, file) for table, file in zip(tables, files, strict=True)]
    if max(rates) - min(rates) > 1e-6 * rates[0]:
        listed = ", ".join(f"{rate:g}" for rate in rates)
        raise InputError(
            f"The files have different sampling rates: {listed} Hz. Resample them, or use each "
            f"file separately: {' '.join(str(file) for file in files)}"
        )
    return rates[0]


@click.command("free-response")
@FILES
@shared_option("--output", default="x", show_default=True, detail="It is the measured motion.")
@RATE
@click.option(
    "--creep/--no-creep", default=None,
    help="Fit an exponential in addition to the oscillation, or do not. Default: chosen from the "
    "data.",
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
    """Fit a decaying oscillation to a free response.

    The model is eqs. 6 and 7 of the paper. The answer includes the decay rate, the damped and the
    natural frequency and both envelopes. Several FILES are repeated trials.
    """
    trials = []
    for file in files:
        table = read_valid(file, [output], columns, ["--output"])
        rate = rate_hz_of(table, rate_hz, file)
        trials.append(FreeTrial(table[output], np.arange(table[output].size) / rate))
    fit = fit_free_response(trials, creep=creep)
    emit_fit(fit, files, as_json, out)
    save_plot(plot, lambda: fit.chart(("", output)))
