"""What every camera promises: one suite, run on each kind of them."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError, HaselabError
from haselab.rig import Frames
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.config import AravisConfig, FolderConfig, V4l2Config
from haselab.rig.cameras.opening import OpenedCamera, open_camera
from haselab.rig.instruments.sections import CameraConfig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench
from haselab.store.video.writer import VideoWriter, write_png

RATE_HZ = 100.0
BLOCK_S = 0.01
PATIENCE_S = 120.0  # against a hang; a busy machine may take its time
FAKE_V4L2 = os.environ.get("FAKE_V4L2")


@dataclass(frozen=True)
class Bench:
    """A camera, the acquisition's clock, and a way to let time pass."""

    opened: OpenedCamera
    clock: Callable[[], tuple[float, float]]
    wait: Callable[[float], None]

    def film(self, count: int) -> Frames:
        """At least so many frames; the wait for them has an end."""
        taken: list[Frames] = []
        until = time.monotonic() + PATIENCE_S
        while sum(len(frames.time_s) for frames in taken) < count:
            assert time.monotonic() < until, "no frames"
            self.wait(BLOCK_S)
            frames = self.opened.camera.take()
            if frames is not None:
                assert frames.time_s[-1] <= self.clock()[0]
                taken.append(frames)
        images = np.concatenate([frames.images for frames in taken])
        return Frames(images, np.concatenate([frames.time_s for frames in taken]))


def real_time() -> tuple[Callable[[], tuple[float, float]], Callable[[float], None]]:
    """A clock that goes by itself in blocks, as an acquisition's."""
    start_s = time.monotonic()

    def clock() -> tuple[float, float]:
        now_s = time.monotonic()
        return math.floor((now_s - start_s) / BLOCK_S) * BLOCK_S, now_s

    return clock, time.sleep


def by_hand() -> tuple[Callable[[], tuple[float, float]], Callable[[float], None]]:
    """A clock that goes as blocks are read."""
    blocks = [0]

    def wait(duration_s: float) -> None:
        blocks[0] += max(1, round(duration_s / BLOCK_S))

    return lambda: (blocks[0] * BLOCK_S, 0.0), wait


def pictures(count: int) -> np.ndarray:
    """Frames that can be reported apart: shape (count, 24, 32)."""
    k, y, x = np.ogrid[:count, :24, :32]
    return ((7 * k + y + 2 * x) % 256).astype(np.uint8)


def aravis(folder: Path) -> CameraConfig:
    try:
        AravisLibrary()
    except DeviceError as missing:
        pytest.skip(str(missing))
    return AravisConfig(
        kind="aravis", name="Fake_1", exposure_s=2e-3, most_dropped=1.0, timeout_s=60.0
    )


def images(folder: Path) -> CameraConfig:
    for k, image in enumerate(pictures(60)):
        write_png(folder / f"{k:03d}.png", image)
    return FolderConfig(kind="folder", path=str(folder), repeat=True)


def video(folder: Path) -> CameraConfig:
    writer = VideoWriter(folder / "film.mkv", RATE_HZ)
    writer.append(pictures(60), np.arange(60) / RATE_HZ)
    writer.close()
    return FolderConfig(kind="folder", path=str(folder / "film.mkv"), repeat=True)


def v4l2(folder: Path) -> CameraConfig:
    assert FAKE_V4L2 is not None
    return V4l2Config(kind="v4l2", device=FAKE_V4L2, format="gray", most_dropped=1.0,
                      timeout_s=60.0)  # fmt: skip


MAKERS = {"aravis": aravis, "images": images, "video": video}
if FAKE_V4L2 is not None:  # in a process of its own, which the last test starts
    MAKERS = {"v4l2": v4l2}


@pytest.fixture(params=list(MAKERS))
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    before = set(threading.enumerate())
    config = MAKERS[request.param](tmp_path)
    clock, wait = by_hand() if request.param in ("images", "video") else real_time()
    opened = open_camera(config, clock)
    yield Bench(opened, clock, wait)
    opened.close()
    opened.close()
    assert opened.camera.take() is None
    assert set(threading.enumerate()) <= before, "a camera leaves no thread behind"


def test_a_camera_says_what_it_is_and_is_still_until_it_is_started(bench):
    assert bench.opened.identity
    bench.wait(BLOCK_S)
    assert bench.opened.camera.take() is None
    assert bench.opened.dropped() == 0


def test_frames_are_grey_levels_with_times_that_rise_and_are_past(bench):
    start_s = bench.clock()[0]
    bench.opened.camera.start(RATE_HZ)
    frames = bench.film(20)
    assert frames.images.dtype == np.uint8 and frames.images.ndim == 3
    assert frames.images.shape[0] == frames.time_s.size
    assert (np.diff(frames.time_s) > 0.0).all()
    # The offset of the clocks is known to a block at the worst, where nobody read one before.
    assert frames.time_s[0] >= start_s - BLOCK_S - bench.opened.uncertainty_s()
    assert (frames.images[0] != frames.images[-1]).any()


def test_the_clock_of_the_frames_runs_as_the_acquisitions(bench):
    bench.opened.camera.start(RATE_HZ)
    frames = bench.film(40)
    lost = bench.opened.dropped()
    # Frames that a busy machine lost are counted, so the time between the ends is known. Both ends
    # may be off by what the camera's time is known to.
    took_s = (frames.time_s.size - 1) / RATE_HZ
    slack_s = 2.0 * bench.opened.uncertainty_s() + 1e-9
    assert took_s - slack_s <= frames.time_s[-1] - frames.time_s[0]
    if lost == 0 and bench.opened.uncertainty_s() == 0.0:
        np.testing.assert_allclose(np.diff(frames.time_s), 1.0 / RATE_HZ, rtol=1e-6)


def test_stop_may_be_called_twice_and_no_frame_follows(bench):
    bench.opened.camera.stop()
    bench.opened.camera.start(RATE_HZ)
    bench.film(3)
    bench.opened.camera.stop()
    bench.opened.camera.stop()
    bench.wait(3.0 / RATE_HZ)
    assert bench.opened.camera.take() is None


def test_a_camera_starts_again_after_a_stop_and_without_one(bench):
    bench.opened.camera.start(RATE_HZ)
    first = bench.film(5)
    bench.opened.camera.stop()
    bench.wait(0.1)
    bench.opened.camera.start(RATE_HZ)
    second = bench.film(5)
    bench.wait(0.1)
    bench.opened.camera.start(RATE_HZ)
    third = bench.film(5)
    assert first.time_s[-1] < second.time_s[0] < second.time_s[-1] < third.time_s[0]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, 1e9, float("nan"), float("inf")])
def test_an_invalid_rate_is_refused_in_one_line_and_the_camera_is_unchanged(bench, rate_hz):
    with pytest.raises(HaselabError, match=r"The frame rate is ") as reported:
        bench.opened.camera.start(rate_hz)
    assert reported.value.exit_code == 2 and "\n" not in str(reported.value)
    bench.wait(BLOCK_S)
    assert bench.opened.camera.take() is None
    bench.opened.camera.start(RATE_HZ)
    bench.film(2)


def test_a_picture_belongs_to_its_taker(bench):
    bench.opened.camera.start(RATE_HZ)
    frames = bench.film(2)
    kept = frames.images.copy()
    frames.images.setflags(write=True)
    bench.film(20)
    np.testing.assert_array_equal(frames.images, kept)


def test_the_camera_may_be_stopped_by_another_thread_while_it_is_asked(bench):
    bench.opened.camera.start(RATE_HZ)
    ends = threading.Event()
    failed: list[BaseException] = []

    def ask() -> None:
        try:
            while not ends.is_set():
                bench.opened.camera.take()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=ask)
    thread.start()
    for _ in range(5):
        bench.wait(0.02)
        bench.opened.camera.stop()
        bench.opened.camera.start(RATE_HZ)
    bench.opened.camera.stop()
    ends.set()
    thread.join(PATIENCE_S)
    assert not thread.is_alive() and not failed


def test_the_twins_camera_keeps_the_same_promises_on_its_own_clock():
    config = twin_of_reading("hz")
    twin = TwinBench(config, 1)

    def wait(duration_s: float) -> None:
        for _ in range(max(1, round(duration_s / BLOCK_S))):
            twin.read()

    opened = OpenedCamera(twin, "twin", lambda: None)
    bench = Bench(opened, lambda: (twin.time_s, 0.0), wait)
    twin.start(RATE_HZ)
    frames = bench.film(5)
    np.testing.assert_allclose(np.diff(frames.time_s), 1.0 / RATE_HZ, rtol=1e-6)
    twin.stop()
    twin.stop()
    assert twin.take() is None


@pytest.mark.skipif(FAKE_V4L2 is not None, reason="this is the process that it starts")
def test_the_suite_holds_for_a_v4l2_device(fake_v4l2):
    """FFmpeg's own input on a device that is put before the C library."""
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-k", "v4l2", __file__]
    done = subprocess.run(
        command, env=fake_v4l2("none"), capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout or "...." in done.stdout
