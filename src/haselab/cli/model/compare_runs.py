"""`haselab compare RUN RUN`: the results of two runs, row by row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from haselab.base import InputError, ResultError
from haselab.cli.common import emit
from haselab.cli.model.physical_model import has_physical_model
from haselab.cli.run_path import is_run
from haselab.pipelines.compare_results import ComparedRow, ResultsComparison, compare_results
from haselab.report.numbers import ABSENT, interval_text, number_text
from haselab.store.actuator_file import ACTUATOR
from haselab.store.session.opening import is_session

__all__ = ["RunPair", "compare_runs", "refuse_runs_without_model"]

_OWN = {"model", "files", "results", "as_json", "out", "force"}  # parameters of this form
_HEAD = ("id", "unit", "first", "second", "difference", "exceeds noise", "name")


@dataclass(frozen=True)
class RunPair:
    """What the user named, to find out whether it is two runs.

    Args:
        model: the first argument.
        files: the others.
    """

    model: Path
    files: tuple[Path, ...]

    def is_meant(self, context: click.Context) -> bool:
        """Whether to compare results although the user did not give `--results`.

        That is the case with two runs and no option of a prediction, if the first run has no
        physical model that could predict the second.

        Args:
            context: of the command, for the options that the user gave.
        """
        if not self.is_two_runs or _given(context):
            return False
        file = self.model / ACTUATOR
        return not (file.exists() and has_physical_model(file))

    @property
    def is_two_runs(self) -> bool:
        """Whether there are two folders with results or a recording."""
        return len(self.files) == 1 and all(is_run(one) for one in (self.model, self.files[0]))

    def compare(self, context: click.Context, *, as_json: bool, out: Path | None) -> None:
        """Compare the results of both runs, and print the comparison.

        Args:
            context: of the command, for the options that the user gave.
            as_json: print JSON.
            out: file of the answer; None: none.
        Raises:
            InputError: not two runs, or an option that only a prediction has.
            ResultError: some difference is larger than noise explains, or none can be judged.
        """
        if not self.is_two_runs:
            others = " ".join(map(str, self.files))
            raise InputError(
                f"--results compares the folders of two runs. Name two. {self.model} {others}"
            )
        given = _given(context)
        if given:
            raise InputError(
                f"{', '.join(given)} is for the prediction by a model, but --results compares the "
                "results of two runs. Leave it out."
            )
        compare_runs(self.model, self.files[0], as_json=as_json, out=out)


def compare_runs(first: Path, second: Path, *, as_json: bool, out: Path | None) -> None:
    """Compare the results of two runs, and print a table or JSON.

    Args:
        first: folder of a run.
        second: folder of another run.
        as_json: print JSON.
        out: file of the answer; None: none.
    Raises:
        InputError: a folder has no results that can be read.
        ResultError: some difference is larger than noise explains, or none can be judged.
    """
    found = compare_results(first, second)
    answer = {"first": str(first), "second": str(second), **found.to_dict()}
    lines = None if as_json else _lines(found, first, second)
    emit(answer, as_json=as_json, out=out, lines=lines)
    if found.status != "ok":
        raise ResultError(f"{found.status}. {first} {second}")


def refuse_runs_without_model(model: Path, files: Sequence[Path]) -> None:
    """Refuse to predict a run by a file without a physical model, with what to do instead.

    Args:
        model: of the linear model.
        files: to be predicted.
    Raises:
        InputError: one of them is a run or a session.
    """
    for file in files:
        if is_run(file) or (file.is_file() and is_session(file)):
            raise InputError(
                f"{file} is a run, which only a physical model predicts, but {model} has none. "
                "Identify it with: haselab identify actuator RUN --actuator A.toml. To compare the "
                "results of two runs, name both folders: haselab compare RUN RUN --results"
            )


def _given(context: click.Context) -> list[str]:
    """Options on the command line that only a prediction has."""
    return [
        max(parameter.opts, key=len)
        for parameter in context.command.params
        if parameter.name not in _OWN
        and isinstance(parameter, click.Option)
        and context.get_parameter_source(parameter.name or "") is ParameterSource.COMMANDLINE
    ]


def _lines(found: ResultsComparison, first: Path, second: Path) -> list[str]:
    both = [row for row in found.rows if row.first is not None and row.second is not None]
    lines = [f"first: {first}", f"second: {second}", ""]
    if both:
        lines += [*_table([_HEAD, *map(_cells, both)]), ""]
    for what, rows in (
        ("first", [row for row in found.rows if row.second is None]),
        ("second", [row for row in found.rows if row.first is None]),
    ):
        if rows:
            lines.append(f"Only in the {what} run:")
            lines += [f"  {row.id}  {row.name}" for row in rows] + [""]
    lines += [f"note: {note}" for note in found.notes]
    lines.append(
        f"{found.compared} differences have an interval. 0 is outside the 95 % interval of "
        f"{found.outside} of them; noise alone puts about {0.05 * found.compared:.0f} there."
    )
    lines.append(
        f"exceeds noise: 0 is outside the interval, and the difference is larger than "
        f"{found.limit_deviations:.1f} combined standard deviations."
    )
    return [*lines, f"status: {found.status}"]


def _cells(row: ComparedRow) -> tuple[str, ...]:
    values = [_measured(one) for one in (row.first, row.second)]
    if row.difference is None or row.difference_ci95 is None:
        return row.id, row.unit, *values, ABSENT, ABSENT, row.name
    if row.deviations is None:
        return row.id, row.unit, *values, number_text(row.difference), "no interval", row.name
    exceeds = "other settings" if row.exceeds is None else "yes" if row.exceeds else "no"
    std = abs(row.difference / row.deviations) if row.deviations else None
    low, high = row.difference_ci95
    text = " ".join(interval_text(row.difference, std or (high - low) / 4.0, (low, high)))
    return row.id, row.unit, *values, text, exceeds, row.name


def _measured(measured: Any) -> str:
    if measured["value"] is None:
        return ABSENT
    value, interval = interval_text(measured["value"], measured["std"], measured["ci95"])
    return f"{value} {interval}".removesuffix(f" {ABSENT}")


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]
