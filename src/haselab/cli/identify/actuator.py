"""`haselab identify actuator`: one physical model from everything that was recorded."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import click
import numpy as np

from haselab.actuators import ACTUATORS, ActuatorLaw, with_parameters
from haselab.base import InputError, LimitError
from haselab.cli.actuator_file import load_actuator, save_section
from haselab.cli.common import actuator_option, answer_options, unverified_option, warn_unverified
from haselab.cli.identify.common import give
from haselab.cli.plot import save_plot
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.models.actuator.sections import ActuatorSection, ActuatorTables, PhysicalTable
from haselab.pipelines.motion import motion_of_session
from haselab.pipelines.planning.actuator_file import planner_of
from haselab.pipelines.planning.proposal import DETERMINED, Proposal
from haselab.pipelines.planning.records import summary_of
from haselab.store.session.reader import SessionReader, session_file
from haselab.store.toml import validated

__all__ = ["actuator", "law_of_section", "section_of_fit"]


@click.command("actuator")
@click.argument("sessions", nargs=-1, required=True, type=click.Path(path_type=Path))
@actuator_option("Read [actuator], write [model.physical].")
@unverified_option
@answer_options(plot=True)
def actuator(
    sessions: tuple[Path, ...],
    actuator: Path | None,
    *,
    unverified: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Identify a physical model from everything recorded.

    SESSIONS are folders of runs or their session.h5, all of one actuator. Lengths and
    capacitances of all experiments are compared with one simulated motion. [actuator] gives
    the kind, the parameters that were measured otherwise, such as a width, and the starting values.
    """
    if actuator is None:
        raise InputError(
            "The kind of the actuator is not known. Name its file with --actuator A.toml; 'haselab "
            "init' writes one."
        )
    tables = load_actuator(actuator, to_write=True)
    law = law_of_section(tables.actuator, actuator)
    records, gains_v_per_v = [], []
    for session in sessions:
        with SessionReader(session, unverified=unverified) as reader:
            warn_unverified(reader.doubt, session)
            records.append(motion_of_session(reader, session))
            gains_v_per_v.append(float(reader.header["rig"]["amplifier_gain"]))
    mass_kg = max(float(record.drive.mass_kg[0]) for record in records)
    fit = fit_actuator(law, records, mass_kg=mass_kg)
    files = [session_file(session) for session in sessions]
    if not fit.succeeded:
        give(fit, files, as_json, out)
    section = section_of_fit(fit, records, gains_v_per_v[0])
    proposals = _proposals(tables, section, fit, actuator)
    listed = {"experiments": [proposal.answer() for proposal in proposals]}
    give(fit, files, as_json, out, listed)
    save_plot(plot, fit.chart)
    save_section(actuator, "model.physical", section, files, status=fit.status)


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


def law_of_section(section: ActuatorSection | None, path: Path) -> ActuatorLaw:
    """The kind's law with the parameters that the file states."""
    section = section or ActuatorSection()
    law = ACTUATORS.find(section.kind)()
    try:
        return with_parameters(law, section.parameters)
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
