"""Real processes and real Dask, killed at random: the table has the same bits as without."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

_HANG_S = 300.0
MANY = 800  # cases: enough that some are still missing after twenty kills
# Cases of a tenth of a second or more, so that most kills hit one in work.
SLOW = """
name = "slow devices"
kind = "transfer"
seed = 7
[case]
duration_s = 60.0
[parameters]
case.natural_frequency_rad_s = {{ normal = [33.0, 3.0] }}
[design]
kind = "random"
samples = {samples}
"""


class Command:
    """`haselab campaign` as a process.

    Args:
        folder: with the campaign file, and for the results.
        name: of the folder of results.
        options: further ones.
    """

    def __init__(self, folder: Path, name: str, *options: str) -> None:
        self.out = folder / name
        line = [sys.executable, "-m", "haselab.cli", "campaign", str(folder / "campaign.toml"),
                "--out", str(self.out), "--json", *options]  # fmt: skip
        self.process = subprocess.Popen(
            line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )

    def shards(self) -> int:
        found = self.out.glob("shards/*.parquet")
        return sum(not path.name.startswith(".") for path in found)  # drafts are no shards

    def until_shards(self, count: int) -> bool:
        """Wait for a number of shards; False: the command has ended before."""
        end = time.monotonic() + _HANG_S
        while self.shards() < count and time.monotonic() < end:
            if self.process.poll() is not None:
                return False
            time.sleep(0.02)
        return True

    def workers(self) -> list[psutil.Process]:
        """Processes that compute cases."""
        found = []
        for child in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                if "spawn_main" in " ".join(child.cmdline()):
                    found.append(child)
        return found

    def end(self) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=_HANG_S)
        return self.process.returncode, out, err

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate(timeout=_HANG_S)


def finished(folder: Path, name: str, *options: str) -> dict[str, Any]:
    """Run the command to its end."""
    code, out, err = Command(folder, name, *options).end()
    assert (code, err) == (0, ""), err
    answer: dict[str, Any] = json.loads(out)
    return answer


def test_killed_workers_and_a_killed_program_change_no_bit(campaigns: Any) -> None:
    text = SLOW.format(samples=10)
    assert campaigns.run("undisturbed", text).done == 10
    first = Command(campaigns.folder, "out", "--workers", "2")
    assert first.until_shards(1)
    random.Random(1).choice(first.workers()).kill()
    assert first.until_shards(3)
    children = first.workers()
    first.kill()
    gone, alive = psutil.wait_procs(children, timeout=_HANG_S)
    assert gone and not alive  # without its program, a worker ends
    before = first.shards()
    found = finished(campaigns.folder, "out", "--workers", "2")
    assert before and found["computed"] < 10 and found["done"] == 10
    assert campaigns.table("out") == campaigns.table("undisturbed")


@pytest.mark.parametrize("options", [(), ("--scheduler", "local")])
def test_ctrl_c_says_what_is_kept_and_a_second_start_needs_only_the_rest(
    campaigns: Any, options: tuple[str, ...]
) -> None:
    text = SLOW.format(samples=6)
    campaigns.run("undisturbed", text)
    first = Command(campaigns.folder, "out", "--workers", "1", *options)
    assert first.until_shards(1)
    os.killpg(first.process.pid, signal.SIGINT)  # as a terminal does
    code, out, err = first.end()
    assert (code, out) == (130, "") and err.strip().count("\n") == 0
    assert "of 6 cases are finished and kept; the same command continues." in err
    kept = int(err.partition("Interrupted. ")[2].split()[0])
    assert 1 <= kept < 6
    assert not list((first.out / "claims").iterdir())
    found = finished(campaigns.folder, "out", "--workers", "1")
    assert found["computed"] == 6 - kept
    assert campaigns.table("out") == campaigns.table("undisturbed")


class Cluster:
    """A Dask scheduler with two workers on this computer."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._started = folder, 0
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> str:
        """Start it; the address."""
        self._started += 1
        file = self._folder / f"scheduler-{self._started}.json"
        self._begin(
            "scheduler", "--port", "0", "--host", "127.0.0.1", "--scheduler-file", str(file)
        )
        end = time.monotonic() + _HANG_S
        while not file.exists() and time.monotonic() < end:
            time.sleep(0.05)
        address = str(json.loads(file.read_text())["address"])
        self._begin("worker", address, "--nworkers", "2", "--nthreads", "1")
        return address

    def _begin(self, what: str, *options: str) -> None:
        line = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--no-dashboard", *options]
        self.processes.append(subprocess.Popen(
            line, cwd=self._folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ))  # fmt: skip

    def kill_scheduler(self) -> None:
        self.processes[-2].kill()

    def worker(self, rng: random.Random) -> psutil.Process | None:
        """One of the processes that compute."""
        found = []
        for child in psutil.Process(self.processes[-1].pid).children(recursive=True):
            with contextlib.suppress(psutil.Error):
                if "spawn_main" in " ".join(child.cmdline()):
                    found.append(child)
        return rng.choice(found) if found else None

    def end(self) -> None:
        for process in self.processes:
            with contextlib.suppress(psutil.Error):
                for child in psutil.Process(process.pid).children(recursive=True):
                    child.kill()
            process.kill()
            process.wait()
        self.processes.clear()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    made = Cluster(tmp_path)
    yield made
    made.end()


def test_a_scheduler_that_vanishes_ends_in_one_line_and_nothing_is_lost(
    campaigns: Any, cluster: Cluster
) -> None:
    text = SLOW.format(samples=10)
    campaigns.run("undisturbed", text)
    first = Command(campaigns.folder, "out", "--scheduler", cluster.start())
    assert first.until_shards(2)
    cluster.kill_scheduler()
    code, out, err = first.end()
    assert (code, out) == (4, "") and err.count("\n") == 1, err
    assert "The connection to the Dask scheduler at tcp://127.0.0.1:" in err
    kept = int(err.partition("then this command. ")[2].split()[0])
    assert 2 <= kept < 10
    found = finished(campaigns.folder, "out", "--workers", "1")
    assert found["computed"] == 10 - kept
    assert campaigns.table("out") == campaigns.table("undisturbed")


@pytest.mark.slow
def test_twenty_random_kills_of_worker_program_and_scheduler_change_no_bit(
    campaigns: Any, cluster: Cluster
) -> None:
    text = SLOW.format(samples=MANY)
    campaigns.run("undisturbed", text)
    rng, kills, address = random.Random(20), {"worker": 0, "program": 0, "scheduler": 0}, ""
    while sum(kills.values()) < 20:
        by_dask = rng.random() < 0.5
        if by_dask and not address:
            address = cluster.start()
        options = ("--scheduler", address) if by_dask else ("--workers", "2")
        run = Command(campaigns.folder, "out", *options)
        for _ in range(rng.randint(1, 3)):
            if not run.until_shards(run.shards() + 1) and run.process.returncode == 0:
                run.end()
                pytest.fail(f"all cases were finished after {kills}")
            time.sleep(rng.uniform(0.0, 0.5))
            what = rng.choice(
                ["worker", "program", "scheduler"] if by_dask else ["worker", "program"]
            )
            if what == "program":
                run.kill()
            elif what == "scheduler":
                cluster.kill_scheduler()
                assert run.end()[0] == 4
                cluster.end()
                address = ""
            else:
                victim = cluster.worker(rng) if by_dask else rng.choice([*run.workers(), None])
                if victim is None:
                    continue
                victim.kill()
            kills[what] += 1
            if run.process.poll() is not None:
                break
        if run.process.poll() is None:
            run.kill()
            kills["program"] += 1
    assert min(kills.values()) >= 3, kills
    found = finished(campaigns.folder, "out", "--workers", "2")
    assert 0 < found["computed"] < MANY and found["done"] == MANY
    assert campaigns.table("out") == campaigns.table("undisturbed")
