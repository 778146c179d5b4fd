"""What all commands share: --json, --out, --force and --debug, number types, and output."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import click

from haselab.base import Progress, SilentProgress, to_plain
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule, reserved
from haselab.cli.plot import PLOT
from haselab.cli.readable import readable
from haselab.cli.run_path import ACTUATOR_FILE
from haselab.store.folder import write_text

__all__ = [
    "INTEGER",
    "LIMIT",
    "POSITIVE",
    "REAL",
    "SEED",
    "WORKERS",
    "Real",
    "actuator_option",
    "answer_options",
    "emit",
    "progress_bar",
    "unverified_option",
    "waiting",
    "warn_unverified",
]

_LARGEST = 1e30
_SHORTEST_S = 10.0  # between two lines about one step
_LINES_IN_A_MINUTE = 6
F = TypeVar("F", bound=Callable[..., Any])


class Real(click.FloatRange):
    """A finite number of moderate size, within a range where one is given.

    `nan` passes every comparison of `click.FloatRange`, and powers of larger numbers overflow.
    """

    name = "number"
    unbounded = False  # inf is no limit

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number, or raise `BadParameter` if the value is not one."""
        number: float = super().convert(value, param, ctx)
        if not (abs(number) <= _LARGEST or (self.unbounded and number == math.inf)):
            self.fail(f"{number:g} is not a finite number of at most {_LARGEST:g}.", param, ctx)
        return number

    def _describe_range(self) -> str:
        """Describe the range for --help; click cannot describe a range without ends."""
        return "" if self.min is None and self.max is None else super()._describe_range()


class _Limit(Real):
    """A positive number, or `inf` for no limit."""

    unbounded = True


class _Integer(click.IntRange):
    """A whole number whose range is checked, with a better message, by the function it goes to.

    --help shows INTEGER; the help text of the option states the range.
    """

    name = "integer"

    def _describe_range(self) -> str:
        return ""


class _Seed(click.IntRange):
    """A seed. Its upper limit is so large that --help states the lower one only."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the seed, or raise `BadParameter` if the value is none."""
        number = int(click.INT.convert(value, param, ctx))
        if self.max is not None and number > self.max:
            self.fail(f"{number} is too large. Use at most {self.max}.", param, ctx)
        return int(super().convert(number, param, ctx))

    def _describe_range(self) -> str:
        return f"x>={self.min}"


REAL = Real()
LIMIT = _Limit(0.0, min_open=True)
POSITIVE = Real(0.0, min_open=True)
INTEGER = _Integer(-(10**9), 10**9)
SEED = _Seed(0, 2**63 - 1)
WORKERS = click.IntRange(1, 256)


def answer_options(
    rule: OutputRule | None = None,
    out_detail: str = "It is a JSON file. Default: none.",
    *,
    plot: bool = False,
    force_detail: str = "Without this option, the command refuses to run if the result exists.",
) -> Callable[[F], F]:
    """Add `--json`, `--out`, `--force` and `--debug` (passed on as `as_json`, `out`, `debug`).

    Args:
        rule: what the command does about existing results; None: `--out` must be new.
        out_detail: what the command writes to `--out`.
        plot: add `--plot` too (passed on as `plot`).
        force_detail: what `--force` does in particular; follows the common help text.
    Returns:
        The decorator.
    """
    rule = rule or OutputRule()
    if plot:
        rule = replace(rule, options=(*rule.options, "plot"))
    force_help = f"Move an existing result to NAME.previous-1. {force_detail}"

    def decorate(function: F) -> F:
        @click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
        @shared_option("--out", type=click.Path(path_type=Path), detail=out_detail)
        @click.option("--force", is_flag=True, help=force_help)
        @click.option("--debug", is_flag=True, help="Show the traceback of an error.")
        @functools.wraps(function)
        def wrapper(*args: Any, debug: bool = False, force: bool = False, **kwargs: Any) -> Any:
            del debug  # read by haselab.cli.main from the command line
            with reserved(rule, kwargs, force=force):
                return function(*args, **kwargs)

        return PLOT(wrapper) if plot else wrapper  # type: ignore[return-value]

    return decorate


def actuator_option(detail: str) -> Callable[[F], F]:
    """Add `--actuator`, passed on as `actuator`: a path, or None.

    Args:
        detail: which sections the command reads and writes.
    Returns:
        The decorator.
    """
    text = f"{detail} Default: none."
    return shared_option("--actuator", type=ACTUATOR_FILE, detail=text)


def unverified_option(function: F) -> F:
    """Add `--unverified` to a command that reads recordings."""
    text = "Read a recording whose checksums do not match, and mark the result as unverified."
    return click.option("--unverified", is_flag=True, help=text)(function)


def warn_unverified(doubt: str, path: Path) -> None:
    """Warn in one line that the numbers of a session are not verified, and why."""
    if doubt:
        click.echo(f"haselab: unverified numbers: {doubt}. File: {path}", err=True)


def emit(
    answer: Mapping[str, Any],
    *,
    as_json: bool,
    out: Path | None,
    shorter: Mapping[str, Any] | None = None,
    units: Mapping[str, str] | None = None,
    shown: Mapping[str, Any] | None = None,
    lines: Sequence[str] | None = None,
) -> None:
    """Print an answer (JSON or readable lines) and, if `out` is given, write its JSON there.

    Args:
        answer: all of it.
        as_json: print JSON.
        out: file of the JSON.
        shorter: what the readable lines have in place of long parts of the answer.
        units: by name, of numbers whose unit is neither in their name nor in the answer.
        shown: what the readable lines have in place of the whole answer.
        lines: printed in place of the readable lines of the answer.
    """
    text = json.dumps(to_plain(answer), indent=2)
    if out is not None:
        write_text(out, text + "\n")
    if as_json:
        click.echo(text)
    else:
        if lines is None:
            all_of_it = {**answer, **(shorter or {})}
            lines = readable(all_of_it if shown is None else shown, units)
        click.echo("\n".join(lines))


class _BarProgress:
    """A rich progress bar on stderr; of a step of unknown length, the time that it has taken."""

    def __init__(self, waits_for: str | None = None) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as RichProgress

        share = [TextColumn("{task.percentage:3.0f} %")] if waits_for is None else []
        left = [TimeRemainingColumn()] if waits_for is None else []
        self._bar = RichProgress(
            TextColumn("{task.description:40.40s}"),
            BarColumn(),
            *share,
            TimeElapsedColumn(),
            *left,
            console=Console(stderr=True),
            transient=True,
        )
        self._task = self._bar.add_task(waits_for or "", total=None)

    def begin(self) -> None:
        """Show the bar until `stop`."""
        self._bar.start()

    def stage(self, what: str) -> None:
        """Name the present stage of the step."""
        self._bar.update(self._task, description=what)

    def start(self, total: float) -> None:
        """Show the bar for a job of `total` units."""
        self._bar.update(self._task, total=total)
        self._bar.start()

    def advance(self, amount: float, what: str) -> None:
        """Move the bar."""
        self._bar.update(self._task, advance=amount, description=what)
        if self._bar.finished:
            self._bar.stop()

    def stop(self) -> None:
        """Remove the bar, whatever its state."""
        self._bar.stop()


def progress_bar() -> Progress:
    """A progress bar if stderr is a terminal but not that of a notebook, silence otherwise.

    Commands after ! in a notebook also get a terminal, but the notebook shows each state of the bar
    as a separate line. Jupyter sets JPY_PARENT_PID in each kernel.
    """
    return _BarProgress() if _is_watched() else SilentProgress()


def _is_watched() -> bool:
    return sys.stderr.isatty() and "JPY_PARENT_PID" not in os.environ


class _Lines:
    """Lines on stderr about a step of unknown length: none before 10 s, then seldom."""

    def __init__(self, what: str) -> None:
        self._what = self._stage = self._said = what
        self._began_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def begin(self) -> None:
        """Begin to watch the time."""
        self._thread.start()

    def stage(self, what: str) -> None:
        """Name the present stage in the lines that follow."""
        self._stage = what

    def stop(self) -> None:
        """Print nothing more."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        """Print a line when the stage is another one, and at least once a minute."""
        silent = _LINES_IN_A_MINUTE  # the first line comes at once
        while not self._ended.wait(_SHORTEST_S):
            silent += 1
            if self._stage != self._said or silent >= _LINES_IN_A_MINUTE:
                taken_s = time.monotonic() - self._began_s
                said = "" if self._stage == self._what else f": {self._stage}"
                with suppress(OSError, ValueError):  # stderr is closed: the step goes on
                    click.echo(f"haselab: {self._what}{said} ({taken_s:.0f} s so far)", err=True)
                self._said, silent = self._stage, 0


@contextmanager
def waiting(what: str) -> Iterator[Callable[[str], None]]:
    """Show that a step of unknown length goes on.

    Where `progress_bar` shows a bar, this shows one too. Elsewhere, such as with stderr in a file,
    a step of more than 10 s prints a line at most every 10 s: when a stage has begun, and at least
    once a minute.

    Args:
        what: names the step.
    Yields:
        A function to call with the name of each stage of the step.
    """
    shown: _BarProgress | _Lines = _BarProgress(what) if _is_watched() else _Lines(what)
    shown.begin()
    try:
        yield shown.stage
    finally:
        shown.stop()
