"""Step trials on a rig that closes its own loop, recorded and reported like the desktop's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from haselab.base import InputError, JsonObject, Progress
from haselab.firmware import CARRIER_HZ, RATE_HZ, ChipSettings, settings_from_dict
from haselab.models.actuator.strain_map import StrainMap
from haselab.rig import Rig, RigDescription
from haselab.runtime.observer import FIDUCIALS
from haselab.runtime.runner import Runner
from haselab.sensing import sense_quadrature
from haselab.store.folder import write_json
from haselab.store.session.writer import (
    ExperimentPlan,
    ExperimentRecord,
    SessionReader,
    SessionWriter,
)
from haselab.study.definition import StepStudy
from haselab.study.experiments.steps import step_reference
from haselab.study.fits.observe import Observation, gauge_length, point_spread
from haselab.study.fits.resolution import ZERO_PX
from haselab.study.fits.trials import Comparison, collect_trials, make_comparison
from haselab.study.folder import marked_unverified
from haselab.study.player import UPDATE_HZ
from haselab.study.results import VERDICT_RULE, quantity_rows
from haselab.study.run import RunOptions, described, recording, session_header
from haselab.study.simulated.truth import is_simulated

__all__ = [
    "Chip",
    "analyse_chip_session",
    "chip_names",
    "is_chip_session",
    "recorded_row",
    "run_on_chip",
    "write_chip_findings",
]

_GROUP = "chip"
_FIGURES = ("fig6", "sensing")
_REST_S, _REST_FRAMES = 0.5, 15  # at rest, before a controller gets a reference
_AGE_S = 7.5 * 125e-6  # of an update's strain at the end of its frame, from its middle sample


@dataclass(frozen=True)
class Chip:
    """Settings of a chip that its rig file does not hold.

    Args:
        settings: compiled into the firmware.
        zero_length_m: length at zero strain, from the study that made the settings.
    """

    settings: ChipSettings
    zero_length_m: float

    def to_dict(self) -> JsonObject:
        """Convert to JSON types."""
        settings = asdict(self.settings)
        correction = self.settings.front_end.correction
        settings["front_end"]["correction"] = [correction.real, correction.imag]
        return {"settings": settings, "zero_length_m": self.zero_length_m}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Chip:
        """Inverse of `to_dict`.

        Raises:
            InputError: a setting is missing or invalid.
        """
        try:
            return cls(settings_from_dict(data["settings"]), float(data["zero_length_m"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"The session was not recorded on a microcontroller, or its header is damaged "
                f"({error}). Name another session."
            ) from None


def _observed(record: ExperimentRecord, chip: Chip, rig: RigDescription) -> Observation:
    """Lengths from the camera, and capacitances as the chip computes them, one per update."""
    length_m = gauge_length(record.tracks, rig.scale_m_per_px)
    good = np.isfinite(length_m)
    capacitance_f = sense_quadrature(record.codes.reshape(-1, 2), chip.settings)
    first = int(np.argmax(np.isfinite(record.reference)))  # the rig was at rest before it
    ends_s = record.block_start_s[0] + np.arange(1, capacitance_f.size + 1) / RATE_HZ
    return Observation(
        name=record.name,
        settings=record.settings,
        block_start_s=record.block_start_s[first:],
        drive_v=record.drive_v[first:],
        reference=record.reference[first:],
        sensed_s=ends_s - _AGE_S,
        capacitance_f=capacitance_f,
        relative_capacitance=np.full(capacitance_f.size, np.nan),
        frame_time_s=record.frame_time_s[good],
        length_m=length_m[good],
        spread_m=point_spread(record.tracks, rig.scale_m_per_px)[good],
        mass_kg=record.mass_kg[good],
        drop_s=float("nan"),
        latency_s=np.empty(0),
    )


def chip_names(study: StepStudy) -> list[str]:
    """Names of the step trials of a rig that closes its own loop."""
    return [f"chip-{k + 1}" for k in range(study.step_trials.trials)]


def _play_chip_steps(runner: Runner, study: StepStudy) -> None:
    """Play row S24 with the rig's controller, at rest first for the camera's reference."""
    trials = study.step_trials
    lead_s = max(_REST_S, _REST_FRAMES / trials.frame_rate_hz)
    lead = np.full(round(lead_s * UPDATE_HZ), np.nan)  # no reference: the rig is at rest
    reference = np.concatenate([lead, step_reference(trials)])
    for name in chip_names(study):
        runner.settle(0.0, trials.rest_s)
        runner.follow(name, reference, trials.frame_rate_hz, runner.mass_kg)


def recorded_row(header: Mapping[str, Any]) -> str:
    """Which row of the study a recording belongs to.

    Args:
        header: of the session.
    Returns:
        "S28" if a serial supply provided the high voltage, else "S26".
    """
    simulator = header["rig_config"].get("simulator") or {}
    return "S28" if simulator.get("supply") else "S26"


def _compare(
    session: SessionWriter | SessionReader,
    study: StepStudy,
    chip: Chip,
    rig: RigDescription,
    row: str,
) -> Comparison:
    trials = [_observed(session.experiment(name), chip, rig) for name in chip_names(study)]
    group = collect_trials(
        trials, chip.zero_length_m, StrainMap(*chip.settings.strain_map), study.step_trials
    )
    quantities = {
        f"{row}.rise": group.metrics.rise_time_s,
        f"{row}.settling": group.metrics.settling_time_s,
        f"{row}.overshoot": group.metrics.overshoot,
        f"{row}.error": group.metrics.steady_state_error,
    }
    per_px = rig.scale_m_per_px / chip.zero_length_m
    return make_comparison({_GROUP: group}, quantities, study.step_trials, per_px, _GROUP, ZERO_PX)


def run_on_chip(
    study: StepStudy, rig: Rig, chip: Chip, options: RunOptions, progress: Progress
) -> tuple[Comparison, JsonObject]:
    """Play step trials on a rig that closes its own loop; the session file grows block by block.

    Args:
        study: what is played.
        rig: the bench; it always ends at 0 V.
        chip: its settings.
        options: folder, video, the rig's configuration.
        progress: in seconds of the rig.
    Returns:
        The findings, and the session's header.
    Raises:
        DeviceError: disk or instrument failed; the recorded data are kept.
        SafetyError: the chip or the bench protected itself.
    """
    trials = study.step_trials
    progress.start(trials.trials * (trials.zero_s + trials.step_s))
    header = session_header(study, rig.description, options) | {"chip": chip.to_dict()}
    planned = [
        ExperimentPlan(name, "step on the chip", FIDUCIALS, {}) for name in chip_names(study)
    ]
    carrier_v = chip.settings.front_end.carrier_high_v / chip.settings.front_end.gain
    with recording(rig, options, header, planned) as (session, observer):
        with Runner(rig, session, observer, CARRIER_HZ, carrier_v, progress) as runner:
            _play_chip_steps(runner, study)
        return _compare(session, study, chip, rig.description, recorded_row(header)), header


def is_chip_session(header: Mapping[str, Any]) -> bool:
    """Whether a session was recorded on a chip."""
    return "chip" in header


def analyse_chip_session(session: SessionReader) -> tuple[Comparison, JsonObject]:
    """Repeat the analysis of `run_on_chip` from the recorded session.

    Args:
        session: of `run_on_chip`.
    Returns:
        The findings, and the session's header.
    Raises:
        InputError: the session is damaged, or a trial is missing.
    """
    try:
        study = StepStudy.model_validate(session.header["study"])
        rig = described(session.header["rig"])
        row = recorded_row(session.header)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"The session's header is damaged ({error}).") from None
    chip = Chip.from_dict(session.header["chip"])
    return _compare(session, study, chip, rig, row), session.header


def write_chip_findings(
    folder: Path, found: Comparison, header: Mapping[str, Any], doubt: str = ""
) -> JsonObject:
    """Write results.json and analysis.json.

    Args:
        folder: of the run.
        found: of its trials.
        header: of the session, for the provenance.
        doubt: why the session could not be verified; empty if it was.
    Returns:
        The content of results.json.
    Raises:
        DeviceError: a file cannot be written.
    """
    results: JsonObject = {
        "quantities": quantity_rows(found.quantities, {}, header["rig_config"]),
        "simulated": is_simulated(header["rig_config"]),
        "verdict_rule": VERDICT_RULE,
        "sensing_error": found.sensing_error,
        "provenance": {
            key: header[key]
            for key in ("versions", "seed", "study_sha256", "study", "rig_config", "chip")
        },
    }
    results = marked_unverified(results, doubt)
    write_json(folder / "results.json", results)
    write_json(folder / "analysis.json", {**found.figures, "only": list(_FIGURES)})
    return results
