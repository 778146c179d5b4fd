"""The panel in Chromium: its first paint, and STOP from `pointerdown` to the revoked permission.

`python -m benchmarks.rig.panel_chromium [--presses 100] [--outages 10]`

The page's clock and this process's clock are the same one of the computer. The revocation is seen
by a thread that reads the interlock's file every 0.2 ms. First, one page is open; then its scripts
are slowed down 6 times and seven other pages receive all streams. The first paint is timed by the
browser, from the start of the navigation to the first text or picture.

For the outages, the web server is stopped by a signal for up to 8 s, and then continued; after that
Chromium is, as when a computer sleeps. The page notes when it marks its data as old and as live.
"""

import argparse
import asyncio
import contextlib
import math
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Iterator
from typing import Any

import numpy as np

from benchmarks.rig.panel import PAGES, child, page, panel
from benchmarks.rows import Row
from haselab.safety.interlock import Interlock

READY = "document.getElementById('emergency-state').textContent === 'STOP: ready'"
NOTE_PRESSES = """() => document.addEventListener('pointerdown',
    event => { window.pressed_ms = performance.timeOrigin + event.timeStamp; }, true)"""
FIRST_PAINT = """() => performance.getEntriesByName('first-contentful-paint')[0].startTime"""
NOTE_AGES = """() => {
    window.changes = [];
    const isOld = () => document.body.classList.contains('stale');
    let was = isOld();
    new MutationObserver(() => {
        if (isOld() === was) return;
        was = isOld();
        window.changes.push([was, performance.timeOrigin + performance.now()]);
    }).observe(document.body, { attributes: true, attributeFilter: ['class'] });
}"""
LOADS = 5
LONGEST_S = 8.0  # of an outage
LATEST_S = 10.0


class Revocations:
    """Notes when the permission is revoked. Use as a context."""

    def __init__(self, process: int) -> None:
        words = ["ps", "-ww", "-o", "args=", "-p", str(child(process, "stop_process"))]
        listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
        key = listed.partition("/haselab-panel-")[2].split(" http")[0].partition(" ")[2]
        self.times_s: list[float] = []
        self._interlock, self._over = Interlock(key), threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> "Revocations":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._interlock.close()

    def _watch(self) -> None:
        last = self._interlock.revision
        while not self._over.wait(2e-4):
            if (now := self._interlock.revision) != last:
                self.times_s.append(time.time())
                last = now


@contextlib.asynccontextmanager
async def chromium_page(address: str, slowdown: int) -> AsyncIterator[Any]:
    """A page of the panel in Chromium, its mouse on STOP."""
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        found = await browser.new_page()
        await found.goto(address)
        await found.wait_for_function(READY, timeout=6e4)
        if slowdown > 1:
            tools = await found.context.new_cdp_session(found)
            await tools.send("Emulation.setCPUThrottlingRate", {"rate": slowdown})
        await found.evaluate(NOTE_PRESSES)
        box = await found.locator("#emergency").bounding_box()
        await found.mouse.move(box["x"] + 20.0, box["y"] + 20.0)
        yield found
        await browser.close()


async def first_paints(host: str, token: str) -> list[float]:
    """Times in ms of pages that are loaded one after the other, each in a browser of its own."""
    times_ms = []
    for _ in range(LOADS):
        async with chromium_page(f"http://{host}/?token={token}", 1) as found:
            times_ms.append(await found.evaluate(FIRST_PAINT))
    return times_ms


async def pressed(
    process: int, host: str, token: str, presses: int, others: int, slowdown: int
) -> list[float]:
    """Press STOP again and again; times in s until the revocation, NaN where there was none."""
    times_s = []
    async with contextlib.AsyncExitStack() as opened:
        for _ in range(others):
            await opened.enter_async_context(page(host, token, []))
        address = f"http://{host}/?token={token}"
        chromium = await opened.enter_async_context(chromium_page(address, slowdown))
        revoked = opened.enter_context(Revocations(process))
        for _ in range(presses):
            await asyncio.sleep(0.1 + 0.05 * random.random())
            before, begun_s = len(revoked.times_s), time.monotonic()
            await chromium.mouse.down()
            await chromium.mouse.up()
            while len(revoked.times_s) == before and time.monotonic() < begun_s + LATEST_S:
                await asyncio.sleep(1e-3)
            if len(revoked.times_s) == before:
                times_s.append(math.nan)
                continue
            pressed_s = 1e-3 * await chromium.evaluate("window.pressed_ms")
            times_s.append(revoked.times_s[before] - pressed_s)
    return times_s


def browser_processes(parent: int) -> list[int]:
    """Process numbers of all children of a process that are Chromium's, and of their children."""
    words = ["ps", "-e", "-o", "pid=,ppid=,args="]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    found, known = [], {parent}
    for line in sorted(listed.splitlines(), key=lambda line: int(line.split()[0])):
        process, above, args = line.split(maxsplit=2)
        if int(above) in known:
            known.add(int(process))
            if "chrom" in args:
                found.append(int(process))
    return found


async def outages(
    process: int, host: str, token: str, count: int, sleeping: bool
) -> tuple[list[float], list[float]]:
    """Times in s until the page marks its data as old, and until they are live after the return."""
    old_s, live_s = [], []
    async with chromium_page(f"http://{host}/?token={token}", 1) as found:
        await found.wait_for_function("!document.body.classList.contains('stale')", timeout=6e4)
        await found.evaluate(NOTE_AGES)
        stopped = browser_processes(os.getpid()) if sleeping else [process]
        for k in range(count):
            await asyncio.sleep(1.0 + random.random())
            await found.evaluate("window.changes.length = 0")
            begun_s = time.time()
            for one in stopped:
                os.kill(one, signal.SIGSTOP)
            await asyncio.sleep(1.0 + (LONGEST_S - 1.0) * k / max(count - 1, 1))
            over_s = time.time()
            for one in stopped:
                os.kill(one, signal.SIGCONT)
            await asyncio.sleep(3.0)
            changes = [(old, 1e-3 * ms) for old, ms in await found.evaluate("window.changes")]
            marked = [at_s - begun_s for old, at_s in changes if old]
            old_s.append(marked[0] if marked else math.inf)
            if changes and not changes[-1][0]:
                live_s.append(max(changes[-1][1] - over_s, 0.0))
            else:  # a page that slept may have got a new frame before it looked at its age
                live_s.append(0.0 if sleeping and not changes else math.inf)
    return old_s, live_s


def rows(presses: int = 1000, outages_of_each: int = 20) -> Iterator[Row]:
    """Measure the first paint, STOP on one page and on a slow one beside seven others, and outages.

    Args:
        presses: of STOP, for each of both.
        outages_of_each: outages of the web server, and as many of Chromium.
    """
    if shutil.which("chromium") is None:
        return
    with panel() as (_, host, token):
        paints_ms = asyncio.run(first_paints(host, token))
    yield Row("first paint of the page in Chromium", float(np.median(paints_ms)), "ms", 300.0,
              False, f"slowest of {LOADS}: {max(paints_ms):.0f} ms")  # fmt: skip
    for others, slowdown, goal_ms in ((0, 1, 20.0), (PAGES - 1, 6, 50.0)):
        with panel() as (process, host, token):
            times_s = asyncio.run(pressed(process.pid, host, token, presses, others, slowdown))
        seen_s = np.array(times_s)[np.isfinite(times_s)]
        which = f"{1 + others} pages, slowed down {slowdown} times" if others else "1 page"
        yield Row(f"pointerdown on STOP in Chromium to permission revoked, p99, {which}",
                  1e3 * float(np.percentile(seen_s, 99)) if len(seen_s) else math.nan, "ms",
                  goal_ms, False, f"median {1e3 * float(np.median(seen_s)):.2g} ms")  # fmt: skip
        yield Row(f"presses of STOP in Chromium that revoked the permission, {which}",
                  len(seen_s), f"of {presses}", presses)  # fmt: skip
    for sleeping, what in ((False, "the web server"), (True, "Chromium")):
        with panel() as (process, host, token):
            old_s, live_s = asyncio.run(
                outages(process.pid, host, token, outages_of_each, sleeping)
            )
        if not sleeping:
            yield Row(f"data marked as old after {what} stopped, slowest of {len(old_s)}",
                      1e3 * max(old_s), "ms", 500.0, False)  # fmt: skip
        yield Row(f"data live again after {what} was continued, slowest of {len(live_s)}",
                  1e3 * max(live_s), "ms", 1000.0, False,
                  f"median {1e3 * float(np.median(live_s)):.3g} ms")  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--presses", type=int, default=100)
    parser.add_argument("--outages", type=int, default=10)
    options = parser.parse_args()
    for row in rows(options.presses, options.outages):
        print(row, flush=True)
