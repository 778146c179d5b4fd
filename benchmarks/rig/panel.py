"""The panel on the twin: STOP, latency of the traces, and what its web server uses.

`python -m benchmarks.rig.panel [--presses 100] [--seconds 10]`

The pages are clients without a browser, in this process, on the same computer. A press of STOP is
timed from before its request is sent until the answer has arrived that 0 V was commanded; it
includes the connection. The age of a block is from the moment at which the bench process has
written the newest block of a frame until a page has received that frame. Frames are sent 30 times a
second, so a block waits for up to 33 ms more; drawing is not part of it either.
"""

import argparse
import asyncio
import contextlib
import http.client
import json
import os
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import numpy as np
import websockets

from benchmarks.rows import Row

TICKS = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100
PAGES = 8


@contextlib.contextmanager
def panel() -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """A panel on the twin: its process, host and token."""
    command = [sys.executable, "-m", "haselab.cli", "panel", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    try:
        yield process, address.split("/")[2], address.partition("token=")[2]
    finally:
        process.terminate()
        process.wait()


@contextlib.asynccontextmanager
async def page(host: str, token: str, ages_s: list[float]) -> AsyncIterator[None]:
    """A connected page that acknowledges each frame and notes the age of its last block."""
    async with websockets.connect(f"ws://{host}/live", origin=f"http://{host}") as socket:  # type: ignore[arg-type]
        await socket.send(json.dumps({"token": token}))
        await socket.recv()

        async def receive() -> None:
            while True:
                frame = await socket.recv()
                if isinstance(frame, bytes):
                    size = int.from_bytes(frame[40:44], "little")
                    written_s = json.loads(frame[48 : 48 + size])["written_s"]
                    if written_s is not None:
                        ages_s.append(time.monotonic() - written_s)
                    number = int.from_bytes(frame[4:8], "little")
                    await socket.send(json.dumps({"ack": number}))

        receiver = asyncio.create_task(receive())
        try:
            yield
        finally:
            receiver.cancel()


def cpu_s(process: int) -> float:
    """Processor time that a process has used, in s."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def memory_mb(process: int) -> float:
    """Resident memory of a process, in MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def presses(host: str, count: int) -> tuple[list[float], int]:
    """Times of presses of STOP, in s, and how many were answered with 0 V commanded."""
    about = http.client.HTTPConnection(host)
    about.request("GET", "/about")
    port = json.loads(about.getresponse().read())["stop_port"]
    times_s, commanded = [], 0
    for _ in range(count):
        begun_s = time.perf_counter()
        stop = http.client.HTTPConnection("127.0.0.1", port)
        stop.request("POST", "/stop", headers={"Origin": f"http://{host}"})
        commanded += bool(json.loads(stop.getresponse().read())["commanded"])
        times_s.append(time.perf_counter() - begun_s)
        stop.close()
        time.sleep(0.01)
    return times_s, commanded


async def connected(
    process: int, host: str, token: str, pages: int, seconds: float, count: int
) -> tuple[list[float], float, float, list[float], int]:
    """Ages of blocks at the pages, processor share and growth of the server, presses of STOP."""
    ages_s: list[float] = []
    async with contextlib.AsyncExitStack() as opened:
        for _ in range(pages):
            await opened.enter_async_context(page(host, token, ages_s))
        await asyncio.sleep(2.0)
        ages_s.clear()
        used_s, grown_mb, begun_s = cpu_s(process), memory_mb(process), time.monotonic()
        await asyncio.sleep(seconds)
        share = (cpu_s(process) - used_s) / (time.monotonic() - begun_s)
        growth = memory_mb(process) / grown_mb - 1.0
        seen_s = list(ages_s)
        times_s, commanded = await asyncio.to_thread(presses, host, count)
    return seen_s, share, growth, times_s, commanded


def rows(presses: int = 1000, seconds: float = 60.0) -> Iterator[Row]:
    """Measure one page, then eight.

    Args:
        presses: of STOP, with each number of pages.
        seconds: for which frames are received.
    """
    if sys.platform != "linux":
        return
    with panel() as (process, host, token):
        for pages, stop_ms, median_ms, tail_ms in (
            (1, 20.0, 10.0, 30.0),
            (PAGES, 50.0, None, 60.0),
        ):
            ages_s, share, growth, times_s, commanded = asyncio.run(
                connected(process.pid, host, token, pages, seconds, presses)
            )
            with_pages = f"{pages} page{'s' * (pages > 1)}"
            yield Row(f"STOP to 0 V commanded, p99, {with_pages}",
                      1e3 * float(np.percentile(times_s, 99)), "ms", stop_ms, False)  # fmt: skip
            yield Row(
                f"presses of STOP answered, {with_pages}", commanded, f"of {presses}", presses
            )
            yield Row(f"age of a block at a page, median, {with_pages}",
                      1e3 * float(np.median(ages_s)), "ms", median_ms, False)  # fmt: skip
            yield Row(f"age of a block at a page, p95, {with_pages}",
                      1e3 * float(np.percentile(ages_s, 95)), "ms", tail_ms, False)  # fmt: skip
            yield Row(f"web server's share of a core, {with_pages}", 100.0 * share, "%",
                      10.0 if pages == PAGES else None, False)  # fmt: skip
            yield Row(f"growth of its memory in {seconds:g} s, {with_pages}", 100.0 * growth, "%",
                      5.0, False)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    for row in rows(options.presses, options.seconds):
        print(row, flush=True)
