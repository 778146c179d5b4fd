"""Speed of the simulated bench: monitors, mechanics, camera.

python -m benchmarks.rig.twin
"""

import numpy as np

from benchmarks.rows import Row, medians
from haselab.actuators import ACTUATORS
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench

BLOCK_S = 0.01


def rows() -> list[Row]:
    return [*(row for kind in ACTUATORS.packages() for row in kind_rows(kind)), camera_row()]


def kind_rows(kind: str) -> list[Row]:
    """Acquisition and motion of one kind of actuator under a drive that sweeps to 2 Hz."""
    time_s = BLOCK_S * np.arange(2000)
    drive_v = 0.4 + 0.3 * np.sin(2.0 * np.pi * (0.1 + 0.05 * time_s) * time_s)
    bench = TwinBench(TwinConfig(kind=kind), 1)
    load_n = bench.load_n
    lengths = np.empty(200_000)  # 20 s in steps of 0.1 ms

    def move() -> None:
        bench.native.move(drive_v, 100, load_n, lengths)

    acquiring = TwinBench(TwinConfig(kind=kind), 1)
    acquiring.sine(2000.0, 0.02)

    def acquire() -> None:
        for volt in drive_v[:50].tolist():
            acquiring.write(volt)
            acquiring.read()

    acquired_s, moved_s = medians(acquire, move)
    return [
        Row(f"{kind}, both monitors at 200 kHz", 50 * BLOCK_S / acquired_s, "rig s / s", 100.0),
        Row(f"{kind}, mechanics alone", drive_v.size * BLOCK_S / moved_s, "rig s / s", 10_000.0),
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
