"""`haselab compare`: predict records that were not used for the fit of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import ResultError, table_at
from haselab.cli.columns import column_options
from haselab.cli.common import REAL, SEED, answer_options, emit
from haselab.cli.identify.common import FILES, INPUT, OUTPUT, RATE, about, recorded
from haselab.cli.model.charts import prediction_chart
from haselab.cli.model.model_file import read_any_plant, read_posterior
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.fit import Prediction
from haselab.identify.prediction import predict
from haselab.identify.record import Record
from haselab.store.actuator_file import read_actuator
from haselab.store.columns.selection import ColumnOptions
from haselab.store.manifest import sha256_of

__all__ = ["command"]

_KNOWN = "not a validation: this record was used for the fit. Use another one"
_NO_BAND = "no uncertainty: the model has no covariance"


@click.command("compare")
@click.argument("model", type=click.Path(path_type=Path))
@FILES
@INPUT
@OUTPUT
@RATE
@shared_option("--at-rest", is_flag=True, detail="Its state and offset are then taken as 0.")
@shared_option("--through-voltage-map", is_flag=True)
@shared_option("--held-at-hz", type=REAL, detail="Default: the sampling rate of the file.")
@shared_option("--seed", type=SEED, default=1, show_default=True, detail="For the 95 % band.")
@column_options
@answer_options(plot=True)
def command(
    model: Path,
    files: tuple[Path, ...],
    source: str,
    output: str,
    rate_hz: float | None,
    at_rest: bool,
    through_voltage_map: bool,
    held_at_hz: float | None,
    seed: int,
    columns: ColumnOptions,
    *,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Predict records in FILES that were not used for the fit of MODEL.

    MODEL is an actuator file or a model.json. The command reports the fit in percent, the rms error
    and the share of samples inside the 95 % band. It first estimates the initial state and the
    offset of each record, unless --at-rest is given.
    """
    plant, posterior = read_any_plant(model), read_posterior(model)
    through = model if through_voltage_map else None
    records = []
    for file in files:
        with about(file):
            found = recorded(file, (source, output), rate_hz, held_at_hz, columns, through=through)
            records += found.records
    with about(*files):
        found_prediction = predict(
            plant,
            records,
            posterior=posterior,
            noise_std=_noise_std(model),
            free_start=not at_rest,
            rng=np.random.default_rng(seed),
        )
    used = [file for file in files if sha256_of(file) in _used(model)]
    answer = _answer(found_prediction, posterior is not None, used)
    emit(answer, as_json=as_json, out=out)
    names = ", ".join(file.name for file in files)
    title = f"Prediction of {names}: {found_prediction.fit_percent:.1f} %"
    save_plot(plot, lambda: prediction_chart(found_prediction, _times(records), title))
    if used:
        raise ResultError(f"{_KNOWN}. {used[0]}")


def _times(records: Sequence[Record]) -> NDArray[np.float64]:
    """Times of the outputs of records that follow each other."""
    parts, start_s = [], 0.0
    for record in records:
        parts.append(start_s + record.output_time_s)
        start_s = float(parts[-1][-1]) + 1.0 / record.input_rate_hz
    return np.concatenate(parts)


def _model_table(model: Path) -> Mapping[str, object]:
    table = read_actuator(model).get("model", {}) if model.suffix.lower() == ".toml" else {}
    return table if isinstance(table, dict) else {}


def _noise_std(model: Path) -> float:
    """Root mean square of the fit's residuals; 0 if the file does not state it."""
    value = _model_table(model).get("residual_std", 0.0)
    return float(value) if isinstance(value, (int, float)) else 0.0


def _used(model: Path) -> list[str]:
    """Hashes of the files that [model] was identified from."""
    if model.suffix.lower() != ".toml":
        return []
    hashes = table_at(read_actuator(model), "provenance", "model").get("sha256", [])
    return [str(item) for item in hashes] if isinstance(hashes, list) else []


def _answer(found: Prediction, has_band: bool, used: list[Path]) -> dict[str, object]:
    return {
        "fit_percent": found.fit_percent,
        "rms_error": found.rms_error,
        "inside_band": found.inside_band if has_band else None,
        "band": "95 %, from the covariance of the model and its residuals"
        if has_band
        else _NO_BAND,
        "samples": found.measured.size,
        "status": _KNOWN if used else "ok",
    }
