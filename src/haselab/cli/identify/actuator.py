"""`haselab identify actuator`: one physical model from everything that was recorded."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ACTUATORS, ActuatorLaw, measured_parameters, with_stated
from haselab.base import InputError, JsonObject, LimitError
from haselab.cli.actuator_file import load_actuator, save_section
from haselab.cli.columns import column_options
from haselab.cli.common import (
    POSITIVE,
    REAL,
    actuator_option,
    answer_options,
    unverified_option,
    waiting,
)
from haselab.cli.identify.common import FILES, RATE, emit_fit, refuse_copies
from haselab.cli.identify.recorded_motion import TableOptions, motion_of_file
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.physical import TRACKED_ZERO_M, ActuatorFit, MotionRecord, fit_actuator
from haselab.models.actuator.sections import ActuatorSection, ActuatorTables, PhysicalTable
from haselab.pipelines.planning.actuator_file import planner_of
from haselab.pipelines.planning.proposal import DETERMINED, Proposal
from haselab.pipelines.planning.records import summary_of
from haselab.store.columns.selection import ColumnOptions
from haselab.store.manifest import sha256_of
from haselab.store.session.opening import is_session
from haselab.store.session.reader import session_file
from haselab.store.toml import validated

__all__ = ["actuator", "each_once", "law_of_section", "section_of_fit"]

_SAME = 1e-3  # largest relative difference of stated numbers that count as equal
_TABLE_ZERO_M = 5e-5  # standard deviation of the zero of a displacement sensor, set by a caliper
_TABLE_CLOCK = 1e-3  # relative standard deviation of their times: 30 frames/s are often 29.97


@click.command("actuator")
@FILES
@actuator_option("The command reads [actuator] and writes [model.physical].")
@shared_option(
    "--input", "source", detail="Used for tables only. Default: u, voltage_v or voltage."
)
@shared_option("--output", "outputs", multiple=True,
               detail="Used for tables only. Give it twice for a length and a capacitance. "
               "Default: y, "
               "or length_m or strain, and capacitance_f.")  # fmt: skip
@RATE
@shared_option("--mass-kg", "masses_kg", type=REAL, multiple=True,
               detail="For tables, give it once for all, or once for each in their order. "
               "Default: that "
               "of A.toml.")  # fmt: skip
@shared_option(
    "--gain-v-per-v", type=POSITIVE, detail="Used for tables only. Default: that of A.toml."
)
@shared_option("--zero-length-m", type=POSITIVE,
               detail="Used for tables with strains only. Default: that of A.toml.")  # fmt: skip
@click.option("--added-inertia-kg", type=POSITIVE,
              help="Set the starting value of the added inertia in kg: of what moves but does not "
              "load the actuator, such as a lever. Default: 5 % of the hung mass.")  # fmt: skip
@click.option("--zero-std-m", type=POSITIVE,
              help="Set the uncertainty (one standard deviation) of the zero of the lengths, in m. "
              "Default: 5e-5 with tables, 2e-6 without.")  # fmt: skip
@unverified_option
@column_options
@answer_options(plot=True)
def actuator(
    files: tuple[Path, ...],
    actuator: Path | None,
    source: str | None,
    outputs: tuple[str, ...],
    rate_hz: float | None,
    masses_kg: tuple[float, ...],
    gain_v_per_v: float | None,
    zero_length_m: float | None,
    added_inertia_kg: float | None,
    zero_std_m: float | None,
    columns: ColumnOptions,
    *,
    unverified: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Identify a physical model from everything recorded.

    FILES are folders of runs, their session.h5, or tables with a voltage and a length, strain or
    capacitance, all of one actuator. Lengths and capacitances of all experiments are compared with
    one simulated motion. [actuator] states the kind, the starting values, and the parameters
    that you measured in another way, such as a width.

    Each table is simulated on its own and is assumed to begin at rest under its first voltage.
    """
    if actuator is None:
        raise InputError(
            "The kind of the actuator is not known. Name its file with --actuator A.toml; 'haselab "
            "init' writes one."
        )
    tables = load_actuator(actuator, to_write=True)
    law = law_of_section(tables.actuator, actuator)
    options = TableOptions(source, outputs, rate_hz, None, gain_v_per_v, zero_length_m, columns)
    records, gains_v_per_v = [], []
    std: dict[str, float] = {}  # tables of one instrument have one noise, which the fit scales
    for file, mass_kg in zip(files, _each_mass(masses_kg, len(files)), strict=True):
        record, gain = motion_of_file(
            file, replace(options, mass_kg=mass_kg), tables, unverified=unverified, std=std
        )
        if not (file.is_dir() or is_session(file)):
            record = replace(record, std_estimated=True)
            for unit, stds in (("m", record.length_std_m), ("F", record.capacitance_std_f)):
                std |= {unit: float(stds[0])} if stds.size else {}
        records.append(record)
        gains_v_per_v.append(gain)
    mass_kg = max(float(record.drive.mass_kg[0]) for record in records)
    if not mass_kg > 0.0:
        raise InputError(
            "No mass hangs on the actuator in these records. Record at least one with a mass, or "
            "state it with --mass-kg or as mass_kg in [actuator]."
        )
    inputs = [session_file(file) for file in files]
    _refuse_twice(inputs)
    refuse_copies(files, [record.length_m for record in records])
    refuse_copies(files, [record.capacitance_f for record in records])
    _warn_of_stated(files, records, gains_v_per_v, tables, actuator)
    tracked = all(file.is_dir() or is_session(file) for file in files)
    _note_assumed(law, tables.actuator, actuator)
    with waiting("search for the physical model") as on_stage:
        fit = fit_actuator(
            law, records, mass_kg=mass_kg, added_inertia_kg=added_inertia_kg,
            camera_bias_m=zero_std_m or (TRACKED_ZERO_M if tracked else _TABLE_ZERO_M),
            clock_std=0.0 if tracked else _TABLE_CLOCK, on_stage=on_stage,
        )  # fmt: skip
    if fit.status != "ok" and "kind" not in tables.actuator.model_fields_set:
        doubt = f"[actuator] states no kind, so {fit.kind} was assumed. State kind if it is another"
        fit = replace(fit, status=f"{fit.status}. {doubt}")
    if not fit.succeeded:
        emit_fit(fit, inputs, as_json, out)
    section = section_of_fit(fit, records, gains_v_per_v[0])
    proposals = _proposals(tables, section, fit, actuator)
    listed = {"experiments": [proposal.answer() for proposal in proposals]}
    shorter = {**_shorter(fit), "experiments": each_once(proposals)}
    emit_fit(fit, inputs, as_json, out, listed, shorter)
    save_plot(plot, fit.chart)
    save_section(actuator, "model.physical", section, inputs, status=fit.status)


def _shorter(fit: ActuatorFit) -> JsonObject:
    """One line for each parameter, linear model and law, in place of tables."""
    return {
        "determined_by": {
            "xN": "without this signal, the variance of the parameter is N times as large",
            "known beforehand": "what is assumed of camera and sensing, not the start values",
            **{
                name: ", ".join(f"{each.text} x{each.variance_growth:.3g}" for each in sources)
                for name, sources in fit.determined_by.items()
            },
        },
        "linear_models": {
            f"{point.voltage_v:g} V, {fit.mass_kg:g} kg": f"{point.gain_m_per_v:.4g} m/V, poles "
            f"{_modes(point.poles)} rad/s"
            for point in fit.linear_models
        },
        "rejected_laws": [
            f"{rival.law}: log evidence {rival.log_evidence:.4g}" for rival in fit.rejected_laws
        ],
    }


def _modes(poles: NDArray[np.complex128]) -> str:
    """Poles in words, a conjugate pair as one."""
    return ", ".join(
        f"{pole.real:.4g} ± {pole.imag:.4g}i" if pole.imag else f"{pole.real:.4g}"
        for pole in poles.tolist() if pole.imag >= 0.0
    )  # fmt: skip


def _warn_of_stated(
    files: Sequence[Path],
    records: Sequence[MotionRecord],
    gains_v_per_v: Sequence[float],
    tables: ActuatorTables,
    path: Path,
) -> None:
    """Warn if the mass or the gain in the actuator file differs from those of all sessions."""
    sessions = [k for k, file in enumerate(files) if file.is_dir() or is_session(file)]
    for name, unit, stated, found in (
        ("mass_kg in [actuator]", "kg", tables.actuator.mass_kg,
         [float(records[k].drive.mass_kg[0]) for k in sessions]),
        ("gain_v_per_v in [drive]", "V/V", tables.drive.gain_v_per_v,
         [gains_v_per_v[k] for k in sessions]),
    ):  # fmt: skip
        if stated is None or not found:
            continue
        if not any(math.isclose(stated, value, rel_tol=_SAME) for value in found):
            listed = ", ".join(f"{value:g}" for value in dict.fromkeys(found))
            click.echo(
                f"haselab: warning: {name} is {stated:g} {unit}, but the sessions state {listed} "
                f"{unit}. The fit uses the sessions. Correct the wrong value. File: {path}",
                err=True,
            )


def _refuse_twice(inputs: Sequence[Path]) -> None:
    """Refuse the same record under two names: it would count as two."""
    for one, other in itertools.combinations(inputs, 2):
        same_size = one.stat().st_size == other.stat().st_size
        if one.samefile(other) or (same_size and sha256_of(one) == sha256_of(other)):
            raise InputError(f"{one} and {other} are the same record. Leave out one of them.")


def _each_mass(masses_kg: Sequence[float], count: int) -> Sequence[float | None]:
    if any(not 0.0 < mass_kg < math.inf for mass_kg in masses_kg):
        raise InputError(f"--mass-kg is {min(masses_kg):g} kg. Use a mass above 0 kg.")
    if len(masses_kg) <= 1:
        return [masses_kg[0] if masses_kg else None] * count
    if len(masses_kg) != count:
        raise InputError(
            f"--mass-kg is given {len(masses_kg)} times, but there are {count} files. State it "
            "once for all, or once for each."
        )
    return masses_kg


def _proposals(
    tables: ActuatorTables, section: Mapping[str, object], fit: ActuatorFit, path: Path
) -> list[Proposal]:
    """For each parameter that is not identifiable, the experiment that would determine it."""
    if not fit.not_identifiable:
        return []
    physical = validated(PhysicalTable, section, path)
    planner = planner_of(tables.actuator, physical, tables.drive_ends_v, path)
    unknown = [name for name in fit.not_identifiable if planner.before()[name] > DETERMINED]
    found = (planner.propose(name, pairs=False) for name in unknown)
    return [proposal for proposal in found if proposal is not None]


def each_once(proposals: Sequence[Proposal]) -> list[JsonObject]:
    """List each study once, with all parameters for which it is proposed.

    Args:
        proposals: one for each parameter.
    Returns:
        What is printed for each study.
    """
    studies: dict[str, list[Proposal]] = {}
    for proposal in proposals:
        studies.setdefault(proposal.candidate.text, []).append(proposal)
    return [
        {
            "experiment": text,
            "duration_s": same[0].duration_s,
            "relative_std": {proposal.parameter: proposal.change for proposal in same},
            "study": same[0].candidate.tables,
            "notes": list(dict.fromkeys(note for proposal in same for note in proposal.notes)),
        }
        for text, same in studies.items()
    ]


def _note_assumed(law: ActuatorLaw, section: ActuatorSection | None, path: Path) -> None:
    """Say which dimensions are defaults of the kind, because the fit does not change them."""
    stated = {} if section is None else section.parameters
    assumed = {k: v for k, v in measured_parameters(law).items() if k not in stated}
    if assumed:
        values = ", ".join(f"{name} = {value:g}" for name, value in assumed.items())
        click.echo(
            f"haselab: defaults of the kind {law.kind}, which are not fitted: {values}. State what "
            f"you measured in [actuator.parameters]. File: {path}",
            err=True,
        )


def law_of_section(section: ActuatorSection | None, path: Path) -> ActuatorLaw:
    """The kind's law with the parameters that the file states."""
    section = section or ActuatorSection()
    law = ACTUATORS.find(section.kind)()
    try:
        return with_stated(law, section.parameters)
    except (InputError, LimitError) as error:
        raise InputError(f"[actuator.parameters]: {error} {path}") from error


def section_of_fit(
    fit: ActuatorFit, records: Sequence[MotionRecord], gain_v_per_v: float
) -> Mapping[str, object]:
    """`[model.physical]`: estimates with their covariance, and what they were made from."""
    finite = np.isfinite(np.diag(fit.covariance))
    names = [name for name, known in zip(fit.parameters, finite, strict=True) if known]
    noise = {
        "length_noise_m": fit.length_noise_m,
        "length_rms_m": fit.length_rms_m,
        "length_worst_m": fit.length_worst_m,
        "length_factor": fit.length_factor,
        "capacitance_noise_f": fit.capacitance_noise_f,
        "capacitance_rms_f": fit.capacitance_rms_f,
        "capacitance_worst_f": fit.capacitance_worst_f,
        "capacitance_factor": fit.capacitance_factor,
        "hidden_variance": fit.hidden_variance,
    }
    covariance = {"names": names, "matrix": fit.covariance[np.ix_(finite, finite)].tolist()}
    if (fit.widening[finite] > 1.0).any():
        covariance["widening"] = fit.widening[finite].tolist()
    return {
        "kind": fit.kind,
        "status": fit.status,
        "mass_kg": fit.mass_kg,
        "parameters": {name: estimate.value for name, estimate in fit.parameters.items()},
        "measured": measured_parameters(fit.law) if fit.law is not None else {},
        "std": {name: estimate.std for name, estimate in fit.parameters.items()},
        "not_identifiable": list(fit.not_identifiable),
        "determined_by": {
            name: [source.text for source in sources]
            for name, sources in fit.determined_by.items()
            if sources
        },
        "covariance": covariance,
        "residuals": {key: value for key, value in noise.items() if math.isfinite(value)},
        "records": summary_of(fit, records, gain_v_per_v).model_dump(exclude_none=True),
    }
