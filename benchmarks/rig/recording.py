"""Recording: speed, blocks lost by a kill, and lag of a second process.

`python -m benchmarks.rig.recording [--seconds 60] [--live 20] [--kills 10]`

Blocks of 2,000 readings of two channels at 200 kHz come from the twin, with noise. Speed is
measured as fast as the writer takes them, compared with writing the same bytes to a plain file.
Kills and lag are measured in real time, one block each 10 ms, with the writer in its own process.
The lag is the time from the moment at which the writer gets a block until a reader that polls every
2 ms has its codes; for comparison, that of a reader that uses HDF5 alone, which sees whole chunks
of 0.1 s.
"""

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np

from benchmarks.rows import CHECKOUT, Row
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench
from haselab.store.session.recover import recover
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionReader, SessionWriter
from haselab.store.video.raw import RawVideoWriter, transcode

SAMPLES, BLOCK_S = 2000, 0.01
HEADER = {"rig": {"rate_hz": 200e3, "volt_per_code": 3.05e-4}}
PLANS = [ExperimentPlan("x", "bench", 1, {})]


def twin_blocks(count: int) -> np.ndarray:
    bench = TwinBench(TwinConfig(), 1)
    bench.sine(2000.0, 0.02)
    blocks = np.empty((count, SAMPLES, 2), np.int16)
    for k in range(count):
        bench.write(1.0 + 0.5 * np.sin(0.05 * k))
        blocks[k] = bench.read()
    return blocks


def speed_rows(blocks: np.ndarray, folder: Path) -> list[Row]:
    taken_s = []
    start = time.perf_counter()
    with SessionWriter(folder / "fast.h5", PLANS, SAMPLES, HEADER) as session:
        for k, block in enumerate(blocks):
            before = time.perf_counter()
            session.append_block("x", block, BLOCK_S * k, 1.0, float("nan"))
            taken_s.append(time.perf_counter() - before)
    fast_s = time.perf_counter() - start
    start = time.perf_counter()
    with (folder / "plain.bin").open("wb") as plain:
        for block in blocks:
            plain.write(block.tobytes())
    plain_s = time.perf_counter() - start
    duration_s = BLOCK_S * len(blocks)
    ratio = blocks.nbytes / (folder / "fast.h5").stat().st_size
    return [
        Row("recording 2 x 200 kHz", duration_s / fast_s, "x real time", 20.0),
        Row("  the same bytes to a plain file", duration_s / plain_s, "x real time"),
        Row("  smaller than int16 by", ratio, "times"),
        Row("  a block taken, median", 1e6 * statistics.median(taken_s), "us"),
    ]


def paced(path: Path, seconds: float) -> None:
    """Write in real time; print the number of each block when it was handed over."""
    blocks = twin_blocks(100)
    rule = QueueRule(patience_s=0.0)
    with SessionWriter(path, PLANS, SAMPLES, HEADER, rule) as session:
        print("ready", flush=True)
        start = time.monotonic()
        for k in range(round(seconds / BLOCK_S)):
            time.sleep(max(0.0, start + BLOCK_S * (k + 1) - time.monotonic()))
            handed_s = time.monotonic()
            session.append_block("x", blocks[k % 100], handed_s, 1.0, float("nan"))
            os.write(1, f"{k + 1}\n".encode())


def writer(path: Path, seconds: float) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "benchmarks.rig.recording", "--paced", str(path)]
    command += ["--live", str(seconds)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=CHECKOUT)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def kill_rows(folder: Path, kills: int) -> list[Row]:
    lost, plain_lost = [], []
    for k in range(kills):
        place = folder / f"kill-{k}"
        place.mkdir()
        process = writer(place / "session.h5", 60.0)
        time.sleep(1.0 + random.Random(k).random())
        process.send_signal(signal.SIGKILL)
        printed = process.communicate()[0].split()
        with h5py.File(place / "session.h5", "r", libver="latest", swmr=True) as file:
            plain_lost.append(int(printed[-1]) - file["experiments/x/codes"].shape[0])
        lost.append(int(printed[-1]) - recover(place).blocks["x"])
    return [
        Row(f"blocks lost by kill -9, worst of {kills}", max(lost), "blocks", 10, False),
        Row("  by a reader that has HDF5 alone", max(plain_lost), "blocks", 10, False),
    ]


def new_rows(file: h5py.File, first: int) -> np.ndarray:
    """What HDF5 alone shows from a row on; no handle is left open, or `follow` would be misled."""
    group = file["experiments/x"]
    for dataset in ("codes", "blocks"):
        group[dataset].refresh()
    count = min(group["codes"].shape[0], group["blocks"].shape[0])
    group["codes"][first:count]
    return group["blocks"][first:count]["start_s"]


def lags_s(folder: Path, seconds: float) -> tuple[list[float], list[float]]:
    """Ages of blocks when they are read: by SessionReader, and by HDF5 alone."""
    path = folder / "lag.h5"
    process = writer(path, seconds)
    lags: list[float] = []
    plain: list[float] = []
    with SessionReader(path) as reader, h5py.File(path, "r", libver="latest", swmr=True) as file:
        seen = seen_plain = 0
        while process.poll() is None:
            rows = reader.follow("x", seen)
            now_s = time.monotonic()
            lags.extend((now_s - rows.start_s).tolist())
            seen += len(rows.start_s)
            start_s = new_rows(file, seen_plain)
            plain.extend((time.monotonic() - start_s).tolist())
            seen_plain += len(start_s)
            time.sleep(0.002)
    process.communicate()
    return lags, plain


def lag_rows(folder: Path, seconds: float) -> list[Row]:
    lags, plain = lags_s(folder, seconds)
    ms = [1e3 * float(q) for q in np.quantile(lags, [0.5, 0.99])]
    alone = 1e3 * statistics.median(plain)
    return [
        Row("lag of a second process, median", ms[0], "ms", 50.0, False, f"{len(lags)} blocks"),
        Row("lag of a second process, 99 %", ms[1], "ms"),
        Row("  with HDF5 alone, median", alone, "ms", note="whole chunks of 0.1 s"),
    ]


def frame_rows(folder: Path) -> list[Row]:
    frames = np.random.default_rng(1).integers(0, 256, (20, 512, 512), dtype=np.uint8)
    frames //= 16
    writer = RawVideoWriter(folder / "a.mkv", 400.0)
    start = time.perf_counter()
    for k in range(20):
        writer.append(frames, 0.05 * k + np.arange(20) / 400)
    raw_s = time.perf_counter() - start
    writer.close()
    start = time.perf_counter()
    transcode(folder / "a.raw")
    later_s = time.perf_counter() - start
    return [
        Row("raw frames of 512 x 512 with their hashes", 400 / raw_s, "frames / s", 400.0),
        Row("  to FFV1 after the run, verified", 400 / later_s, "frames / s"),
    ]


def rows(seconds: float = 60.0, live: float = 20.0, kills: int = 10) -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        blocks = twin_blocks(round(seconds / BLOCK_S))
        return [
            *speed_rows(blocks, folder),
            *kill_rows(folder, kills),
            *lag_rows(folder, live),
            *frame_rows(folder),
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--live", type=float, default=20.0)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--paced", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.paced:
        paced(options.paced, options.live)
        return
    for row in rows(options.seconds, options.live, options.kills):
        print(row)


if __name__ == "__main__":
    main()
