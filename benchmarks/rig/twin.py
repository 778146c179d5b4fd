"""Speed of the simulated bench: monitors, mechanics, camera.

python -m benchmarks.rig.twin
"""

import numpy as np

from benchmarks.rows import Row, medians
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, native_bench

BLOCK_S = 0.01


def rows() -> list[Row]:
    return [*rig_rows(), camera_row()]


def rig_rows() -> list[Row]:
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


def camera_row() -> Row:
    bench = TwinBench(TwinConfig(), 1)
    bench.start(400.0)
    frames = 0

    def take() -> None:
        nonlocal frames
        bench.wait(0.25)
        taken = bench.take()
        frames = 0 if taken is None else len(taken.images)

    (taken_s,) = medians(take)
    return Row("twin's camera, 512 x 512", frames / taken_s, "frames / s", note="real time: 400")


if __name__ == "__main__":
    for row in rows():
        print(row)
