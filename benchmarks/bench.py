"""Each figure that the project claims, beside its peers, in one run: `make bench`.

Medians of several rounds in wall time; peers take turns with ours inside a round, so a neighbour on
the machine slows both. Trust the ratios.
"""

import importlib.util
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from haselab import _core
from haselab.rig.twin.bench import TwinBench, native_bench
from haselab.rig.twin.config import TwinConfig
from haselab.sensing import Lockin, LockinConfig, PaperChain, SineFit

ROUNDS = 7
BLOCK_S = 0.01


@dataclass(frozen=True)
class Row:
    """One line of the table; a goal is met from above where `more_is_better`."""

    what: str
    value: float
    unit: str
    goal: float | None = None
    more_is_better: bool = True
    note: str = ""

    def verdict(self) -> str:
        if self.goal is None:
            return ""
        met = self.value >= self.goal if self.more_is_better else self.value <= self.goal
        return f"goal {self.goal:g}: {'met' if met else 'MISSED'}"


def seconds(job: Callable[[], object]) -> float:
    start = time.perf_counter()
    job()
    return time.perf_counter() - start


def medians(*jobs: Callable[[], object], rounds: int = ROUNDS) -> list[float]:
    """Median seconds of each job; the jobs take turns."""
    for job in jobs:
        job()
    times = [[seconds(job) for job in jobs] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*times, strict=True)]


def twin_rows() -> list[Row]:
    config = TwinConfig()
    bench = TwinBench(config, 1)
    bench.sine(2000.0, 0.02)
    bench.write(1.0)
    native = native_bench(config, 1)
    lengths = np.empty(200_000)  # 20 s in steps of 0.1 ms

    def acquire() -> None:
        for _ in range(50):
            bench.read()

    def move() -> None:
        native.move(np.array([1.0]), lengths.size, 2.45, lengths)

    acquired_s, moved_s = medians(acquire, move)
    return [
        Row("twin with both monitors at 200 kHz", 50 * BLOCK_S / acquired_s, "rig s / s", 20.0),
        Row("twin, mechanics alone", 20.0 / moved_s, "rig s / s", 1000.0),
    ]


def camera_rows() -> list[Row]:
    bench = TwinBench(TwinConfig(), 1)
    bench.start(400.0)
    frames = 0

    def take() -> None:
        nonlocal frames
        bench.wait(0.25)
        taken = bench.take()
        frames = 0 if taken is None else len(taken.images)

    (taken_s,) = medians(take)
    return [Row("twin's camera, 512 x 512", frames / taken_s, "frames / s", note="real time: 400")]


def monitors(blocks: int) -> np.ndarray:
    angle = 2 * np.pi * 2000.0 * np.arange(2000 * blocks) / 200e3
    noise = np.random.default_rng(1).standard_normal((angle.size, 2))
    clean = np.stack([80 * np.cos(angle), 300 * np.cos(angle + 1.5)], axis=1)
    return np.round(clean + noise).astype(np.int16).reshape(blocks, 2000, 2)


def sensing_rows() -> list[Row]:
    blocks = 500
    codes = monitors(blocks)
    volts = codes * (20 / 2**16)
    config = LockinConfig(200e3, 2000, 2000.0, 0.0, 2.5e6, min_amplitude_codes=0.0)
    lockin, fit = Lockin(config), SineFit(config)
    pid = _core.Pid(0.85, 1.5, 0.15, 0.01, 0.02, -0.05, 0.1)

    def step() -> None:
        for block in codes:
            lockin.step(block)

    def control() -> None:
        for k in range(blocks):
            pid.step(0.01, 1e-5 * k)

    step_s, control_s, core_s, double_s, paper_s = medians(
        step,
        control,
        lambda: lockin.sense(codes),
        lambda: lockin.sense(volts),
        lambda: PaperChain(config).sense(volts),
    )
    (fit_s,) = medians(lambda: fit.sense(volts[:50]), rounds=3)
    live_s = blocks * BLOCK_S
    return [
        Row("lock-in step of one block, from Python", step_s / blocks * 1e6, "us"),
        Row("PID step, from Python", control_s / blocks * 1e6, "us"),
        Row("bulk lock-in on codes, with std", live_s / core_s, "x real time"),
        Row("bulk lock-in on volts, in double", live_s / double_s, "x real time"),
        Row("paper's chain, scipy sosfilt and FFT", live_s / paper_s, "x real time"),
        Row("   bulk lock-in over the paper's chain", paper_s / core_s, "times faster"),
        Row("sine fit, frequency refined", 50 * BLOCK_S / fit_s, "x real time"),
    ]


def tracking_rows() -> list[Row]:
    """Frames a second in one thread; `tracking_speed.py` has the errors as well."""
    if importlib.util.find_spec("cv2") is None:
        return [Row("tracking beside OpenCV: needs the extra `bench`", float("nan"), "frames / s")]
    import tracking_speed as speed

    from haselab.tracking import TrackOptions

    frames, truth = speed.make_clip(1)
    rows = []
    for count, model in ((6, "translation"), (300, "neighbours")):
        points = truth[0, :count]
        options = TrackOptions(subset_px=21, model=model)
        ours = [speed.run_ours(frames, points, options)[0] for _ in range(3)]
        peer = [speed.run_lucas_kanade(frames, points, 21)[0] for _ in range(3)]
        note = f"OpenCV Lucas-Kanade {statistics.median(peer):.0f}"
        rows.append(
            Row(f"tracking of {count} points", statistics.median(ours), "frames / s", note=note)
        )
    return rows


def command_rows() -> list[Row]:
    def run(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    help_s, bare_s = medians(run("-m", "haselab.app", "--help"), run("-c", "pass"), rounds=5)
    note = f"the interpreter alone {bare_s:.2f}"
    return [Row("haselab --help", help_s, "s", 0.4, False, note)]


def main() -> None:
    rows = []
    for section in (twin_rows, camera_rows, sensing_rows, tracking_rows, command_rows):
        rows += section()
    for row in rows:
        note = "   ".join(part for part in (row.verdict(), row.note) if part)
        print(f"{row.what:44s} {row.value:10.4g} {row.unit:13s} {note}".rstrip())


if __name__ == "__main__":
    main()
