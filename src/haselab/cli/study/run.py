"""`haselab run`: run a study on a bench, real or simulated."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.bench.arming import Operator, armed_rig, arming_options, gated_rig
from haselab.cli.common import actuator_option, answer_options
from haselab.cli.model.doubts import warn_doubts
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.run_path import ACTUATOR_FILE
from haselab.cli.study.chip_run import play_on_chip
from haselab.cli.study.study_run import (
    RUN_FOLDER,
    execute,
    execute_on,
    keep_video_option,
    twin_rig,
)
from haselab.cli.study.twin_option import draw_option, name_origin, on_bench_of, twin_of_options
from haselab.pipelines.actuator_bench import prepare_bench
from haselab.rig import Rig
from haselab.rig.chip import ChipFile
from haselab.rig.rig_file import RigFile, TwinFile, load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.store.actuator_file import ACTUATOR
from haselab.store.folder import write_text
from haselab.store.text_file import read_text
from haselab.study.definition import Study, load_step_study, load_study, quick_note
from haselab.study.experiments.steps import unplayed_trials
from haselab.study.feasibility import check_settings, require_camera
from haselab.study.known import with_actuator_tables

__all__ = ["command", "load_study_with_actuator", "rig_file"]


def rig_file(path: Path) -> tuple[TwinConfig, int]:
    """Read the configuration and the seed of the twin that a rig file describes.

    Args:
        path: of the TOML file.
    Returns:
        Configuration and seed.
    Raises:
        InputError: no such file, an error in it, another kind of rig, or both a twin and a reading.
    """
    file = load_rig(path)
    if not isinstance(file, TwinFile):
        raise InputError(
            f"The rig has kind = {file.kind!r}, but this command needs kind = 'twin'. {path}"
        )
    return file.configuration(path), file.seed


@click.command("run")
@click.argument("study", type=click.Path(path_type=Path))
@shared_option(
    "--rig", type=click.Path(path_type=Path),
    detail="Default: the default instruments, around the twin of --twin.",
)  # fmt: skip
@shared_option("--twin", type=ACTUATOR_FILE, detail="Default: that of --rig.")
@draw_option
@shared_option(
    "--quick",
    is_flag=True,
    detail="The table [quick] of STUDY describes it; without that table, all of STUDY is played.",
)
@keep_video_option
@actuator_option(
    "Its limits and its calibration apply; its maps are used if the study has no "
    "[triangle], its controller if it has no [control]. The run's actuator.toml starts as a copy "
    "of it."
)
@arming_options
@answer_options(OutputRule("folder"), RUN_FOLDER)
def command(
    study: Path,
    rig: Path | None,
    twin: Path | None,
    draw: int | None,
    quick: bool,
    keep_video: str,
    actuator: Path | None,
    yes: bool,
    acknowledge: bool,
    as_json: bool,
    out: Path | None,
) -> None:
    """Run STUDY on a bench and write the report.

    HIGH VOLTAGE WILL BE APPLIED on a real bench. The command first checks the study against the
    [rating] of the rig file; without [rating] there is no check. Then it asks you to acknowledge
    the last trip, if there was one, and to confirm. STUDY is a TOML file; a microcontroller (kind =
    "chip") needs a study of step trials. The maps, model and controllers found are written to
    actuator.toml in the folder of the run; the file of --actuator is not changed. With --actuator,
    a study that only has [steps] plays the controller of the file. With --twin A.toml, an actuator
    file of 'haselab identify actuator', the study is rehearsed on this simulated actuator.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    file, rig = _rig(rig, twin, draw)
    operator = Operator(yes, acknowledge)
    known = None if actuator is None else load_actuator(actuator)
    if isinstance(file, ChipFile):
        if actuator is not None:
            raise InputError(
                "--actuator has no effect on a microcontroller, whose limits are in its firmware. "
                f"Leave it out, and build the firmware with: haselab firmware build {actuator}"
            )
        trials = load_step_study(study, quick=quick)
        _note_quick(study, quick)
        armed_by = operator if file.port is not None else None
        play_on_chip(trials, file, rig, out, keep_video, armed_by, as_json)
        return
    plan = load_study_with_actuator(study, actuator, quick=quick)
    _note_quick(study, quick)
    if note := unplayed_trials(plan):
        click.echo(f"haselab: {note}", err=True)
    if actuator is not None:
        warn_doubts(actuator)
    if isinstance(file, TwinFile):
        config = file.configuration(rig)
        name_origin(config)
        limited = _prepared(twin_rig(config, file.seed), plan, actuator, config)
        with armed_rig(limited, file, rig, plan, out) as bench:
            _start_from(actuator, out)
            execute(plan, bench, config, file.seed, out, keep_video, as_json, known=known)
        return
    require_camera(file, plan, rig)
    with (
        gated_rig(file, rig) as opened,
        armed_rig(_prepared(opened, plan, actuator), file, rig, plan, out, operator) as bench,
    ):
        _start_from(actuator, out)
        execute_on(plan, bench, file.model_dump(mode="json"), out, keep_video, as_json, known)


def _rig(rig: Path | None, twin: Path | None, draw: int | None) -> tuple[RigFile, Path]:
    """The rig of the options, and the path of its file.

    Raises:
        UsageError: neither --rig nor --twin.
        InputError: the options contradict each other, or a file cannot be used.
    """
    if rig is None:
        if twin is None:
            raise click.UsageError("Missing option '--rig': the file of the bench, or '--twin'.")
        return twin_of_options(None, twin, 1, draw), twin
    file = load_rig(rig)
    if twin is None:
        if draw is not None:
            raise InputError(f"--draw {draw} needs --twin A.toml; a rig file has a key draw. {rig}")
        return file, rig
    if not isinstance(file, TwinFile):
        raise InputError(
            f"--twin replaces the actuator of a twin, but the rig has kind = {file.kind!r}. Leave "
            f"out --twin, or name the rig file of a twin. {rig}"
        )
    return on_bench_of(file, twin, draw, rig), rig


def _note_quick(study: Path, quick: bool) -> None:
    """Say that --quick has no effect on a study without a table for it."""
    if quick and (note := quick_note(study)):
        click.echo(f"haselab: {note}", err=True)


def load_study_with_actuator(path: Path, actuator: Path | None, *, quick: bool) -> Study:
    """Read a study, and add the content of an actuator file to it, see `with_actuator_tables`.

    Args:
        path: of the study.
        actuator: the actuator file; None: there is none.
        quick: apply the changes of a quick run.
    Returns:
        The study that is played.
    Raises:
        InputError: a file cannot be used, or no result can come from the study.
    """
    study = load_study(path, quick=quick)
    if actuator is not None:
        try:
            study = with_actuator_tables(study, load_actuator(actuator))
        except InputError as error:
            raise InputError(f"{error} {actuator}") from None
    try:
        check_settings(study)
    except InputError as error:
        raise InputError(f"{error} {path}") from None
    return study


def _prepared(rig: Rig, study: Study, actuator: Path | None, twin: TwinConfig | None = None) -> Rig:
    """The bench with the limits and the calibration of an actuator file, see `prepare_bench`."""
    if actuator is not None:
        tables = load_actuator(actuator)
        if note := prepare_bench(rig, tables, actuator, study.sensing.carrier_hz, twin):
            click.echo(f"haselab: {note}", err=True)
    return rig


def _start_from(actuator: Path | None, folder: Path) -> None:
    """Copy the actuator file to the folder of the run."""
    if actuator is not None:
        write_text(folder / ACTUATOR, read_text(actuator, "actuator file"))
