"""A case that never ends fails after the time limit; the others are computed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from haselab.base import SilentProgress
from haselab.campaign.definition import load_campaign
from haselab.campaign.executors import dask
from haselab.campaign.executors.executor import Chunk, Outcome
from haselab.campaign.executors.processes import ProcessExecutor
from haselab.campaign.folder import finished_rows, open_folder
from haselab.campaign.kinds.case_kind import CASE_KINDS
from haselab.campaign.plan import Plan
from haselab.campaign.run import run_cases
from haselab.campaign.work import compute_cases
from haselab.store.campaign.shards import CaseRow

KIND = '''
"""A kind whose third case hangs in compiled code, which no exception and no thread interrupts."""
import re

from haselab.campaign import CaseKind
from haselab.store.toml import Section


class Settings(Section):
    number: int = 0


class Hangs(CaseKind):
    name, files, settings = "hangs", (), Settings

    def check(self, inputs):
        inputs.settings(Settings)

    def compute(self, inputs, rng):
        number = inputs.settings(Settings).number
        if number == 2:
            re.match("(a+)+$", 64 * "a" + "b")
        return {"number": float(number)}


HANGS = Hangs()
'''
CAMPAIGN = """
name = "hangs"
kind = "hangs"
time_limit_s = 5.0
[parameters]
case.number = [0, 1, 2, 3, 4]
"""
ERROR = "The case was stopped because it took longer than time_limit_s = 5."


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Plan]:
    package = tmp_path / "package"
    about = package / "hangs-1.0.dist-info"
    about.mkdir(parents=True)
    (package / "hangs.py").write_text(KIND)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: hangs\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[haselab.cases]\nhangs = hangs:HANGS\n")
    monkeypatch.syspath_prepend(package)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    CASE_KINDS.others.cache_clear()
    yield Plan(load_campaign(tmp_path / "campaign.toml"))
    CASE_KINDS.others.cache_clear()


def test_a_case_that_hangs_fails_and_its_process_is_replaced(plan: Plan, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    open_folder(plan, folder)
    limit_s = plan.campaign.time_limit_s
    found = run_cases(
        plan, folder, lambda problem, count: ProcessExecutor(problem, 1, limit_s), SilentProgress()
    )
    assert (found.done, found.failed) == (4, 1)
    rows = finished_rows(plan, folder)
    assert [row.index for row in rows if row.error] == [2]
    assert rows[2].error.startswith(ERROR) and rows[2].compute_s >= limit_s
    assert [row.results.get("number") for row in rows] == [0.0, 1.0, None, 3.0, 4.0]


def test_the_process_of_a_dask_worker_ends_only_the_case_that_hangs(plan: Plan) -> None:
    jobs = [plan.job(index, f"{index}") for index in range(5)]
    try:
        rows = dask._compute_limited(plan.problem, jobs, 5.0)
        assert [(row.index, row.error[: len(ERROR)]) for row in rows] == [(2, ERROR)]
        others = [job for job in jobs if job.index != 2]  # the program submits them again
        again = dask._compute_limited(plan.problem, others, 5.0)
        assert [(row.index, row.error) for row in again] == [(0, ""), (1, ""), (3, ""), (4, "")]
    finally:
        dask._end_limited(plan.problem)
    assert not any(dask._limited.values())


def test_two_campaigns_on_one_thread_keep_their_processes(plan: Plan) -> None:
    other = replace(plan.problem, seed=plan.problem.seed + 1)
    try:
        first, second = (dask._limited_executor(one, 5.0) for one in (plan.problem, other))
        assert first is not second
        assert dask._limited_executor(plan.problem, 5.0) is first
        assert dask._limited_executor(other, 5.0) is second
        dask._end_limited(other)
        assert dask._limited_executor(plan.problem, 5.0) is first
    finally:
        for one in (plan.problem, other):
            dask._end_limited(one)
    assert not any(dask._limited.values())


@pytest.mark.long
def test_on_a_dask_cluster_a_case_that_hangs_fails_and_no_process_is_left(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cluster lives on, so that its workers would keep the processes of the campaign."""
    import distributed
    import psutil

    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "package"))  # for the workers
    folder = tmp_path / "out"
    open_folder(plan, folder)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0"
    ) as cluster:
        (worker,) = cluster.workers.values()

        def computing() -> list[str]:
            children = psutil.Process(worker.pid).children(recursive=True)
            return [
                line for one in children if "resource_tracker" not in (line := str(one.cmdline()))
            ]

        seen: list[int] = []

        class Watched(dask.DaskExecutor):
            def wait(self, longest_s: float) -> list[Outcome]:
                seen.append(len(computing()))
                return super().wait(longest_s)

        found = run_cases(
            plan, folder,
            lambda problem, count: Watched(problem, cluster.scheduler_address, 1, 5.0),
            SilentProgress(),
        )  # fmt: skip
        assert max(seen) == 1 and computing() == []
    assert (found.done, found.failed) == (4, 1)
    rows = finished_rows(plan, folder)
    assert [row.results.get("number") for row in rows] == [0.0, 1.0, None, 3.0, 4.0]
    assert rows[2].error.startswith(ERROR)


def test_cases_without_a_row_are_computed_again(campaigns: Any, tmp_path: Path) -> None:
    class Partial(campaigns.executor):  # type: ignore[misc]
        def wait(self, longest_s: float) -> list[Outcome]:
            chunk: Chunk = self._chunks.popleft()
            rows: list[CaseRow] = compute_cases(self._problem, chunk.jobs)
            return [Outcome(chunk, rows[: len(rows) // 2])] if len(rows) > 1 else [
                Outcome(chunk, rows)
            ]  # fmt: skip

    campaigns.run("undisturbed", workers=1)
    plan = campaigns.plan()
    open_folder(plan, tmp_path / "partial")
    found = run_cases(
        plan, tmp_path / "partial", lambda problem, count: Partial(problem, 1), SilentProgress()
    )
    assert found.done == found.computed == found.cases
    results = [finished_rows(plan, tmp_path / name) for name in ("undisturbed", "partial")]
    assert [row.results for row in results[0]] == [row.results for row in results[1]]


def test_the_limit_can_change_between_two_runs(campaigns: Any) -> None:
    text = campaigns.quick.replace("seed = 7", "seed = 7\ntime_limit_s = 50.0")
    campaigns.run("limit", text)
    assert campaigns.run("limit", text.replace("50.0", "60.0")).computed == 0
    assert load_campaign(campaigns.file()).time_limit_s is None


def test_a_stop_names_a_case_that_may_never_end(campaigns: Any, tmp_path: Path) -> None:
    class Stopped(campaigns.executor):  # type: ignore[misc]
        def longest(self) -> Any:
            return self._chunks[0].jobs[0], self.running_s

        def wait(self, longest_s: float) -> list[Outcome]:
            raise KeyboardInterrupt

    plan = campaigns.plan()
    open_folder(plan, tmp_path / "stopped")
    for running_s, named in ((29.0, False), (31.0, True)):
        Stopped.running_s = running_s
        with pytest.raises(KeyboardInterrupt) as caught:
            run_cases(plan, tmp_path / "stopped", lambda problem, count: Stopped(problem, 1),
                      SilentProgress())  # fmt: skip
        assert ("Case 0 had been running for 31 s" in caught.value.__notes__[0]) == named
