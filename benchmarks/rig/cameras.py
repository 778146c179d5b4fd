"""Cameras: received and lost frames, their cost, and the jitter of their times.

`python -m benchmarks.rig.cameras [--seconds 10]`

Aravis' own camera in this process, at increasing frame rates, and the one of its
package over GigE Vision on the loopback where it is installed. The acquisition's clock is the
computer's, in blocks of 10 ms; a camera is polled every 20 ms, as an observer of a study does.
"""

import argparse
import contextlib
import math
import resource
import shutil
import subprocess
import time
from collections.abc import Iterator

import numpy as np

from haselab.base import DeviceError
from haselab.rig.cameras.config import AravisConfig
from haselab.rig.cameras.opening import OpenedCamera, open_camera

BLOCK_S, LOOK_S = 0.01, 0.02
SERIAL = "HLB1"


def clock() -> tuple[float, float]:
    now_s = time.monotonic()
    return math.floor(now_s / BLOCK_S) * BLOCK_S, now_s


def film(opened: OpenedCamera, rate_hz: float, seconds: float) -> str:
    """One line of results."""
    opened.camera.start(rate_hz)
    time_s, size = [], (0, 0)
    used = resource.getrusage(resource.RUSAGE_SELF)
    polled_s = 0.0
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        time.sleep(LOOK_S)
        began_s = time.perf_counter()
        frames = opened.camera.take()
        polled_s += time.perf_counter() - began_s
        if frames is not None:
            time_s.append(frames.time_s)
            size = frames.images.shape[1:]
    after = resource.getrusage(resource.RUSAGE_SELF)
    lost = opened.dropped()
    opened.camera.stop()
    times_s = np.concatenate(time_s)
    step = np.diff(times_s)
    busy = after.ru_utime + after.ru_stime - used.ru_utime - used.ru_stime
    return (
        f"{rate_hz:6.0f} Hz  {size[1]} x {size[0]} px  {1.0 / step.mean():8.2f} frames/s  "
        f"{lost:4d} lost  {1e6 * polled_s / times_s.size:6.0f} us a frame in take  "
        f"{100.0 * busy / seconds:4.0f} % of a core  steps of {1e3 * step.std():.2f} ms std"
    )


@contextlib.contextmanager
def over_the_network() -> Iterator[str | None]:
    """A GigE Vision camera on the loopback; None where it is not installed."""
    program = shutil.which("arv-fake-gv-camera-0.8")
    if program is None:
        yield None
        return
    quiet = subprocess.DEVNULL
    command = [program, "-i", "127.0.0.1", "-s", SERIAL]
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as camera:
        time.sleep(1.0)
        try:
            yield "127.0.0.1"
        finally:
            camera.terminate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    seconds = parser.parse_args().seconds
    with contextlib.closing(open_camera(AravisConfig(kind="aravis", name="Fake_1"), clock)) as own:
        for rate_hz in (100.0, 200.0, 500.0):
            print("in process ", film(own, rate_hz, seconds), flush=True)
    with over_the_network() as name:
        if name is None:
            print("no GigE Vision: apt-get install aravis-tools")
            return
        config = AravisConfig(kind="aravis", name=name, serial_number=SERIAL)
        with contextlib.closing(open_camera(config, clock)) as camera:
            for rate_hz in (50.0, 100.0):
                print("GigE Vision", film(camera, rate_hz, seconds), flush=True)


if __name__ == "__main__":
    try:
        main()
    except DeviceError as error:
        raise SystemExit(str(error)) from None
