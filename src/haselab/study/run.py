"""Run or analyse a whole study: rig, session, findings, and the folder of the run."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from haselab import __version__
from haselab.base import InputError, JsonObject, Limits, Progress, ResultError, SilentProgress
from haselab.models.actuator import ActuatorTables
from haselab.rig import Rig, RigDescription
from haselab.rig.protocols import MonitorCalibration
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.camera_recorder import CameraRecorder, KeepVideo
from haselab.runtime.lockin import lockin_of
from haselab.runtime.observer import Observer
from haselab.runtime.runner import Runner
from haselab.runtime.scheduling import with_priority
from haselab.runtime.threaded_observer import ThreadedObserver
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.settings import WatchdogSettings
from haselab.store.manifest import Manifest, read_manifest
from haselab.store.session.reader import cut_short, session_file
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionReader, SessionWriter
from haselab.store.source_commit import source_commit
from haselab.store.toml import validated
from haselab.study.analysis import experiments_of
from haselab.study.definition import StepStudy, Study, checked_study, recorded_study
from haselab.study.experiment import ExperimentResult
from haselab.study.experiments.foreign import declared, foreign, refuse_repeated
from haselab.study.fits.maps import Maps
from haselab.study.fits.observe import Observation, observe
from haselab.study.fits.particle_tracks import sheet_figure
from haselab.study.known import known_values
from haselab.study.pipeline import Findings, play_and_fit
from haselab.study.simulated.noise_free import NoiseFreeBench

__all__ = [
    "RunOptions",
    "analyse_session",
    "described",
    "noise_free_results",
    "recording",
    "run_study",
    "session_header",
]

_HOUR_S = 3600.0
_PACKAGES = ("numpy", "scipy", "h5py", "pydantic", "av")


@dataclass(frozen=True)
class RunOptions:
    """How a run is recorded.

    Args:
        folder: for all files of the run.
        seed: of the rig's random numbers, for the record.
        keep_video: which frames are kept.
        rig_config: configuration of the rig as JSON, for the record.
        known: the actuator file that the study starts from; None: there is none.
    """

    folder: Path
    seed: int
    keep_video: KeepVideo
    rig_config: JsonObject
    known: ActuatorTables | None = None


def session_header(
    study: Study | StepStudy, rig: RigDescription, options: RunOptions
) -> JsonObject:
    """Provenance of the data: study, rig, seed, versions, hashes."""
    study_json = study.model_dump(mode="json")
    known = {} if options.known is None else {"actuator": _recorded(options.known)}
    digest = hashlib.sha256(json.dumps(study_json, sort_keys=True).encode()).hexdigest()
    return {
        "study": study_json,
        "study_sha256": digest,
        "rig": asdict(rig),
        "rig_config": options.rig_config,
        **known,
        "seed": options.seed,
        "versions": {name: importlib.metadata.version(name) for name in _PACKAGES}
        | {
            "haselab": __version__,
            "commit": source_commit() or "not from a checkout",
            "python": platform.python_version(),
            "machine": platform.machine(),
        },
    }


def _recorded(tables: ActuatorTables) -> dict[str, Any]:
    """What an analysis needs of the actuator file: maps, physical model, limits."""
    needed = {
        "actuator": {"geometry", "mass_kg", "parameters"},
        "sensing": {"strain_map"},
        "drive": {"voltage_map", "low_v", "high_v", "gain_v_per_v", "highest_field_v_per_m"},
        "model": {"physical"},
    }
    return tables.model_dump(mode="json", include=needed, exclude_none=True)


@contextlib.contextmanager
def recording(
    rig: Rig, options: RunOptions, header: JsonObject, planned: Sequence[ExperimentPlan]
) -> Iterator[tuple[SessionWriter, Observer]]:
    """Open the folder of a run: manifest, session and camera recorder.

    Args:
        rig: the bench; it goes to 0 V if the folder cannot be opened.
        options: folder, video.
        header: of the session.
        planned: what will be recorded.
    Raises:
        DeviceError: a file cannot be written.
    """
    in_real_time = isinstance(rig, GuardedRig) and rig.safety.settings.real_time
    with ExitStack() as opened:
        try:
            opened.enter_context(Manifest(options.folder, header))
            if in_real_time:
                opened.enter_context(with_priority())
            queue = QueueRule(patience_s=0.0) if in_real_time else None
            session = opened.enter_context(
                SessionWriter(
                    options.folder / "session.h5", list(planned), rig.description.block_samples,
                    header, queue,
                )
            )  # fmt: skip
            camera_recorder = opened.enter_context(
                CameraRecorder(
                    rig.camera, session, options.folder / "video", options.keep_video,
                    real_time=in_real_time,
                )
            )  # fmt: skip
        except BaseException:
            rig.safe()
            raise
        yield session, ThreadedObserver(camera_recorder) if in_real_time else camera_recorder


def run_study(
    study: Study,
    rig: Rig,
    options: RunOptions,
    progress: Progress,
    fitted: Callable[[ExperimentResult], None] = lambda outcome: None,
) -> Findings:
    """Play a study on a rig and fit all of it; the session file grows block by block.

    Args:
        study: what is played.
        rig: the bench; it always ends at 0 V.
        options: folder, seed, video.
        progress: in seconds of the rig.
        fitted: see `play_and_fit`.
    Returns:
        All findings; an experiment that failed is in `failed`.
    Raises:
        DeviceError: disk or instrument failed; the recorded data are kept.
        SafetyError: the bench protected itself.
    """
    sensing = study.sensing
    lockin = lockin_of(rig.description, sensing.carrier_hz)
    experiments = experiments_of(study)
    planned = [
        plan for each in experiments for plan in declared(each, "plans", ExperimentPlan, each.plans)
    ]
    refuse_repeated("recording", [plan.name for plan in planned])
    seconds = 0.0
    for each in experiments:
        with foreign(each, "seconds", InputError):
            seconds += float(each.seconds(rig.description))
    progress.start(seconds)
    header = session_header(study, rig.description, options)
    findings: Findings | None = None
    try:
        with recording(rig, options, header, planned) as (session, observer):

            def source(name: str) -> Observation:
                events = session.events()
                if name in cut_short(events):
                    raise ResultError(f"The recording of {name!r} was cut short.")
                record = session.experiment(name)
                return observe(record, events, lockin, sensing, rig.description)

            with Runner(
                rig, session, observer, sensing.carrier_hz, sensing.carrier_v, progress
            ) as runner:
                findings = play_and_fit(
                    source, study, rig.description, runner,
                    lambda what: progress.advance(0.0, f"fit: {what}"), fitted=fitted,
                    known={} if options.known is None else known_values(options.known),
                )  # fmt: skip
            if findings.find(Maps) is not None and study.has("triangle"):
                findings = _with_sheet(findings, session, rig.description)
            findings.require_complete()  # the manifest keeps the reason
    except ResultError:
        if findings is None or not findings.failed:
            raise
    return findings


def _with_sheet(
    findings: Findings, session: SessionWriter | SessionReader, rig: RigDescription
) -> Findings:
    """Add figure 2, of the particles tracked in the triangle test, to the findings."""
    drawn = sheet_figure(
        session.experiment("particles"), session.experiment("triangle"), rig, "video/triangle.png"
    )
    if not drawn:
        return findings
    return replace(findings, figures={**findings.figures, "tracks": drawn})


def described(data: Mapping[str, Any]) -> RigDescription:
    """The bench of a session's header."""
    fields = dict(data)
    fields["drive_limits"] = Limits(**fields["drive_limits"])
    if fields.get("calibration") is not None:
        pairs = {name: tuple(pair) for name, pair in fields["calibration"].items()}
        fields["calibration"] = MonitorCalibration(**pairs)
    return RigDescription(**fields)


def analyse_session(path: Path, *, unverified: bool = False) -> tuple[Findings, Study, JsonObject]:
    """Repeat all fits from the recorded session.

    Args:
        path: session.h5, or its folder.
        unverified: continue if a checksum does not match.
    Returns:
        Findings, the study, and the session's header. If the run ended early, `Findings.failed`
        says why.
    Raises:
        InputError: no session, a damaged one, or one that lacks an experiment.
    """
    path = session_file(path)
    with SessionReader(path, unverified=unverified) as session:
        if "study" not in session.header:
            raise InputError(
                "The recording does not contain a study, so there is no analysis to repeat. Read "
                f"it with 'haselab sense' or 'haselab session export'. {path}"
            )
        try:
            session.header["study"] = recorded_study(session.header["study"])
            study = checked_study(session.header["study"], path)
            rig = described(session.header["rig"])
            tables = validated(ActuatorTables, session.header.get("actuator", {}), path)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"The session's header is damaged ({error}). {path}") from None
        lockin = lockin_of(rig, study.sensing.carrier_hz)
        events, cut = session.events(), session.cut_short()
        unread: list[str] = []

        def source(name: str) -> Observation:
            if name in cut or (name in session.planned and name not in session.names):
                unread.append(name)
                raise ResultError(_ended_early(path, cut))
            return observe(session.experiment(name), events, lockin, study.sensing, rig)

        findings = play_and_fit(source, study, rig, known=known_values(tables))
        if unread:
            failed = dict.fromkeys((_ended_early(path, cut), *findings.failed))
            findings = replace(findings, failed=tuple(failed))
        if "particles" in session.names and "triangle" not in cut:
            findings = _with_sheet(findings, session, rig)
        return findings, study, session.header


def _ended_early(session: Path, cut: tuple[str, ...]) -> str:
    """Say that a run ended before all experiments were recorded, and why if that is known."""
    when = f"in {cut[-1]!r}" if cut else "before its last experiment"
    try:
        found = str(read_manifest(session.parent).get("ended", ""))
    except InputError:
        found = ""
    reason = "interrupted" if found == "KeyboardInterrupt" else found.partition(": ")[2] or found
    known = f": {reason.rstrip('.')}" if reason not in ("", "complete") else ""
    return f"The run ended {when}{known}."


def noise_free_results(
    config: TwinConfig,
    study: Study,
    known: ActuatorTables | None,
    repeated: Mapping[type, object],
) -> dict[str, float]:
    """Results of the same experiments and fits on the same twin without noise.

    Args:
        config: of the twin.
        study: what is played and fitted.
        known: the actuator file that the study starts from; None: there is none.
        repeated: values of the run with noise, by type, that are played again.
    Returns:
        Numbers by id.
    """
    noise_free = NoiseFreeBench(config, study)
    sensing = study.sensing
    # Without noise a sensor at rest repeats the same value, which is not a fault here.
    patient = SafetySettings(loop=WatchdogSettings(repeat_s=_HOUR_S))
    bench = guard(noise_free.rig, Safety(patient))
    arm_simulated(bench)
    with Runner(
        bench, noise_free, noise_free, sensing.carrier_hz, sensing.carrier_v, SilentProgress()
    ) as runner:
        found = play_and_fit(
            noise_free.observation, study, noise_free.rig.description, runner,
            repeated=repeated, known={} if known is None else known_values(known),
        )  # fmt: skip
    return {key: estimate.value for key, estimate in found.quantities.items()}
