"""Read the folder of a run for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread

from haselab.base import InputError
from haselab.report.analysis import Array, LeftOutError, Section
from haselab.report.results import Results
from haselab.store.text_file import parse_json, read_text

__all__ = ["RunFolder", "read_folder"]


@dataclass(frozen=True)
class RunFolder:
    """The contents of a run's folder.

    Args:
        path: the folder.
        results: checked content of results.json.
        analysis: parsed analysis.json, empty if the folder has none; its section `chip` comes from
            firmware/simulation.json, if that exists.
    """

    path: Path
    results: Results
    analysis: Mapping[str, Any]

    def section(self, name: str) -> Section:
        """One top-level section of analysis.json.

        Args:
            name: such as `triangle`.

        Returns:
            The section.

        Raises:
            LeftOutError: the file has no such section.
        """
        if self.analysis.get(name) is None:
            raise LeftOutError(f"analysis.json has no section '{name}'.")
        return Section(name, self.analysis[name])

    def picture(self, relative: str) -> Array | None:
        """A grey picture of the folder, or `None` if the file does not exist.

        Args:
            relative: path inside the folder.

        Returns:
            Grey level from 0 to 1, shape `(rows, columns)`.

        Raises:
            LeftOutError: the path leaves the folder, or the file is not a picture.
        """
        path = (self.path / relative).resolve()
        if not path.is_relative_to(self.path.resolve()):
            raise LeftOutError(f"the picture {relative} is outside the folder of the run.")
        if not path.is_file():
            return None
        try:
            image = np.asarray(imread(path), dtype=np.float64)
        except (OSError, SyntaxError, ValueError) as error:
            raise LeftOutError(f"the picture {relative} cannot be read.") from error
        return image if image.ndim == 2 else image[..., :3].mean(axis=2)


def _document(path: Path) -> Any:
    return parse_json(read_text(path), path)


def read_folder(folder: Path) -> RunFolder:
    """Read results.json and, if it exists, analysis.json.

    Args:
        folder: the folder of a run.

    Returns:
        The checked content.

    Raises:
        InputError: no such folder, no results.json, or an invalid file.
    """
    if not folder.is_dir():
        raise InputError(f"The folder does not exist. Name the --out folder of a run: {folder}")
    results = folder / "results.json"
    if not results.is_file():
        if not (folder / "session.h5").exists():
            raise InputError(
                "The folder is not that of a run: it has neither results.json nor session.h5. Name "
                f"the --out folder of a run: {folder}"
            )
        raise InputError(
            f"The folder has no results.json. Create it with 'haselab analyse {folder}': {folder}"
        )
    try:
        checked = Results.from_dict(_document(results))
    except InputError as error:
        message = str(error)
        raise InputError(message if str(results) in message else f"{message} {results}") from error
    analysis = folder / "analysis.json"
    data = _document(analysis) if analysis.is_file() else {}
    if not isinstance(data, Mapping):
        raise InputError(
            f"analysis.json contains a {type(data).__name__} instead of a mapping of sections. "
            f"Write it again with 'haselab analyse {folder}': {analysis}"
        )
    chip = folder / "firmware" / "simulation.json"
    if chip.is_file():
        data = {**data, "chip": _document(chip)}
    return RunFolder(folder, checked, data)
