"""Warnings of a controller and a model that do not fit the rest of their file."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.cli.actuator_file import warn_misspelled_in
from haselab.control import LoopSetting
from haselab.control.feedthrough import feedthrough_doubt, with_feedthrough
from haselab.pipelines.design.model_file import read_tables
from haselab.pipelines.design.stated_margins import (
    controller_doubt,
    delay_doubt,
    drive_doubt,
    model_doubt,
)

__all__ = ["sensed_loop", "warn_doubts"]


def sensed_loop(setting: LoopSetting, model: Path) -> LoopSetting:
    """The loop of a model, with the feedthrough of its actuator file; warn if nobody knows it.

    Args:
        setting: rate, delay and limits.
        model: of the loop; a file that is no actuator file leaves the loop unchanged.
    Returns:
        The loop.
    """
    if model.suffix.lower() != ".toml":
        return setting
    tables = read_tables(model)
    found = with_feedthrough(setting, tables)
    if doubt := feedthrough_doubt(found, tables):
        click.echo(f"haselab: warning: {doubt}: {model}", err=True)
    return found


def warn_doubts(path: Path, kind: str | None = None) -> None:
    """Warn of margins and a delay that are not those of the model, and of a model for another map.

    Also warn of a highest drive that is not in the unit of the map.

    Args:
        path: an actuator file, or the folder of a run.
        kind: kind or name of the controller; None: that of `[controller]`.
    """
    warn_misspelled_in(path)
    for doubt in (
        drive_doubt(path), model_doubt(path), controller_doubt(path, kind), delay_doubt(path, kind)
    ):  # fmt: skip
        if doubt:
            click.echo(f"haselab: warning: {doubt}", err=True)
