"""`haselab sense FILE`: monitor voltages to capacitance, block by block."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
from numpy.typing import NDArray

from haselab.app.common import answer_options, emit
from haselab.base import InputError, ResultError
from haselab.sensing import (
    Lockin,
    LockinConfig,
    PaperChain,
    Sensed,
    SineFit,
    relative_capacitance,
)
from haselab.store.tables import read_table

__all__ = ["command"]

F = TypeVar("F", bound=Callable[..., Any])

_METHODS: dict[str, Callable[[LockinConfig], Lockin | SineFit | PaperChain]] = {
    "lockin": Lockin,
    "sinefit": SineFit,
    "paper": PaperChain,
}
_MONITORS = ("v_monitor_v", "i_monitor_v")
_MIN_AMPLITUDE_V = 1e-6  # below any converter's step: a channel that is not connected


@dataclass(frozen=True)
class _Request:
    """What the user asked for, beyond the file and the answer's place."""

    carrier_hz: float
    rate_hz: float | None
    block_s: float
    method: str
    skew_s: float
    blank_s: float
    volt_per_monitor_volt: float
    ampere_per_monitor_volt: float
    reactance_scale: float
    capacitance_scale: float


def _positive(context: click.Context, parameter: click.Parameter, value: float | None) -> Any:
    """Refuse a number that is not above 0 and finite."""
    del context
    if value is not None and not 0.0 < value < float("inf"):
        raise click.BadParameter(f"{value:g} is not a positive number.", param=parameter)
    return value


def _option(name: str, text: str, **settings: Any) -> Callable[[F], F]:
    return click.option(name, type=float, callback=_positive, help=text, **settings)


def _scale(name: str, default: float, text: str) -> Callable[[F], F]:
    return _option(name, text, default=default, show_default=True)


def _read(path: Path, rate_hz: float | None) -> tuple[NDArray[np.float64], float]:
    """Both monitors, shape `(samples, 2)`, and their rate: the user's, or else the file's."""
    table = read_table(path, _MONITORS)
    rate_hz = rate_hz or table.rate_hz
    if rate_hz is None:
        raise InputError(f"The file does not tell its sampling rate. Add --rate-hz. {path}")
    return np.stack([table[name] for name in _MONITORS], axis=1), rate_hz


def _configure(request: _Request, rate_hz: float) -> LockinConfig:
    return LockinConfig(
        rate_hz=rate_hz,
        block_samples=round(request.block_s * rate_hz),
        carrier_hz=request.carrier_hz,
        skew_s=request.skew_s,
        ohm_per_ratio=request.volt_per_monitor_volt / request.ampere_per_monitor_volt,
        first_sample=round(request.blank_s * rate_hz),
        min_amplitude_codes=_MIN_AMPLITUDE_V,
    )


def _columns(sensed: Sensed, request: _Request) -> dict[str, NDArray[Any]]:
    """The contract's columns, in its order; the numbers of lost blocks are NaN."""
    relative = np.full(sensed.valid.shape, np.nan)
    relative[sensed.valid] = relative_capacitance(
        sensed.v_pp[sensed.valid],
        sensed.i_pp[sensed.valid],
        sensed.phase_rad[sensed.valid],
        frequency_hz=request.carrier_hz,
        reactance_scale=request.reactance_scale,
        capacitance_scale=request.capacitance_scale,
    )
    return {
        "time_s": sensed.time_s,
        "capacitance_f": sensed.capacitance_f,
        "capacitance_std_f": sensed.capacitance_std_f,
        "resistance_ohm": sensed.resistance_ohm,
        "relative_capacitance": relative,
        "phase_rad": sensed.phase_rad,
        "v_pp_v": sensed.v_pp,
        "i_pp_v": sensed.i_pp,
        "valid": sensed.valid.astype(np.int64),
    }


def _write(columns: dict[str, NDArray[Any]], path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))


def _sense(path: Path, request: _Request) -> tuple[dict[str, NDArray[Any]], int]:
    """Columns, and how many samples at the end did not fill a block."""
    record, rate_hz = _read(path, request.rate_hz)
    config = _configure(request, rate_hz)
    method = _METHODS[request.method](config)
    blocks = len(record) // config.block_samples
    if blocks == 0:
        raise InputError(
            f"The record has {len(record)} samples, a block {config.block_samples}. Shorten "
            f"--block-s to {len(record) / rate_hz:g} s or less. {path}"
        )
    used = blocks * config.block_samples
    sensed = method.sense(record[:used].reshape(blocks, config.block_samples, 2))
    if not sensed.valid.any():
        raise ResultError(
            f"No block of {blocks} shows a carrier at {request.carrier_hz:g} Hz on both monitors. "
            f"Check --carrier-hz, --rate-hz and the sensing signal. {path}"
        )
    return _columns(sensed, request), len(record) - used


@click.command("sense")
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@_option("--carrier-hz", "Frequency of the sensing signal.", required=True)
@_option("--rate-hz", "Samples per second and channel; default: what the file tells.")
@_scale("--block-s", 0.01, "Length of a block: one result each.")
@click.option(
    "--method",
    type=click.Choice(list(_METHODS)),
    default="lockin",
    show_default=True,
    help="lockin: best; sinefit: carrier not exactly known; paper: the study's own chain.",
)
@click.option(
    "--skew-s",
    type=float,
    default=0.0,
    show_default=True,
    help="Time from a voltage sample to its current sample.",
)
@click.option(
    "--blank-s",
    type=click.FloatRange(min=0.0),
    default=0.0,
    show_default=True,
    help="Start of each block that does not count, after an output's step.",
)
@_scale("--volt-per-monitor-volt", 5000.0, "Scale of the voltage monitor.")
@_scale("--ampere-per-monitor-volt", 2e-3, "Scale of the current monitor.")
@_scale("--reactance-scale", 2.5e6, "Of eq. 2, for relative_capacitance alone.")
@_scale("--capacitance-scale", 10.0, "Of eq. 3, for relative_capacitance alone.")
@answer_options
def command(file: Path, as_json: bool, out: Path | None, **options: Any) -> None:
    """Capacitance and series resistance from the records of both monitors.

    FILE has the columns v_monitor_v and i_monitor_v (CSV, .mat, .npz, .h5 or .tdms). --out names
    a CSV file with one row a block.
    """
    request = _Request(**options)
    columns, left_over = _sense(file, request)
    if out is not None:
        _write(columns, out)
    if left_over:
        click.echo(f"haselab: {left_over} samples at the end fill no block and are left.", err=True)
    valid = columns["valid"] == 1
    answer = {
        "method": request.method,
        "blocks": valid.size,
        "valid_blocks": int(valid.sum()),
        "median_capacitance_f": float(np.median(columns["capacitance_f"][valid])),
        "median_resistance_ohm": float(np.median(columns["resistance_ohm"][valid])),
        **columns,
    }
    emit(answer, as_json=as_json, out=None)
