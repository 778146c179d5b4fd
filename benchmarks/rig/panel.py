"""The panel on the twin: STOP, latency of the traces, and the processor time that it uses.

`python -m benchmarks.rig.panel [--presses 100] [--seconds 10] [--armed-presses 20]`

The pages are clients without a browser, in this process, on the same computer. A press of STOP is
timed from before its request is sent until the permission is revoked, and until the answer has
arrived that 0 V was commanded; both include the connection. The answer waits for the end of a
running call of a driver: during a study, the twin computes in it. STOP is pressed on an idle bench,
on one that is armed and driving, and while a study is played. The age of a block is from the moment
at which the bench process has written the newest block of a frame until a page has received that
frame. Frames are sent 30 times a second, so a block waits for up to 33 ms more; drawing is not part
of it either.
"""

import argparse
import asyncio
import contextlib
import http.client
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import websockets

from benchmarks.rows import Row

TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
PAGES = 8
STUDY = {"study": "reference study", "experiments": ["triangle"], "keep_video": "none"}


@contextlib.contextmanager
def panel(
    *words: str, folder: Path | None = None
) -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """A panel, on the twin unless its further words name a rig: its process, host and token."""
    with tempfile.TemporaryDirectory() as runs:
        command = [sys.executable, "-m", "haselab.cli", "panel", "--no-browser", *words]
        command += ["--runs", str(folder or runs)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder)
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        try:
            yield process, address.split("/")[2], address.partition("token=")[2]
        finally:
            process.terminate()
            process.wait()


class Page:
    """A connected page that acknowledges each frame and notes the age of its last block."""

    def __init__(self, socket: websockets.ClientConnection, ages_s: list[float]) -> None:
        self._socket, self._ages_s = socket, ages_s
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._framed, self._number = asyncio.Event(), 0
        self.state: dict[str, Any] = {}
        self._clock_s = 0.0  # of the bench process, for commands

    async def receive(self) -> None:
        """Receive frames and answers until it is cancelled."""
        while True:
            message = await self._socket.recv()
            if isinstance(message, str):
                answer = json.loads(message)
                if "id" in answer:
                    self._answers.pop(answer["id"]).set_result(answer)
                continue
            size = int.from_bytes(message[40:44], "little")
            about = json.loads(message[48 : 48 + size])
            if about["written_s"] is not None:
                self._ages_s.append(time.monotonic() - about["written_s"])
            await self._socket.send(json.dumps({"ack": int.from_bytes(message[4:8], "little")}))
            self.state, self._clock_s = about["state"], about["clock_s"]
            self._framed.set()

    async def ask(self, what: str, **values: object) -> dict[str, Any]:
        """Send a command and return its answer."""
        await self.until(lambda state: True)  # a page shows no button before its first frame
        self._number += 1
        number = self._number
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        command = {"id": number, "do": what, "values": values, "at_s": self._clock_s}
        await self._socket.send(json.dumps(command))
        found = await answer
        if "error" in found:
            raise RuntimeError(found["error"])
        return dict(found["answer"])

    async def arm(self, **values: object) -> None:
        """Arm the bench for up to 2 V, and acknowledge why it was stopped."""
        found = await self.ask("request")
        known = {"number": found["number"], "acknowledged": found["reason"]}
        await self.ask("arm", limit_v=2.0, **known, **values)

    async def until(self, ready: Callable[[dict[str, Any]], bool], within_s: float = 60.0) -> None:
        """Wait for a state of the bench."""
        try:
            async with asyncio.timeout(within_s):
                while not (self.state and ready(self.state)):
                    self._framed.clear()
                    await self._framed.wait()
        except TimeoutError:
            raise RuntimeError(f"The bench did not get there: {self.state['reason']}") from None


@contextlib.asynccontextmanager
async def page(host: str, token: str, ages_s: list[float]) -> AsyncIterator[Page]:
    """Connect a page."""
    async with websockets.connect(f"ws://{host}/live", origin=f"http://{host}") as socket:  # type: ignore[arg-type]
        await socket.send(json.dumps({"token": token}))
        await socket.recv()
        found = Page(socket, ages_s)
        receiver = asyncio.create_task(found.receive())
        try:
            yield found
        finally:
            receiver.cancel()


def cpu_s(process: int) -> float:
    """Processor time that a process has used, in s."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory_mb(process: int) -> float:
    """Resident memory of a process in MB, without files and without the columns that it shares.

    The space of the columns is reserved at the start. It counts as resident once it has been read,
    so that it would grow for the 20 minutes after which it is overwritten.
    """
    resident, shared = map(int, Path(f"/proc/{process}/statm").read_text().split()[1:3])
    return (resident - shared) * os.sysconf("SC_PAGE_SIZE") / 1e6


def child(process: int, name: str) -> int:
    """Process number of a child by its module."""
    words = ["ps", "-o", "pid=,args=", "--ppid", str(process)]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    return next(int(line.split()[0]) for line in listed.splitlines() if name in line)


def stop_port(host: str) -> int:
    """Port of the stop process."""
    about = http.client.HTTPConnection(host)
    about.request("GET", "/about")
    return int(json.loads(about.getresponse().read())["stop_port"])


class Pressed(NamedTuple):
    """A press of STOP: times in s until the permission was revoked and until the answer."""

    revoked_s: float
    answered_s: float
    commanded: bool


def press(host: str, port: int) -> Pressed:
    """Press STOP."""
    begun_s = time.perf_counter()
    stop = http.client.HTTPConnection("127.0.0.1", port)
    stop.request("POST", "/stop", headers={"Origin": f"http://{host}"})
    answer = json.loads(stop.getresponse().read())
    answered_s = time.perf_counter() - begun_s
    stop.close()
    # The way of the answer is counted as well.
    revoked_s = answered_s - 1e-3 * (answer["commanded_ms"] - answer["revoked_ms"])
    return Pressed(revoked_s, answered_s, answer["commanded"])


class Measured(NamedTuple):
    """What was measured with a number of pages.

    Args:
        ages_s: of blocks at the pages.
        server: share of a core of the web server.
        bench: share of a core of the bench process.
        growth: of the web server's memory, relative.
        idle: presses of STOP on an idle bench.
        driving: while it drives.
        study: while it plays a study.
    """

    ages_s: list[float]
    server: float
    bench: float
    growth: float
    idle: list[Pressed]
    driving: list[Pressed]
    study: list[Pressed]


async def measured(
    process: int, host: str, token: str, pages: int, seconds: float, count: int, armed: int
) -> Measured:
    """Measure a panel with some pages."""
    ages_s: list[float] = []
    bench, port = child(process, "bench_process"), stop_port(host)
    async with contextlib.AsyncExitStack() as opened:
        first, *_ = [
            await opened.enter_async_context(page(host, token, ages_s)) for _ in range(pages)
        ]
        await asyncio.sleep(2.0)
        ages_s.clear()
        used_s, grown_mb, begun_s = (
            (cpu_s(process), cpu_s(bench)),
            memory_mb(process),
            time.monotonic(),
        )
        await asyncio.sleep(seconds)
        duration_s = time.monotonic() - begun_s
        server, worker = (
            (cpu_s(one) - before) / duration_s
            for one, before in zip((process, bench), used_s, strict=True)
        )
        growth, seen_s = memory_mb(process) / grown_mb - 1.0, list(ages_s)

        async def stopped() -> Pressed:
            await asyncio.sleep(0.05 * random.random())  # at any moment of a block and a frame
            return await asyncio.to_thread(press, host, port)

        idle, driving, study = [await stopped() for _ in range(count)], [], []
        for _ in range(armed):
            await first.arm()
            await first.ask("drive", value_v=1.0)
            await first.until(lambda state: state["drive_v"] > 0.1)
            driving.append(await stopped())
            await first.until(lambda state: not state["holder"])
        for _ in range(armed):
            await first.arm(study=STUDY)
            await first.until(lambda state: state["drive_v"] > 0.1)
            await asyncio.sleep(random.random())
            study.append(await stopped())
            await first.until(lambda state: not state["holder"])
    return Measured(seen_s, server, worker, growth, idle, driving, study)


def rows(presses: int = 1000, seconds: float = 60.0, armed_presses: int = 100) -> Iterator[Row]:
    """Measure one page, then eight.

    Args:
        presses: of STOP on an idle bench, with each number of pages.
        seconds: for which frames are received.
        armed_presses: of STOP while the bench drives, and as many while it plays a study.
    """
    if sys.platform != "linux":
        return
    for pages, stop_ms, median_ms, tail_ms in ((1, 20.0, 10.0, 30.0), (PAGES, 50.0, None, 60.0)):
        with panel() as (process, host, token):
            found = asyncio.run(
                measured(process.pid, host, token, pages, seconds, presses, armed_presses)
            )
        with_pages = f"{pages} page{'s' * (pages > 1)}"
        for what, pressed in (
            ("", found.idle), (" while driving", found.driving), (" during a study", found.study)
        ):  # fmt: skip
            revoked_s, answered_s, commanded = zip(*pressed, strict=True)
            for name, times_s, goal_ms in (
                ("permission revoked", revoked_s, stop_ms),
                ("0 V commanded", answered_s, None if what == " during a study" else stop_ms),
            ):
                yield Row(f"STOP{what} to {name}, p99, {with_pages}",
                          1e3 * float(np.percentile(times_s, 99)), "ms", goal_ms, False,
                          f"median {1e3 * float(np.median(times_s)):.2g} ms")  # fmt: skip
            yield Row(f"presses of STOP answered{what}, {with_pages}", sum(commanded),
                      f"of {len(pressed)}", len(pressed))  # fmt: skip
        yield Row(f"age of a block at a page, median, {with_pages}",
                  1e3 * float(np.median(found.ages_s)), "ms", median_ms, False)  # fmt: skip
        yield Row(f"age of a block at a page, p95, {with_pages}",
                  1e3 * float(np.percentile(found.ages_s, 95)), "ms", tail_ms, False)  # fmt: skip
        rate_hz = len(found.ages_s) / pages / seconds
        yield Row(f"web server's share of a core, {with_pages}", 100.0 * found.server, "%",
                  10.0 if pages == PAGES else None, False,
                  f"{rate_hz:.3g} frames/s at each page")  # fmt: skip
        yield Row(f"bench process's share of a core, {with_pages}", 100.0 * found.bench, "%")
        yield Row(f"growth of the web server's memory in {seconds:g} s, {with_pages}",
                  100.0 * found.growth, "%", 5.0, False)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--armed-presses", type=int, default=20)
    options = parser.parse_args()
    for row in rows(options.presses, options.seconds, options.armed_presses):
        print(row, flush=True)
