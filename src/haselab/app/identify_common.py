"""What the commands of `haselab identify` share: options, the rate of a table, the answer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import click

from haselab.app.common import emit
from haselab.base import InputError, ResultError
from haselab.store.tables import Table

__all__ = ["FILE", "FILES", "INPUT", "OUTPUT", "RATE", "Fit", "give", "rate_hz_of"]

FILE = click.argument("file", type=click.Path(path_type=Path))
FILES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path))
RATE = click.option("--rate-hz", type=float, help="Rows a second, where the file does not tell.")
INPUT = click.option("--input", "source", default="u", show_default=True, help="Input column.")
OUTPUT = click.option("--output", default="y", show_default=True, help="Output column.")


class Fit(Protocol):
    """What all fits have in common."""

    @property
    def status(self) -> str:
        """The word ok, or why there is no result."""

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""

    def answer(self) -> dict[str, Any]:
        """Keys of the public contract."""


def give(fit: Fit, files: Sequence[Path], as_json: bool, out: Path | None) -> None:
    """Print the answer; a fit without a result ends the command with exit code 3."""
    if not fit.succeeded:
        listed = " ".join(str(file) for file in files)
        if as_json:
            emit(fit.answer(), as_json=True, out=out)
        raise ResultError(f"{fit.status}: {listed}")
    emit(fit.answer(), as_json=as_json, out=out)


def rate_hz_of(table: Table, given: float | None, file: Path) -> float:
    """Rate of a table: as given, else as the file tells it, else an `InputError`."""
    rate_hz = table.rate_hz if given is None else given
    if rate_hz is None:
        raise InputError(
            "The file does not tell its rate. Give --rate-hz, add a line '# rate_hz = ...', "
            f"or add a column time_s: {file}"
        )
    if not 0.0 < rate_hz < float("inf"):
        raise InputError(f"--rate-hz = {rate_hz:g} Hz; allowed is above 0 Hz. Correct it.")
    return rate_hz
