"""Arguments that name an actuator file: the folder of a run stands for the file in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from haselab.base import InputError
from haselab.store.actuator_file import ACTUATOR

__all__ = ["ACTUATOR_FILE", "MODEL_FILE", "RUN_OR_MODEL", "is_run"]

_OF_RUN = ("results.json", "session.h5")
_MODEL = "model.json"  # of the folder of an older run


def is_run(path: Path) -> bool:
    """Whether a path is the folder of a run: it has results or a recording.

    Args:
        path: of any file or folder.
    """
    return path.is_dir() and any((path / name).exists() for name in _OF_RUN)


class _InRun(click.Path):
    """A path; a folder is replaced by the first of some files that it holds."""

    def __init__(self, *names: str) -> None:
        super().__init__(path_type=Path)
        self.names = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the file.

        Raises:
            InputError: a folder without any of the files.
        """
        path = super().convert(value, param, ctx)
        assert isinstance(path, Path)
        if not path.is_dir():
            return path
        for name in self.names:
            if (path / name).exists():
                return path / name
        raise InputError(
            f"The folder has no {' and no '.join(self.names)}. Name an actuator file, or the "
            f"folder of a run with one: {path}"
        )


class _RunOrInRun(_InRun):
    """The same, but the folder of a run stays a folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Return the folder of a run, or a file.

        Raises:
            InputError: another folder, without any of the files.
        """
        path = Path(click.Path(path_type=Path).convert(value, param, ctx))
        return path if is_run(path) else super().convert(value, param, ctx)


ACTUATOR_FILE = _InRun(ACTUATOR)
MODEL_FILE = _InRun(ACTUATOR, _MODEL)
RUN_OR_MODEL = _RunOrInRun(ACTUATOR, _MODEL)
