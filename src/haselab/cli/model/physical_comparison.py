"""`haselab compare` by the physical model: predict sessions and tables that were not fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, ResultError
from haselab.cli.columns import Quantity, check_strain
from haselab.cli.common import emit, warn_unverified
from haselab.cli.identify.common import rate_hz_of, read_valid, unit_text
from haselab.cli.model.physical_model import read_physical_model, sources_of_physical_model
from haselab.cli.plot import save_plot
from haselab.identify.physical import (
    IdentifiedModel,
    MotionPrediction,
    MotionRecord,
    PredictedPart,
    predict_motion,
)
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.motion import motion_of_session
from haselab.pipelines.motion_table import motion_of_table
from haselab.store.actuator_file import hashed
from haselab.store.columns.selection import ColumnOptions
from haselab.store.session.opening import is_session
from haselab.store.session.reader import SessionReader, session_file

__all__ = ["PhysicalOptions", "compare_physical", "refuse_for_linear"]

Floats = NDArray[np.float64]
_UNITS = {"length": "m", "capacitance": "F"}
_VOLTAGE = Quantity("--input", ("u", "voltage_v", "voltage"), "V", "the voltage")
_MEASURED = Quantity(
    "--output", ("y", "length_m", "strain", "capacitance_f"), None, "what was measured"
)
_ENDINGS = {"strain": "1", "_m": "m", "_f": "F"}


@dataclass(frozen=True)
class PhysicalOptions:
    """What the user states about the records.

    Args:
        experiments: of the sessions, that are compared; empty: all.
        free_offset: estimate a constant offset of the lengths.
        longest_m: length to which the actuator had been stretched before.
        unverified: read sessions whose checksums do not match.
        source: column of the voltage in tables; None: by its name.
        output: column of what was measured in tables; None: by its name.
        rate_hz: of tables; None: that of the file.
        mass_kg: hung mass of tables; None: that of the actuator file.
        gain_v_per_v: of the amplifier, for tables; None: that of the actuator file.
        zero_length_m: length at zero strain of tables; None: that of the actuator file.
        columns: what the user states about the columns.
    """

    experiments: tuple[str, ...]
    free_offset: bool
    longest_m: float | None
    unverified: bool
    source: str | None
    output: str | None
    rate_hz: float | None
    mass_kg: float | None
    gain_v_per_v: float | None
    zero_length_m: float | None
    columns: ColumnOptions


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
    found, used = [], []
    for file in files:
        session = file.is_dir() or is_session(file)
        record = _session(file, options) if session else _table(file, options, model, tables)
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
    for one, name in zip(found, names, strict=True):
        parts += [
            part
            if part.experiment == name
            else replace(part, experiment=f"{name}:{part.experiment}")
            for part in one.parts
        ]
    undetermined = dict.fromkeys(name for one in found for name in one.undetermined)
    return MotionPrediction(tuple(parts), undetermined=tuple(undetermined))


def _session(file: Path, options: PhysicalOptions) -> MotionRecord:
    given = {
        "--mass-kg": options.mass_kg,
        "--gain-v-per-v": options.gain_v_per_v,
        "--zero-length-m": options.zero_length_m,
        "--input": options.source,
        "--output": options.output,
        "--rate-hz": options.rate_hz,
    }
    wrong = [name for name, value in given.items() if value is not None]
    if wrong:
        raise InputError(
            f"{', '.join(wrong)} is for tables, but a session states this itself. Leave it out. "
            f"{file}"
        )
    with SessionReader(file, unverified=options.unverified) as reader:
        warn_unverified(reader.doubt, file)
        return motion_of_session(reader, session_file(file))


def _table(
    file: Path, options: PhysicalOptions, model: IdentifiedModel, known: ActuatorTables
) -> MotionRecord:
    if options.experiments:
        raise InputError(
            f"--experiment is for sessions, but this file is a table. Leave it out. {file}"
        )
    source = _VOLTAGE.column(file, options.source)
    output = _MEASURED.column(file, options.output)
    table = read_valid(file, (source, output), options.columns)
    stated = table.units[source]
    if stated is not None and stated.si != "V":
        raise InputError(
            f"Column {source} is {unit_text(stated.si)}, but the physical model needs a voltage. "
            f"Name its column with --input. {file}"
        )
    time_s = table.time_s
    if time_s is None or options.rate_hz is not None:
        time_s = np.arange(table[source].size) / rate_hz_of(table, options.rate_hz, file)
    mass_kg = options.mass_kg if options.mass_kg is not None else known.actuator.mass_kg
    if mass_kg is None:
        raise InputError(
            "The hung mass of this table is not known. State it with --mass-kg, or add mass_kg to "
            f"[actuator]. {file}"
        )
    gain = options.gain_v_per_v or known.drive.gain_v_per_v
    if gain is None:
        raise InputError(
            f"The gain from column {source} to the actuator's voltage is not known. State it with "
            "--gain-v-per-v (1 if the column is the voltage of the actuator), or add gain_v_per_v "
            f"to [drive]. {file}"
        )
    volt = gain * table[source]
    values = table[output]
    unit = table.units[output]
    si = unit.si if unit is not None else _unit_of_name(output)
    if si == "1":
        check_strain(output, values, unit, file, known)
        zero_m = options.zero_length_m or known.actuator.geometry.zero_length_m
        if zero_m is None:
            raise InputError(
                f"Column {output} is a strain, but the length at zero strain is not known. State "
                f"it with --zero-length-m, or add zero_length_m to [actuator.geometry]. {file}"
            )
        values, si = zero_m * (1.0 + values), "m"
    if si not in ("m", "F"):
        raise InputError(
            f"Column {output} is {unit_text(si) if si else 'without a unit'}, but the physical "
            "model predicts lengths, strains and capacitances. Name one with --output, or state "
            f"the unit with --unit. {file}"
        )
    noise = model.length if si == "m" else model.capacitance
    if not math.isfinite(noise.noise):
        raise InputError(
            f"[model.physical.residuals] does not state the noise of values {unit_text(si)}. "
            f"Identify the actuator again. {file}"
        )
    # the factor multiplies it again
    std = noise.noise / noise.factor
    return motion_of_table(
        file.name, time_s, volt, mass_kg=mass_kg,
        length_m=values if si == "m" else None,
        capacitance_f=values if si == "F" else None, std=std,
    )  # fmt: skip


def _unit_of_name(name: str) -> str:
    return next((si for ending, si in _ENDINGS.items() if name.endswith(ending)), "")


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
        "--mass-kg": options.mass_kg,
        "--gain-v-per-v": options.gain_v_per_v,
        "--zero-length-m": options.zero_length_m,
    }
    wrong = [name for name, value in given.items() if value]
    if wrong:
        raise InputError(
            f"{', '.join(wrong)} needs a physical model. Identify it with: haselab identify "
            "actuator RUN --actuator A.toml"
        )
