"""`haselab reproduce`: run the reference study on the twin."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from haselab.cli.bench.arming import armed_rig
from haselab.cli.common import SEED, answer_options
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.run_path import ACTUATOR_FILE
from haselab.cli.study.chip_experiments import ChipExperiments
from haselab.cli.study.study_run import (
    RUN_FOLDER,
    execute,
    keep_video_option,
    physical_model_option,
    twin_rig,
)
from haselab.cli.study.twin_option import draw_option, name_origin, twin_of_options
from haselab.study.definition import builtin_study

__all__ = ["command"]


@click.command("reproduce")
@shared_option("--reading", type=click.Choice(["rad", "hz"]), detail="Default: hz.")
@shared_option("--twin", type=ACTUATOR_FILE, detail="Default: see --reading.")
@draw_option
@shared_option("--seed", type=SEED, default=1, show_default=True)
@shared_option("--quick", is_flag=True, detail="It has fewer trials and frames.")
@physical_model_option
@keep_video_option
@answer_options(OutputRule("folder"), RUN_FOLDER)
def command(
    reading: Literal["rad", "hz"] | None,
    twin: Path | None,
    draw: int | None,
    seed: int,
    quick: bool,
    physical_model: bool,
    keep_video: str,
    as_json: bool,
    out: Path | None,
) -> None:
    """Run the reference study on the simulated bench.

    It plays every test, fits all models, designs the controllers, plays the step experiments and
    writes the report. No hardware is needed. With an actuator file of 'haselab identify actuator',
    --twin simulates your own actuator.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    at = Path("reproduce.toml") if twin is None else twin
    file = twin_of_options(reading, twin, seed, draw)
    config = file.configuration(at)
    name_origin(config)
    study = builtin_study(quick=quick)
    with armed_rig(twin_rig(config, seed), file, at, study, out) as bench:
        chips = ChipExperiments(out, study, config, seed, quick, keep_video)
        execute(
            study, bench, config, seed, out, keep_video, as_json, chips,
            physical_model=physical_model,
        )  # fmt: skip
