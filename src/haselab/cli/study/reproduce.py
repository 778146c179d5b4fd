"""`haselab reproduce`: the reference study on the twin."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from haselab.cli.bench.arming import armed_rig
from haselab.cli.common import answer_options, refuse_two_twins
from haselab.cli.output import OutputRule
from haselab.cli.study.chip_experiments import ChipExperiments
from haselab.cli.study.study_run import MAX_SEED, execute, twin_rig
from haselab.rig.rig_file import TwinFile
from haselab.study.definition import builtin_study

__all__ = ["command"]


@click.command("reproduce")
@click.option(
    "--reading",
    type=click.Choice(["rad", "hz"]),
    help="Use the default twin of this interpretation of the paper's frequency axis: rad/s as "
    "printed, or Hz.  [default: hz]",
)
@click.option(
    "--twin",
    type=click.Path(path_type=Path),
    help="Use the twin of TWIN.toml, which has a reading.",
)
@click.option("--seed", type=click.IntRange(0, MAX_SEED), default=1, show_default=True)
@click.option("--quick", is_flag=True, help="Fewer trials and frames.")
@click.option(
    "--keep-video",
    type=click.Choice(["none", "sample", "all"]),
    default="sample",
    show_default=True,
    help="Camera frames to keep.",
)
@answer_options(OutputRule("folder"), "New folder for the recording and the results.")
def command(
    reading: Literal["rad", "hz"] | None,
    twin: Path | None,
    seed: int,
    quick: bool,
    keep_video: str,
    as_json: bool,
    out: Path | None,
) -> None:
    """Run the whole reference study on the twin: every test, fit, design and step experiment."""
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    refuse_two_twins(reading, twin)
    at = Path("reproduce.toml") if twin is None else twin
    file = TwinFile(
        kind="twin", twin=None if twin is None else twin.name, seed=seed, reading=reading
    )
    config = file.configuration(at)
    study = builtin_study(quick=quick)
    with armed_rig(twin_rig(config, seed), file, at, study, out) as bench:
        chips = ChipExperiments(out, study, config, seed, quick, keep_video)
        execute(study, bench, config, seed, out, keep_video, as_json, chips)
