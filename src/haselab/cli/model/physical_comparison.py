"""`haselab compare` by the physical model: predict sessions and tables that were not fitted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, ResultError
from haselab.cli.common import emit
from haselab.cli.identify.common import unit_text
from haselab.cli.identify.recorded_motion import TableOptions, motion_of_file
from haselab.cli.model.physical_model import read_physical_model, sources_of_physical_model
from haselab.cli.plot import save_plot
from haselab.identify.physical import (
    IdentifiedModel,
    MotionPrediction,
    MotionRecord,
    PredictedPart,
    predict_motion,
)
from haselab.store.actuator_file import hashed
from haselab.store.session.opening import is_session
from haselab.store.session.reader import session_file

__all__ = ["PhysicalOptions", "compare_physical", "refuse_for_linear"]

Floats = NDArray[np.float64]
_UNITS = {"length": "m", "capacitance": "F"}


@dataclass(frozen=True)
class PhysicalOptions:
    """What the user states about the records.

    Args:
        experiments: of the sessions, that are compared; empty: all.
        free_offset: estimate a constant offset of the lengths.
        longest_m: length to which the actuator had been stretched before.
        unverified: read sessions whose checksums do not match.
        table: about tables.
    """

    experiments: tuple[str, ...]
    free_offset: bool
    longest_m: float | None
    unverified: bool
    table: TableOptions


def compare_physical(
    path: Path,
    files: Sequence[Path],
    options: PhysicalOptions,
    *,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Predict sessions and tables by `[model.physical]`, and print the comparison.

    Args:
        path: of the actuator file.
        files: sessions, folders of runs, and tables.
        options: of the user.
        as_json: print JSON.
        out: file of the answer; None: none.
        plot: file of the figure; None: none.
    Raises:
        InputError: no model, or a file that cannot be compared with it.
        ResultError: the prediction is not trustworthy, or these files were used for the fit.
    """
    model, tables = read_physical_model(path)
    sources = sources_of_physical_model(path)
    found, used, noise = [], [], _noise(model)
    table = replace(options.table, unused=frozenset({"m", "F"} - set(noise)))
    for file in files:
        session = file.is_dir() or is_session(file)
        if options.experiments and not session:
            raise InputError(
                f"--experiment is for sessions, but this file is a table. Leave it out. {file}"
            )
        record, _ = motion_of_file(file, table, tables, unverified=options.unverified, std=noise)
        if not session:
            _check_noise(record, noise, file)
        if record.voltage_remark:
            click.echo(f"haselab: warning: {record.voltage_remark}", err=True)
        prediction = predict_motion(
            model, record, experiments=options.experiments if session else (),
            free_offset=options.free_offset, longest_m=options.longest_m or 0.0,
        )  # fmt: skip
        found.append(prediction)
        if set(hashed([session_file(file)]).values()) & sources:
            used.append(str(file))
    joined = _joined(found, [file.name for file in files])
    status = joined.status
    if used:
        status = (
            "not a validation: the model was identified from this recording. Use another one, "
            f"not {', '.join(used)}"
        )
    emit(_answer(joined, found, status), as_json=as_json, out=out)
    names = ", ".join(file.name for file in files)
    save_plot(plot, lambda: joined.chart(f"Prediction of {names} by the physical model"))
    if status != "ok":
        raise ResultError(f"{status}. {' '.join(map(str, files))}")


def _joined(found: Sequence[MotionPrediction], names: Sequence[str]) -> MotionPrediction:
    """One prediction of all files; with several, experiments are named by their file, too."""
    if len(found) == 1:
        return found[0]
    parts: list[PredictedPart] = []
    shapes: list[PredictedPart] = []
    for one, name in zip(found, names, strict=True):
        parts += _named(one.parts, name)
        shapes += _named(one.shapes, name)
    undetermined = dict.fromkeys(name for one in found for name in one.undetermined)
    return MotionPrediction(tuple(parts), undetermined=tuple(undetermined), shapes=tuple(shapes))


def _named(parts: Sequence[PredictedPart], file: str) -> list[PredictedPart]:
    return [
        part if part.experiment == file else replace(part, experiment=f"{file}:{part.experiment}")
        for part in parts
    ]


def _noise(model: IdentifiedModel) -> dict[str, float]:
    """Standard deviation of the values of a table, by their unit, as far as it is known."""
    known = {"m": model.length, "F": model.capacitance}
    # the factor multiplies it again
    return {
        unit: part.noise / part.factor for unit, part in known.items() if math.isfinite(part.noise)
    }


def _check_noise(record: MotionRecord, known: Mapping[str, float], file: Path) -> None:
    for unit, values in (("m", record.length_m), ("F", record.capacitance_f)):
        if values.size and unit not in known:
            raise InputError(
                f"[model.physical.residuals] does not state the noise of values {unit_text(unit)}. "
                f"Identify the actuator again. {file}"
            )


def _answer(joined: MotionPrediction, found: Sequence[MotionPrediction], status: str) -> JsonObject:
    whole = joined.all_parts
    spans = {part.channel: part.span for part in whole}
    first = whole[0]
    offsets = [one.offset_m for one in found]
    free = {"length_offset_m": offsets} if any(offsets) else {}
    return {
        "model": "physical",
        "fit_percent": first.fit_percent,
        "rms_error": first.rms_error,
        "inside_band": first.inside_band,
        "band": "95 %, from the covariance of the parameters and the noise",
        "samples": first.time_s.size,
        **{part.channel: _figures(part, spans) for part in whole},
        "experiments": [
            {"experiment": part.experiment, "signal": part.channel, **_figures(part, spans)}
            for part in joined.parts
        ],
        **free,
        "status": status,
    }


def _figures(part: PredictedPart, spans: dict[str, float]) -> JsonObject:
    span = spans[part.channel]
    percent = 100.0 / span if span > 0.0 else math.nan
    unit = _UNITS[part.channel].lower()
    return {
        "samples": part.time_s.size,
        f"rms_error_{unit}": part.rms_error,
        "rms_error_percent_of_span": percent * part.rms_error,
        f"largest_error_{unit}": part.largest_error,
        "inside_band": part.inside_band,
        f"parameter_std_{unit}": float(np.sqrt(np.mean(part.parameter_std**2))),
    }


def refuse_for_linear(options: PhysicalOptions) -> None:
    """Refuse options that only a physical model has.

    Raises:
        InputError: one of them is given.
    """
    given = {
        "--experiment": options.experiments,
        "--free-offset": options.free_offset,
        "--longest-m": options.longest_m,
        "--unverified": options.unverified,
        "--mass-kg": options.table.mass_kg,
        "--gain-v-per-v": options.table.gain_v_per_v,
        "--zero-length-m": options.table.zero_length_m,
    }
    wrong = [name for name, value in given.items() if value]
    if wrong:
        raise InputError(
            f"{', '.join(wrong)} needs a physical model. Identify it with: haselab identify "
            "actuator RUN --actuator A.toml"
        )
