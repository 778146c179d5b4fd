"""The physical model of a run: identified from its session, and the results that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import click

from haselab.actuators import ACTUATORS
from haselab.base import Estimate, ResultError
from haselab.cli.actuator_file import save_section
from haselab.cli.identify.actuator import section_of_fit
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.model_results import results_of_model
from haselab.pipelines.motion import motions_of_session
from haselab.runtime.lockin import lockin_of
from haselab.store.actuator_file import ACTUATOR
from haselab.store.session.reader import SessionReader, session_file
from haselab.store.toml import validated
from haselab.study.definition import Study
from haselab.study.fits.observe import Observation, observe
from haselab.study.known import known_values
from haselab.study.pipeline import Findings
from haselab.study.run import described

__all__ = ["PhysicalModel", "identify_physical_model", "note_no_model"]

_DIFFERENCE = "S19.chirp_difference"


@dataclass(frozen=True)
class PhysicalModel:
    """The identified model of a run, and the results that follow from it.

    Args:
        fit: of the model.
        results: rows that follow from it, by id; none if it does not explain the recording.
        record: of the session, which was fitted.
        gain_v_per_v: of the amplifier.
    """

    fit: ActuatorFit
    results: Mapping[str, Estimate]
    record: MotionRecord
    gain_v_per_v: float

    def joined(self, found: Findings) -> Findings:
        """Replace results of the experiments' own fits by those of the model.

        Args:
            found: of the study.
        """
        kept = {key: value for key, value in self.results.items() if key in found.quantities}
        notes = dict(found.notes)
        if _DIFFERENCE in kept:
            notes[_DIFFERENCE] = (
                f"{kept['S19.omega_0'].value:.4g} rad/s from the free response, "
                f"{kept['S20.omega_n'].value:.4g} rad/s from the chirp. One physical model "
                "explains both within their noise: the experiments differ in amplitude and in what "
                "came before"
            )
        return replace(
            found,
            quantities={**found.quantities, **kept},
            notes=notes,
            direct={key: found.quantities[key] for key in kept},
        )

    def save(self, folder: Path, session: Path) -> None:
        """Write `[model.physical]` to the actuator file of a run.

        Args:
            folder: of the results.
            session: that was analysed.
        """
        section = section_of_fit(self.fit, [self.record], self.gain_v_per_v)
        save_section(
            folder / ACTUATOR, "model.physical", section,
            [session_file(session)], status=self.fit.status,
        )  # fmt: skip


def note_no_model() -> None:
    """Say that there is no physical model of a session in which an experiment failed."""
    click.echo("haselab: no physical model, because an experiment failed.", err=True)


def identify_physical_model(
    session: Path, study: Study, found: Findings, *, unverified: bool = False
) -> PhysicalModel:
    """Identify the physical model of the actuator from the session of a study.

    The search starts at the default values of the kind of actuator.

    Args:
        session: its folder or session.h5.
        study: that was played.
        found: by the experiments' own fits.
        unverified: continue if a checksum of the session does not match.
    Returns:
        The model; its status says if there is none, or if it does not explain the recording.
    """
    with SessionReader(session, unverified=unverified) as reader:
        header = reader.header
        rig = described(header["rig"])
        lockin = lockin_of(rig, study.sensing.carrier_hz)  # as the study senses
        sensed = {k: o.sensed for k, o in found.observations.items() if o.sensed is not None}
        lockins = [(None, {}), (lockin, sensed)]
        record, observed = motions_of_session(reader, session_file(session), lockins)
        start = ACTUATORS.find(rig.actuator_kind)()
        fit = fit_actuator(start, [record], mass_kg=float(record.drive.mass_kg[0]))
        if fit.status != "ok":
            click.echo(f"haselab: no results of a physical model: {fit.status}", err=True)
            return PhysicalModel(fit, {}, record, rig.amplifier_gain)
        events = reader.events()

        def source(name: str) -> Observation:
            if name in found.observations:
                return found.observations[name]
            return observe(reader.experiment(name), events, lockin, study.sensing, rig)

        known = known_values(validated(ActuatorTables, header.get("actuator", {}), session))
        try:
            rows = results_of_model(fit, observed, source, study, rig, found, known)
        except ResultError as error:
            click.echo(f"haselab: no results of the physical model: {error}", err=True)
            return PhysicalModel(fit, {}, record, rig.amplifier_gain)
    return PhysicalModel(fit, rows, record, rig.amplifier_gain)
