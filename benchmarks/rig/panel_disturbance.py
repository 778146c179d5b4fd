"""Outputs that a study misses or gives late: without a panel, with one page, and with eight.

`python -m benchmarks.rig.panel_disturbance [--seconds 60] [--rounds 1]`

The twin is served by a process of its own and follows the wall clock, behind the drivers of the
real instruments. `haselab run` plays a study of triangles on it, and the panel plays the same study
with one page open and with eight, one of which is frozen: it neither reads nor answers. The ways
take turns. There is one output every 10 ms; it is late if more than half of the available time had
passed. A study that trips has missed all.
"""

import argparse
import asyncio
import contextlib
import math
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import websockets

from benchmarks.rig.panel import PAGES, page, panel
from benchmarks.rig.wire import Served
from benchmarks.rows import Row
from haselab.store.session.reader import SessionReader

STUDY = """name = "triangles"

[triangle]
low_v = 0.0
high_v = 1.0
frequency_hz = 0.5
cycles = {cycles}
skipped_cycles = 1
frame_rate_hz = 200.0
"""


def counted(folder: Path) -> tuple[int, int]:
    """Late and missed outputs in the only recording below a folder."""
    (session,) = folder.glob("**/session.h5")
    with SessionReader(session) as reader:
        texts = " ".join(text for _, text in reader.events() if text.startswith("deadlines of"))
    late, missed = (re.findall(rf"(\d+) {what}", texts) for what in ("late", "missed"))
    return sum(map(int, late)), sum(map(int, missed))


async def play(host: str, token: str, pages: int, seconds: float) -> None:
    """Play the study from the first of some pages; the last of several is frozen."""
    async with contextlib.AsyncExitStack() as opened:
        first, *_ = [
            await opened.enter_async_context(page(host, token, []))
            for _ in range(max(1, pages - 1))
        ]
        if pages > 1:
            frozen = await opened.enter_async_context(
                websockets.connect(f"ws://{host}/live", origin=f"http://{host}")  # type: ignore[arg-type]
            )
            await frozen.send(f'{{"token": "{token}"}}')
        await first.arm(study={"study": "triangles.toml", "keep_video": "none"})
        await first.until(lambda state: bool(state["task"]))
        await first.until(lambda state: not state["holder"], 60.0 + 2.0 * seconds)
        if not first.state["recorded"]:
            raise RuntimeError(first.state["reason"])


def played(pages: int, seconds: float) -> tuple[float, float]:
    """Late and missed outputs of a study with some pages; 0: without a panel."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        study = folder / "triangles.toml"
        study.write_text(STUDY.format(cycles=round(0.5 * seconds)))
        served = Served(folder, 2)
        try:
            if pages == 0:
                command = [sys.executable, "-m", "haselab.cli", "run", str(study), "--rig"]
                command += [str(served.path), "--out", str(folder / "run"), "--yes"]
                command += ["--acknowledge", "--keep-video", "none"]
                subprocess.run(command, check=True, capture_output=True)
            else:
                with panel("--rig", str(served.path), folder=folder) as (_, host, token):
                    asyncio.run(play(host, token, pages, seconds))
            return counted(folder)
        except (RuntimeError, subprocess.CalledProcessError) as error:
            print(error, file=sys.stderr)
            return math.inf, math.inf
        finally:
            served.close()


def rows(seconds: float = 60.0, rounds: int = 3) -> Iterator[Row]:
    """Play the study without a panel, with one page and with eight, in turns.

    Args:
        seconds: of a study.
        rounds: studies of each.
    """
    ways = (0, 1, PAGES)
    found = np.array([[played(pages, seconds) for pages in ways] for _ in range(rounds)]).sum(0)
    of = f"of {round(100 * seconds) * rounds}"
    for pages, (late, missed) in zip(ways, found, strict=True):
        which = {0: "without a panel", 1: "1 page"}.get(pages, f"{pages} pages, one frozen")
        goal = found[0, 1] if pages else None
        note = f"{late:g} late"
        yield Row(f"outputs missed in a study, {which}", missed, of, goal, False, note)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    for row in rows(options.seconds, options.rounds):
        print(row, flush=True)
