"""One benchmark in its own process: its rows, its CPU time, and what remains when it fails."""

import contextlib
import importlib
import math
import multiprocessing
import os
import resource
import signal
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from benchmarks.rows import Row

__all__ = ["Measured", "Measurement"]

_CLEAN_UP_S = 20.0


@dataclass
class Measured:
    """What one benchmark gave.

    Args:
        rows: until it was over, and one more if it failed or was ended.
        cpu_s: CPU time in s; 0 if it was not over.
        failed: whether its process failed.
    """

    rows: list[Row] = field(default_factory=list)
    cpu_s: float = 0.0
    failed: bool = False


@dataclass(frozen=True)
class Measurement:
    """A module of this folder whose function `rows` measures.

    Args:
        module: below `benchmarks`.
        quick: arguments of `rows` in the default run; None: it measures only with `--full`.
        full: arguments of `rows` with `--full`.
    """

    module: str
    quick: Mapping[str, Any] | None = field(default_factory=dict)
    full: Mapping[str, Any] = field(default_factory=dict)

    def run(self, full: bool, most_s: float = math.inf) -> Measured:
        """Print each row as soon as it is known.

        Its own process keeps one benchmark's threads, memory and failure away from the next one.

        Args:
            full: measure all cases.
            most_s: the benchmark is ended after this time, in s.
        Returns:
            The rows.
        """
        found = Measured()
        if most_s <= 0.0:
            found.rows.append(self._row("not started, out of time", math.nan))
            return found
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        arguments = (self.module, dict((self.full if full else self.quick) or {}), sender)
        process = context.Process(target=_measure, args=arguments)
        process.start()
        sender.close()
        try:
            over = _receive(receiver, found, most_s)
        except BaseException:
            _end(process)
            raise
        if over:
            process.join()
        else:
            _end(process)
            found.rows.append(self._row(f"ended after {most_s:.0f} s", math.nan))
        found.failed = over and process.exitcode != 0
        if found.failed:
            found.rows.append(self._row("exit code", process.exitcode or 0))
        return found

    def _row(self, what: str, value: float) -> Row:
        """A row about the benchmark itself; NaN: not measured."""
        row = Row(f"{self.module}: {what}", value, "", 0.0, False)
        print(row, flush=True)
        return row


def _receive(receiver: Connection, found: Measured, most_s: float) -> bool:
    """Collect what the process sends; whether it came to its end, good or bad, in time."""
    end_s = time.monotonic() + most_s
    while receiver.poll(None if math.isinf(most_s) else max(0.0, end_s - time.monotonic())):
        try:
            answer = receiver.recv()
        except EOFError:
            return True
        if not isinstance(answer, Row):
            found.cpu_s = answer
            return True
        found.rows.append(answer)
    return False


def _end(process: BaseProcess) -> None:
    """Ctrl-C, so that it removes its files; then kill it with all its processes."""
    assert process.pid is not None
    if process.is_alive():
        os.kill(process.pid, signal.SIGINT)
        process.join(_CLEAN_UP_S)
    process.kill()
    with contextlib.suppress(ProcessLookupError):  # it had no group yet, or nothing is left
        os.killpg(process.pid, signal.SIGKILL)
    process.join()


def _measure(module: str, sizes: dict[str, Any], sender: Connection) -> None:
    os.setsid()  # its processes are ended together
    for row in importlib.import_module(f"benchmarks.{module}").rows(**sizes):
        print(row, flush=True)
        sender.send(row)
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    sender.send(sum(one.ru_utime + one.ru_stime for one in used))
