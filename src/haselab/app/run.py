"""`haselab run`: any study on any rig."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click
from pydantic import BaseModel, ConfigDict, Field

from haselab.app.common import answer_options
from haselab.app.study_run import MAX_SEED, execute, twin_rig
from haselab.base import InputError
from haselab.rig.twin.config import TwinConfig, load_twin, twin_of_reading
from haselab.store.toml import read_toml, validated
from haselab.study.definition import load_study

__all__ = ["command", "rig_file"]


class _RigFile(BaseModel):
    """RIG.toml: `kind = "twin"`, `twin = "TWIN.toml"` or `reading = "hz"`, `seed = 1`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["twin"]
    twin: str | None = None
    reading: Literal["rad", "hz"] | None = None
    seed: int = Field(1, ge=0, le=MAX_SEED)


def rig_file(path: Path) -> tuple[TwinConfig, int]:
    """The twin that a rig file describes, and its seed.

    Args:
        path: of the TOML file.
    Returns:
        Configuration and seed.
    Raises:
        InputError: no such file, a fault in it, or both a twin and a reading.
    """
    file = validated(_RigFile, read_toml(path, "rig file"), path)
    if file.twin is None:
        return twin_of_reading(file.reading or "hz"), file.seed
    if file.reading is not None:
        raise InputError(f"twin and reading both given; the twin's file has a reading. {path}")
    return load_twin(path.parent / file.twin), file.seed


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
@answer_options
def command(
    study: Path, rig: Path, quick: bool, keep_video: str, as_json: bool, out: Path | None
) -> None:
    """Play STUDY.toml on a rig, fit all of it and write the report."""
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the run.")
    config, seed = rig_file(rig)
    plan = load_study(study, quick=quick)
    execute(plan, twin_rig(config, seed), config, seed, out, keep_video, as_json)
