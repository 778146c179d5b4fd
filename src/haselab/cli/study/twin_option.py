"""`--twin` and `--draw`: the twin that a command uses."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import click

from haselab.base import InputError
from haselab.cli.common import SEED
from haselab.cli.options import shared_option
from haselab.rig.rig_file import TwinFile
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_file import is_actuator_file

__all__ = ["draw_option", "name_origin", "on_bench_of", "twin_of_options"]

draw_option = shared_option("--draw", type=SEED)


def twin_of_options(
    reading: Literal["rad", "hz"] | None, twin: Path | None, seed: int, draw: int | None
) -> TwinFile:
    """The rig of `--reading`, `--twin` and `--draw`.

    Args:
        reading: of a default twin.
        twin: a TWIN.toml or an actuator file; None: the default twin of the reading.
        seed: of the noise.
        draw: seed of drawn parameters; None: the estimates.
    Returns:
        The content of a rig file in the working directory.
    Raises:
        InputError: one of the options has no effect.
    """
    whole = twin is not None and not is_actuator_file(twin)
    if reading is not None and whole:
        raise InputError(
            f"--reading {reading} chooses a default twin, but --twin describes another one. Leave "
            f"one of them out. {twin}"
        )
    if draw is not None and (twin is None or whole):
        raise InputError(
            f"--draw {draw} draws the parameters of an identified actuator. Name its actuator file "
            "with --twin A.toml, or leave out --draw."
        )
    path = None if twin is None else str(twin.absolute())
    return TwinFile(kind="twin", twin=path, reading=reading, seed=seed, draw=draw)


def on_bench_of(file: TwinFile, twin: Path, draw: int | None, rig: Path) -> TwinFile:
    """The rig of a file with the identified actuator of another file.

    Args:
        file: of the rig.
        twin: an actuator file.
        draw: seed of drawn parameters; None: the estimates.
        rig: path of the rig file.
    Returns:
        The rig, whose instruments and seed are those of the file.
    Raises:
        InputError: The rig already has an identified actuator, or `twin` is no actuator file.
    """
    if not is_actuator_file(twin):
        raise InputError(
            "--twin is a whole twin with its own instruments, but --rig names other ones. Leave "
            f"out --rig, or give --twin an actuator file. {twin}"
        )
    if file.twin is not None and is_actuator_file(rig.parent / file.twin):
        raise InputError(
            f"The rig already has the identified actuator {file.twin}. Leave out --twin. {rig}"
        )
    changes = {"twin": str(twin.absolute()), "bench": file.twin, "draw": draw}
    return file.model_copy(update=changes)


def name_origin(config: TwinConfig) -> None:
    """Say on stderr which identified actuator a twin is, and what of it is not known.

    Args:
        config: of the twin; nothing is said of one that was not identified.
    """
    origin = config.origin
    if origin is None:
        return
    how = "with its estimates" if origin.draw is None else f"drawn with seed {origin.draw}"
    click.echo(
        f"haselab: simulating the identified actuator {origin.actuator!r}, {how}. {origin.file}",
        err=True,
    )
    if origin.not_identifiable and origin.draw is None:
        click.echo(
            "haselab: warning: not identifiable from its records: "
            f"{', '.join(origin.not_identifiable)}. Their values are arbitrary, and so is what "
            "depends on them. --draw SEED draws them from [actuator.distribution].",
            err=True,
        )
