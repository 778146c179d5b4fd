"""`haselab run`: any study on any rig."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.bench.arming import Operator, armed_rig, arming_options, gated_rig
from haselab.cli.common import answer_options
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_run import play_on_chip
from haselab.cli.study.study_run import execute, execute_on, twin_rig
from haselab.rig.chip import MegaFile
from haselab.rig.rig_file import TwinFile, load_rig
from haselab.rig.twin.config import TwinConfig
from haselab.study.definition import load_step_study, load_study

__all__ = ["command", "rig_file"]


def rig_file(path: Path) -> tuple[TwinConfig, int]:
    """The twin that a rig file describes, and its seed, for what only a twin can do.

    Args:
        path: of the TOML file.
    Returns:
        Configuration and seed.
    Raises:
        InputError: no such file, a fault in it, another kind of rig, or both a twin and a reading.
    """
    file = load_rig(path)
    if not isinstance(file, TwinFile):
        raise InputError(
            f"RIG has kind = {file.kind!r}, but this command needs kind = 'twin'. {path}"
        )
    return file.configuration(path), file.seed


@click.command("run")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--rig", required=True, type=click.Path(path_type=Path), help="RIG.toml")
@click.option("--quick", is_flag=True, help="Apply the study's table `quick`.")
@click.option(
    "--keep-video",
    type=click.Choice(["none", "sample", "all"]),
    default="sample",
    show_default=True,
    help="Camera frames to keep.",
)
@arming_options
@answer_options(OutputRule("folder"), "New folder for the recording and the results.  [required]")
def command(
    study: Path,
    rig: Path,
    quick: bool,
    keep_video: str,
    yes: bool,
    acknowledge: bool,
    as_json: bool,
    out: Path | None,
) -> None:
    """Play STUDY.toml on a rig, fit all results and write the report.

    HIGH VOLTAGE WILL BE APPLIED on a real bench. The study is checked against [rating] first;
    without [rating] it is not checked. Then you acknowledge the last trip, if there was one, and
    confirm. A microcontroller rig (kind = "mega") takes a study of step trials.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    file = load_rig(rig)

    operator = Operator(yes, acknowledge)
    if isinstance(file, MegaFile):
        trials = load_step_study(study, quick=quick)
        armed_by = operator if file.port is not None else None
        play_on_chip(trials, file, rig, out, keep_video, armed_by, as_json)
        return
    plan = load_study(study, quick=quick)
    if isinstance(file, TwinFile):
        config = file.configuration(rig)
        with armed_rig(twin_rig(config, file.seed), file, rig, plan, out) as bench:
            execute(plan, bench, config, file.seed, out, keep_video, as_json)
        return
    with gated_rig(file, rig) as opened, armed_rig(opened, file, rig, plan, out, operator) as bench:
        execute_on(plan, bench, file.model_dump(mode="json"), out, keep_video, as_json)
