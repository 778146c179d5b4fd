"""What `reproduce`, `run` and `analyse` share: run a study, write its folder, print its table."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, cast

import click

from haselab.base import (
    HaselabError,
    InputError,
    JsonObject,
    ResultError,
    table_at,
    text_of,
    to_plain,
)
from haselab.cli.actuator_file import mark_sections
from haselab.cli.common import progress_bar
from haselab.cli.interrupt import Interruptible
from haselab.cli.options import shared_option
from haselab.cli.study.model_control import play_model_control
from haselab.cli.study.noise_free_run import NoiseFreeRun
from haselab.cli.study.physical_model import identify_physical_model, note_no_model
from haselab.cli.study.recommended_mass import with_mass_limit
from haselab.controllers import KnownActuator
from haselab.models.actuator import ActuatorTables
from haselab.rig import Rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.camera_recorder import KeepVideo
from haselab.store.actuator_file import ACTUATOR
from haselab.store.manifest import read_manifest, recorded_when
from haselab.store.session.writer import SessionReader
from haselab.study.analysis import experiments_of
from haselab.study.chip.rows import with_chip_rows
from haselab.study.definition import Study
from haselab.study.experiment import ExperimentResult
from haselab.study.feasibility import check_drives
from haselab.study.folder import sections_found, write_findings
from haselab.study.known import known_values
from haselab.study.own_controller import own_controller
from haselab.study.physical.session import NOT_HERE, with_model_rows
from haselab.study.pipeline import Findings
from haselab.study.run import RunOptions, run_study, session_header

__all__ = [
    "RUN_FOLDER",
    "ParallelExperiments",
    "check_folder",
    "execute",
    "execute_on",
    "keep_video_option",
    "kept_data_note",
    "mark_found",
    "physical_model_option",
    "print_results",
    "require_complete",
    "twin_rig",
    "with_date",
]

RUN_FOLDER = "It is a new folder for the recording and the results.  [required]"
keep_video_option = shared_option(
    "--keep-video", type=click.Choice(["none", "sample", "all"]), default="sample",
    show_default=True, detail="sample: the first and the last second of each experiment.",
)  # fmt: skip
physical_model_option = shared_option(
    "--physical-model/--no-physical-model", default=True, show_default=True,
    detail="Results S14 to S21 then follow from it.",
)  # fmt: skip


class ParallelExperiments(Protocol):
    """Experiments of a study that run on another bench at the same time."""

    def prepare(self) -> None:
        """Start what needs no result of the study."""

    def start(self, outcome: ExperimentResult) -> None:
        """Take the outcome of a fit; start once all that the experiments need is known."""

    def finish(self) -> Mapping[str, str]:
        """Wait for the end; return why an experiment was left out, by its row."""

    def stop(self) -> None:
        """End at once, if still running."""


def twin_rig(config: TwinConfig, seed: int) -> Rig:
    """Make the simulated bench of a configuration."""
    return make_twin(config, seed)


def kept_data_note(folder: Path) -> str:
    """The note of an interrupted run about its recording."""
    return f"The data recorded so far are kept in {folder}."


def check_folder(folder: Path) -> None:
    """Refuse a path that cannot become the folder of a run."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out names a file, not a folder. Name a new folder. {folder}")


def _check_before_anything_moves(study: Study, rig: Rig, options: RunOptions) -> None:
    """Refuse a study now that this rig or its controller would refuse hours later."""
    check_folder(options.folder)
    check_drives(study, rig.description)
    found = {kind for experiment in experiments_of(study) for kind in experiment.gives}
    if (own := own_controller(study)) is not None and KnownActuator not in found:
        known = {} if options.known is None else known_values(options.known)
        own.kind.check_actuator(cast("KnownActuator | None", known.get(KnownActuator)))


def execute(
    study: Study,
    rig: Rig,
    config: TwinConfig,
    seed: int,
    folder: Path,
    keep_video: str,
    as_json: bool,
    parallel: ParallelExperiments | None = None,
    known: ActuatorTables | None = None,
    physical_model: bool = False,
) -> None:
    """Run a study on a twin, write its folder, print its table.

    Args:
        study: what is played.
        rig: the twin.
        config: of it.
        seed: of its noise.
        folder: of the run.
        keep_video: which frames are kept.
        as_json: print JSON.
        parallel: experiments that run at the same time; None: there are none.
        known: the actuator file that the study starts from; None: there is none.
        physical_model: identify the physical model from the recording.
    """
    rig_config = config.model_dump(mode="json")
    options = RunOptions(folder, seed, cast(KeepVideo, keep_video), rig_config, known)
    noise_free_run = NoiseFreeRun(config, study, known)
    modelled = config if physical_model else None
    _execute(study, rig, options, as_json, noise_free_run, parallel, modelled)


def execute_on(
    study: Study,
    rig: Rig,
    rig_config: JsonObject,
    folder: Path,
    keep_video: str,
    as_json: bool,
    known: ActuatorTables | None = None,
) -> None:
    """Run a study on a real rig, write its folder, print its table."""
    options = RunOptions(folder, 0, cast(KeepVideo, keep_video), rig_config, known)
    _execute(study, rig, options, as_json)


def _execute(
    study: Study,
    rig: Rig,
    options: RunOptions,
    as_json: bool,
    noise_free_run: NoiseFreeRun | None = None,
    parallel: ParallelExperiments | None = None,
    modelled: TwinConfig | None = None,
) -> None:
    folder = options.folder
    _check_before_anything_moves(study, rig, options)
    progress = Interruptible(progress_bar())
    noise_free = None
    running = ExitStack()
    companions = [one for one in (noise_free_run, parallel) if one is not None]

    def fitted(outcome: ExperimentResult) -> None:
        for one in companions:
            one.start(outcome)

    try:
        if noise_free_run is not None:
            running.enter_context(noise_free_run)
        if parallel is not None:
            parallel.prepare()
        found = run_study(study, rig, options, progress, fitted)
        model = None
        by_model: Findings | str = NOT_HERE
        if modelled is not None and not found.failed:
            progress.advance(0.0, "physical model")
            model = identify_physical_model(folder, study, found)
            found = model.joined(found)
            if study.is_reference:
                by_model = play_model_control(study, rig, modelled, options, found, model, progress)
                if isinstance(by_model, str):
                    rows = "S25 (observer), S27 and S30"
                    click.echo(f"haselab: {rows} were left out: {by_model}", err=True)
        elif modelled is not None:
            note_no_model()
        if noise_free_run is not None:
            progress.advance(0.0, "noise-free reference run")
            noise_free = _noise_free(noise_free_run)
        if parallel is not None:
            progress.advance(0.0, "microcontroller experiments")
            for row, why in parallel.finish().items():
                click.echo(f"haselab: {row} was left out: {why}", err=True)
    except KeyboardInterrupt as stop:
        stop.add_note(kept_data_note(folder))
        raise
    except HaselabError as error:
        raise _with_advice(error, folder) from error
    finally:
        rig.safe()
        progress.stop()
        running.close()
        if parallel is not None:
            parallel.stop()
    if study.is_reference:
        found = with_model_rows(with_chip_rows(found, folder), by_model)
    found = with_mass_limit(found, study, options.rig_config)
    header = with_date(session_header(study, rig.description, options), folder)
    results = write_findings(folder, found, study, header, noise_free)
    mark_found(folder, found, folder, simulated=bool(results["simulated"]))
    if model is not None:
        model.save(folder, folder)
    print_results(results, folder, as_json)
    require_complete(found, folder)


def _with_advice(error: HaselabError, folder: Path) -> HaselabError:
    """The same error; if complete experiments were recorded, with the command that fits them."""
    try:
        with SessionReader(folder / "session.h5") as session:
            complete = session.complete()
    except (HaselabError, OSError):  # only the advice depends on it
        return error
    if not complete:
        return error
    advice = f"Compute the results of the complete experiments with: haselab analyse {folder}"
    error.args = (f"{text_of(error).rstrip('.')}. {advice}",)  # its class may be another package's
    return error


def require_complete(found: Findings, folder: Path) -> None:
    """End the command with the reason if an experiment failed; the other results are written.

    Args:
        found: by the study.
        folder: of the results.
    Raises:
        ResultError: see `Findings.require_complete`.
    """
    others = f"The results of the other experiments are in {folder}."
    found.require_complete(others if found.quantities else f"There are no results. {folder}")


def with_date(header: Mapping[str, Any], recorded_in: Path | None) -> JsonObject:
    """A session's header with the date and the duration of the recording, for the provenance.

    Args:
        header: of the session.
        recorded_in: folder of the session; None, or one without a manifest: nothing is added.
    Returns:
        The header.
    """
    try:
        found = {} if recorded_in is None else recorded_when(read_manifest(recorded_in))
    except InputError:
        found = {}
    return {**header, **({"recorded": found} if found else {})}


def mark_found(folder: Path, found: Findings, recorded_in: Path | None, *, simulated: bool) -> None:
    """Write the provenance of the sections in a run's actuator file.

    Args:
        folder: of the results.
        found: what was written to the file.
        recorded_in: folder of the session, whose manifest holds its hash; None: there is none.
        simulated: the run was played on a twin.
    """
    try:
        manifest = {} if recorded_in is None else read_manifest(recorded_in)
        inputs = {"session.h5": str(table_at(manifest, "files", "session.h5")["sha256"])}
    except (InputError, KeyError, TypeError):
        inputs = {}
    mark_sections(folder / ACTUATOR, sections_found(found), inputs, simulated=simulated)


def _noise_free(run: NoiseFreeRun) -> dict[str, float] | None:
    """Results of the twin without noise; None, with a note, if a fit fails there."""
    try:
        return run.results()
    except ResultError as error:
        click.echo(f"haselab: no noise-free results: {error}", err=True)
        return None


def print_results(results: Mapping[str, Any], folder: Path, as_json: bool) -> None:
    """Write the report and print the results."""
    from haselab.report import (
        results_table,
        write_report,
    )  # matplotlib takes half a second to import

    plain = to_plain(results)
    page = write_report(folder)
    if as_json:
        click.echo(json.dumps(plain, indent=2))
    else:
        click.echo(results_table(plain))
        click.echo(f"\n{page}")
