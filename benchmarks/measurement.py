"""One benchmark in its own process: its rows, its CPU time, and what remains when it fails."""

import importlib
import multiprocessing
import resource
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.rows import Row

__all__ = ["Measurement"]


@dataclass(frozen=True)
class Measurement:
    """A module of this folder whose function `rows` measures.

    Args:
        module: below `benchmarks`.
        quick: arguments of `rows` in the default run.
        full: arguments of `rows` with `--full`.
    """

    module: str
    quick: Mapping[str, Any] = field(default_factory=dict)
    full: Mapping[str, Any] = field(default_factory=dict)

    def run(self, full: bool) -> tuple[list[Row], float]:
        """Print each row as soon as it is known.

        Its own process keeps one benchmark's threads, memory and failure away from the next one.

        Returns:
            The rows, with a missed one more if the process failed, and the CPU time in s.
        """
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        arguments = (self.module, dict(self.full if full else self.quick), sender)
        process = context.Process(target=_measure, args=arguments)
        process.start()
        sender.close()
        rows: list[Row] = []
        cpu_s = 0.0
        try:
            while isinstance(answer := receiver.recv(), Row):
                rows.append(answer)
            cpu_s = answer
        except EOFError:
            pass
        process.join()
        if process.exitcode:
            rows.append(Row(f"exit code of {self.module}", process.exitcode, "", 0.0, False))
            print(rows[-1], flush=True)
        return rows, cpu_s


def _measure(module: str, sizes: dict[str, Any], sender: Connection) -> None:
    for row in importlib.import_module(f"benchmarks.{module}").rows(**sizes):
        print(row, flush=True)
        sender.send(row)
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    sender.send(sum(one.ru_utime + one.ru_stime for one in used))
