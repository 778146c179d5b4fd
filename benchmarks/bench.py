"""Each figure that the project claims, beside its peers, in one run: `make bench`.

Medians of several rounds in wall time; peers take turns with ours inside a round, so a neighbour on
the machine slows both. Trust the ratios.
"""

import argparse
import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import bench_firmware
import bench_safety
import bench_store
import bench_wire
import identify_board
import identify_hysteresis
import identify_loops
import identify_margins
import identify_response
import identify_static
import identify_transfer
import identify_verdict
import numpy as np
import sensing_accuracy
import sensing_board
import sensing_calibration
import sensing_speed
import sensing_stream
import tracking_stream
from rows import Row, medians

from haselab import _core
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, native_bench

BLOCK_S = 0.01


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


def loop_rows() -> list[Row]:
    pid = _core.Pid(0.85, 1.5, 0.15, 0.01, 0.02, -0.05, 0.1)

    def control() -> None:
        for k in range(500):
            pid.step(0.01, 1e-5 * k)

    (control_s,) = medians(control)
    return [Row("PID step, from Python", control_s / 500 * 1e6, "us")]


def tracking_rows() -> list[Row]:
    """Tables of their own, in a process of its own: one thread is set before numpy is loaded."""
    if importlib.util.find_spec("cv2") is None:
        return [Row("tracking beside OpenCV: needs the extra `bench`", float("nan"), "")]
    for name in ("tracking_bench.py", "tracking_board.py"):
        subprocess.run([sys.executable, str(Path(__file__).parent / name)], check=True)
    return []


def command_rows() -> list[Row]:
    def run(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    help_s, bare_s = medians(run("-m", "haselab.cli", "--help"), run("-c", "pass"), rounds=5)
    note = f"the interpreter alone {bare_s:.2f}"
    return [Row("haselab --help", help_s, "s", 0.4, False, note)]


SECTIONS: dict[str, tuple[Callable[[], Iterable[Row]], ...]] = {
    "twin": (twin_rows, camera_rows),
    "sensing": (sensing_accuracy.rows, sensing_speed.rows, sensing_calibration.rows, loop_rows),
    "identify": (
        identify_static.rows,
        identify_transfer.rows,
        identify_loops.rows,
        identify_response.rows,
        identify_verdict.rows,
        identify_hysteresis.rows,
    ),
    "identify-board": (identify_board.rows, identify_margins.rows),
    "recording": (bench_store.rows, bench_wire.rows),
    "board": (sensing_board.rows,),
    "stream": (sensing_stream.rows, tracking_stream.rows),
    "tracking": (tracking_rows,),
    "firmware": (bench_firmware.rows,),
    "safety": (bench_safety.rows,),
    "command": (command_rows,),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(SECTIONS)}; default: all")
    wanted = parser.parse_args().sections or list(SECTIONS)
    unknown = [name for name in wanted if name not in SECTIONS]
    if unknown:
        parser.error(f"no section {', '.join(unknown)}; allowed are {', '.join(SECTIONS)}")
    for name in wanted:
        for section in SECTIONS[name]:
            for row in section():
                print(row, flush=True)


if __name__ == "__main__":
    main()
