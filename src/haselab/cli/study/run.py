"""`haselab run`: run a study on a bench, real or simulated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from haselab.base import InputError, Limits
from haselab.cli.actuator_file import load_actuator
from haselab.cli.bench.arming import Operator, armed_rig, arming_options, gated_rig
from haselab.cli.common import actuator_option, answer_options
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_run import play_on_chip
from haselab.cli.study.study_run import (
    RUN_FOLDER,
    execute,
    execute_on,
    keep_video_option,
    twin_rig,
)
from haselab.rig import Rig
from haselab.rig.chip import MegaFile
from haselab.rig.rig_file import TwinFile, load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.store.actuator_file import ACTUATOR
from haselab.store.folder import write_text
from haselab.store.text_file import read_text
from haselab.study.definition import load_step_study, load_study

__all__ = ["command", "rig_file"]


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
@shared_option("--rig", required=True, type=click.Path(path_type=Path))
@shared_option("--quick", is_flag=True, detail="It is described by its table [quick].")
@keep_video_option
@actuator_option(
    "Its [drive] limits apply in addition to those of the rig. The run's actuator.toml starts as a "
    "copy of it."
)
@arming_options
@answer_options(OutputRule("folder"), RUN_FOLDER)
def command(
    study: Path,
    rig: Path,
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
    "mega") needs a study of step trials. The maps, model and controllers found are written to
    actuator.toml in the folder of the run; the file of --actuator is not changed.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    file = load_rig(rig)

    operator = Operator(yes, acknowledge)
    if actuator is not None:
        load_actuator(actuator)
    if isinstance(file, MegaFile):
        if actuator is not None:
            raise InputError(
                "--actuator has no effect on a microcontroller, whose limits are in its firmware. "
                f"Leave it out, and build the firmware with: haselab firmware build {actuator}"
            )
        trials = load_step_study(study, quick=quick)
        armed_by = operator if file.port is not None else None
        play_on_chip(trials, file, rig, out, keep_video, armed_by, as_json)
        return
    plan = load_study(study, quick=quick)
    if isinstance(file, TwinFile):
        config = file.configuration(rig)
        limited = _limited(twin_rig(config, file.seed), actuator)
        with armed_rig(limited, file, rig, plan, out) as bench:
            _start_from(actuator, out)
            execute(plan, bench, config, file.seed, out, keep_video, as_json)
        return
    with (
        gated_rig(file, rig) as opened,
        armed_rig(_limited(opened, actuator), file, rig, plan, out, operator) as bench,
    ):
        _start_from(actuator, out)
        execute_on(plan, bench, file.model_dump(mode="json"), out, keep_video, as_json)


def _limited(rig: Rig, actuator: Path | None) -> Rig:
    """Limit the drive of the bench to what the actuator withstands, too.

    Raises:
        InputError: no voltage is within both ranges.
    """
    if actuator is None:
        return rig
    drive, limits = load_actuator(actuator).drive, rig.description.drive_limits
    low_v = limits.low if drive.low_v is None else max(limits.low, drive.low_v)
    high_v = limits.high if drive.high_v is None else min(limits.high, drive.high_v)
    if not low_v < high_v:
        raise InputError(
            f"[drive] permits {drive.low_v} to {drive.high_v} V, but the rig outputs "
            f"{limits.low:g} to {limits.high:g} V. Change low_v and high_v in [drive]. {actuator}"
        )
    narrowed = Limits(limits.name, low_v, high_v, limits.unit)
    rig.description = replace(rig.description, drive_limits=narrowed)
    return rig


def _start_from(actuator: Path | None, folder: Path) -> None:
    """Copy the actuator file to the folder of the run."""
    if actuator is not None:
        write_text(folder / ACTUATOR, read_text(actuator, "actuator file"))
