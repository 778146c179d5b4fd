"""Compute cases by Dask: on the workers of a scheduler, or of a local cluster.

Dask only computes. The program that submitted the cases writes what Dask returns. If a scheduler or
a worker is lost, only the cases that were being computed are lost.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import threading
from collections.abc import Sequence
from typing import Any

from haselab.base import DeviceError, HaselabError, InputError, text_of
from haselab.campaign.executors.executor import Chunk, Outcome
from haselab.campaign.executors.processes import ProcessExecutor
from haselab.campaign.plan import Job, Problem
from haselab.campaign.work import compute_cases
from haselab.runtime.scheduling import one_thread
from haselab.store.campaign.shards import CaseRow
from haselab.store.optional import library

__all__ = ["LOCAL", "DaskExecutor"]

LOCAL = "local"  # in place of an address
_EXTRA = "dask"
_CONNECT_S = 20.0
_LEAST_SLOTS = 1  # while workers are still coming, so that an adaptive cluster sees work
_GRACE_S = 5.0
# Of a local cluster, whose scheduler and workers share the cores with the cases: no sampling of
# Python stacks, and fewer looks at memory and load. With Dask's own values, two workers took 2 %
# more processor time for 2,500 cases of 7 ms (Dask 2026.8).
# A worker returns memory to the system when it can spare 256 MB; at Dask's 64 kB, each case of 4 ms
# fetches 100 pages again (2 otherwise), which costs up to 10 % of its time.
_LOCAL_CONFIG = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "2s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**28,
    # Ctrl-C reaches all programs of a terminal; only the one that started the cluster handles it.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
}


def _start_method() -> dict[str, str]:
    """Setting that starts workers as copies of one process with all imports, where possible."""
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return {}
    method = {"distributed.worker.multiprocessing-method": "forkserver"}
    with library("dask", _EXTRA).config.set(method):
        library("distributed.utils", _EXTRA).get_mp_context()  # its first call sets other imports
    multiprocessing.set_forkserver_preload(["distributed", compute_cases.__module__])
    return method


def _silence() -> None:
    """Suppress what Dask prints on a lost connection, which this program reports in one line."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)


# ---- on a worker -------------------------------------------------------------------------------

# A thread of a Dask worker cannot be killed. With a time limit, each thread therefore has a process
# for each campaign, which computes its cases and is kept for the next chunks.
_limited: dict[int, list[tuple[Problem, float, ProcessExecutor]]] = {}
_changing = threading.Lock()


def _compute_limited(problem: Problem, jobs: Sequence[Job], limit_s: float) -> list[CaseRow]:
    """Compute cases in another process; cases without a row have to be computed again."""
    executor = _limited_executor(problem, limit_s)
    while True:
        executor.submit(Chunk(0, tuple(jobs)))
        while not (outcomes := executor.wait(1.0)):
            pass
        outcome = outcomes[0]
        if outcome.rows is not None:
            return outcome.rows
        if outcome.blamed:  # else the process had not yet started; too many of these raise
            raise RuntimeError("the process ended while it computed these cases")


def _limited_executor(problem: Problem, limit_s: float) -> ProcessExecutor:
    """The executor of this thread for a campaign, with one process."""
    with _changing:
        own = _limited.setdefault(threading.get_ident(), [])
        for *what, executor in own:
            if what == [problem, limit_s]:
                return executor
        # Dask marks its workers as daemons, which Python does not let start processes.
        multiprocessing.current_process().daemon = False
        executor = ProcessExecutor(problem, 1, limit_s)
        own.append((problem, limit_s, executor))
        return executor


def _end_limited(problem: Problem) -> None:
    """End the processes of all threads of a worker that compute these cases."""
    with _changing:
        for own in _limited.values():
            for ended in [one for one in own if one[0] == problem]:
                own.remove(ended)
                ended[2].close()


# ---- in the program ----------------------------------------------------------------------------


class DaskExecutor:
    """An executor of Dask tasks.

    Args:
        problem: what all cases share.
        address: of the scheduler; `local`: start a cluster on this computer.
        workers: processes of a local cluster.
        limit_s: time of a case, after which it is stopped; None: no limit.
    Raises:
        InputError: Dask is not installed, or there is no scheduler at the address.
        DeviceError: the local cluster does not start.
    """

    def __init__(
        self, problem: Problem, address: str, workers: int, limit_s: float | None = None
    ) -> None:
        distributed = library("distributed", _EXTRA)
        _silence()
        self._problem, self._address, self._limit_s = problem, address, limit_s
        self._cluster: Any = None
        try:
            if address == LOCAL:
                config = library("dask", _EXTRA).config
                with config.set({**_LOCAL_CONFIG, **_start_method()}), one_thread():
                    # Without a host, Dask would serve its status page to the whole network.
                    self._cluster = distributed.LocalCluster(
                        n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0",
                        silence_logs=logging.CRITICAL,
                    )  # fmt: skip
            self._client = distributed.Client(
                self._cluster or address, timeout=_CONNECT_S, set_as_default=False
            )
        except (OSError, ValueError, RuntimeError) as error:
            self._close_cluster()
            if address == LOCAL:
                raise DeviceError(
                    f"Dask could not start its workers on this computer ({text_of(error)}). Run "
                    "the campaign without --scheduler, by processes."
                ) from None
            raise InputError(
                f"No Dask scheduler answers at {address} ({text_of(error)}). Start one with 'dask "
                "scheduler', or check the address."
            ) from None
        self._futures: dict[Any, Chunk] = {}
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._slots = max(len(self._threads()), _LEAST_SLOTS)

    def _threads(self) -> list[str]:
        counts = self._client.nthreads()
        return [name for name, count in counts.items() for _ in range(count)]

    @property
    def workers(self) -> int:
        """Threads of all workers."""
        return self._slots

    def submit(self, chunk: Chunk) -> None:
        """Submit a chunk as one task.

        Raises:
            DeviceError: the scheduler has gone.
        """
        limited = self._limit_s is not None
        try:
            future = self._client.submit(
                _compute_limited if limited else compute_cases, self._problem, chunk.jobs,
                *([self._limit_s] if limited else []), pure=False,
                key=f"haselab-{os.getpid()}-{id(self)}-{chunk.number}",
            )  # fmt: skip
        except Exception as error:  # Dask raises many kinds when the connection closes
            raise self._gone() from error
        self._futures[future] = chunk
        future.add_done_callback(self._ended.put)

    def wait(self, longest_s: float) -> list[Outcome]:
        """Wait for outcomes.

        Raises:
            DeviceError: the scheduler has gone, or a worker cannot compute any case.
        """
        try:
            futures = [self._ended.get(timeout=longest_s)]
        except queue.Empty:
            futures = []
        while not self._ended.empty():
            futures.append(self._ended.get())
        if self._client.status != "running":
            raise self._gone()
        if not futures:
            self._count_workers()
        return [self._outcome(future) for future in futures]

    def _count_workers(self) -> None:
        try:
            self._slots = max(len(self._threads()), _LEAST_SLOTS)
        except Exception as error:
            raise self._gone() from error

    def _outcome(self, future: Any) -> Outcome:
        chunk = self._futures.pop(future)
        if future.status == "finished":
            return Outcome(chunk, self._result(future))
        if future.status == "error":
            error = future.exception()
            if isinstance(error, HaselabError):
                raise error
            return Outcome(chunk, None)
        if self._client.status != "running":
            raise self._gone()
        return Outcome(chunk, None, blamed=False)

    def _result(self, future: Any) -> Any:
        try:
            return future.result(timeout=_CONNECT_S)
        except Exception as error:  # Dask raises many kinds when the connection closes
            raise self._gone() from error

    def _gone(self) -> DeviceError:
        return DeviceError(
            f"The connection to the Dask scheduler at {self._address} is lost. Start it again, "
            "then this command."
        )

    def longest(self) -> None:
        """Not known: the cases run on other computers."""

    def close(self) -> None:
        """Give up what is in work, and leave the scheduler; a local cluster ends."""
        try:
            if self._client.status == "running":
                self._client.cancel(list(self._futures))
                if self._limit_s is not None:
                    with contextlib.suppress(Exception):  # a worker that does not answer in time
                        self._client.run(
                            _end_limited, self._problem, on_error="ignore",
                            callback_timeout=_GRACE_S,
                        )  # fmt: skip
            self._client.close(timeout=_GRACE_S)
        except Exception:  # the scheduler is gone; what counts is in the folder
            pass
        self._close_cluster()

    def _close_cluster(self) -> None:
        if self._cluster is not None:
            self._cluster.close(timeout=_GRACE_S)
