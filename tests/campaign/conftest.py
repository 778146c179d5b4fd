"""A small campaign of quick cases, and an executor that computes them in this process."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import SilentProgress
from haselab.campaign.definition import load_campaign
from haselab.campaign.executors.executor import Chunk, Outcome
from haselab.campaign.folder import TABLE, finished_rows, open_folder, write_table
from haselab.campaign.plan import Plan, Problem
from haselab.campaign.run import Progressed, run_cases
from haselab.campaign.work import compute_cases
from haselab.store.campaign.shards import CaseRow

QUICK = """
name = "quick devices"
kind = "transfer"
seed = 7

[case]
duration_s = 1.0
rate_hz = 100.0

[parameters]
case.noise_std = [0.01, 0.02]
case.natural_frequency_rad_s = { normal = [33.0, 3.0] }
case.gain = { uniform = [0.4, 0.6] }

[design]
kind = "sobol"
samples = 8
"""


class InThisProcess:
    """Computes chunks here, in a random order.

    Args:
        problem: what all cases share.
        workers: that it says it has.
        seed: of the order.
        lost: called with each chunk; True: the worker that has it ends.
    """

    def __init__(
        self,
        problem: Problem,
        workers: int = 2,
        seed: int = 0,
        lost: Callable[[Chunk], bool] = lambda chunk: False,
    ) -> None:
        self._problem, self.workers = problem, workers
        self._rng, self._lost = np.random.default_rng(seed), lost
        self._chunks: deque[Chunk] = deque()

    def submit(self, chunk: Chunk) -> None:
        self._chunks.append(chunk)

    def wait(self, longest_s: float) -> list[Outcome]:
        self._chunks.rotate(int(self._rng.integers(len(self._chunks))))
        chunk = self._chunks.popleft()
        if self._lost(chunk):
            return [Outcome(chunk, None)]
        return [Outcome(chunk, compute_cases(self._problem, chunk.jobs))]

    def longest(self) -> None:
        pass

    def close(self) -> None:
        self._chunks.clear()


class Campaigns:
    """Writes campaign files into a folder, and runs them.

    Args:
        folder: for all files.
    """

    quick = QUICK
    executor = InThisProcess

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def file(self, text: str = QUICK) -> Path:
        path = self.folder / "campaign.toml"
        path.write_text(text)
        return path

    def plan(self, text: str = QUICK) -> Plan:
        return Plan(load_campaign(self.file(text)))

    def rows_of(self, plan: Plan, function: Callable[..., float]) -> list[CaseRow]:
        """Rows whose result `y` is a function of the parameters."""
        return [
            CaseRow(f"{k}", k, plan.values(k), {"y": float(function(*plan.values(k).values()))})
            for k in range(plan.count)
        ]

    def run(
        self, name: str, text: str = QUICK, *, retry: bool = False, **settings: Any
    ) -> Progressed:
        """Compute what is missing in a folder, and write its table if it is complete."""
        plan, out = self.plan(text), self.folder / name
        open_folder(plan, out)
        found = run_cases(
            plan, out, lambda problem, count: InThisProcess(problem, **settings), SilentProgress(),
            retry_failed=retry,
        )  # fmt: skip
        if found.is_complete:
            write_table(plan, finished_rows(plan, out), out)
        return found

    def table(self, name: str) -> bytes:
        return (self.folder / name / TABLE).read_bytes()

    def columns(self, name: str) -> Mapping[str, list[Any]]:
        import pyarrow.parquet

        return pyarrow.parquet.read_table(self.folder / name / TABLE).to_pydict()


@pytest.fixture
def campaigns(tmp_path: Path) -> Campaigns:
    return Campaigns(tmp_path)
