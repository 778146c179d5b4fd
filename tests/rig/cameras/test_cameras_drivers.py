"""Each kind of camera by itself: its settings, its faults, and the words for them."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.cameras.aravis import library as aravis_library
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.aravis.source import AravisSource
from haselab.rig.cameras.config import AravisConfig, FolderConfig, V4l2Config
from haselab.rig.cameras.folder import FolderCamera
from haselab.rig.cameras.source import Shot
from haselab.rig.cameras.v4l2 import V4l2Source
from haselab.store.video.writer import write_png

PATIENCE_S = 120.0  # against a hang; a busy machine may take its time


# ---- Aravis -------------------------------------------------------------------------------------


@pytest.fixture
def aravis() -> Iterator[Callable[..., AravisSource]]:
    try:
        AravisLibrary()
    except DeviceError as missing:
        pytest.skip(str(missing))
    opened: list[AravisSource] = []

    def make(**settings: object) -> AravisSource:
        config = AravisConfig.model_validate({"kind": "aravis", "name": "Fake_1"} | settings)
        opened.append(AravisSource(config))
        return opened[-1]

    yield make
    for source in opened:
        source.close()


def film(source: AravisSource | V4l2Source, count: int) -> list[Shot]:
    shots: list[Shot] = []
    until = time.monotonic() + PATIENCE_S
    while len(shots) < count:
        assert time.monotonic() < until, "no frames"
        time.sleep(0.005)
        shots += source.take()
    return shots


def painted_gaps(shots: list[Shot]) -> int:
    """Frames that are missing between the first and the last.

    The camera paints column + row + frame number, modulo 255.
    """
    numbers = [int(shot.image[0, 0]) for shot in shots]
    steps = [(b - a) % 255 for a, b in itertools.pairwise(numbers)]
    assert 0 not in steps, "a frame came twice"
    return sum(steps) - len(steps)


def test_aravis_takes_the_region_the_exposure_and_the_gain_of_the_rig_file(aravis):
    source = aravis(width_px=128, height_px=64, exposure_s=3e-3, gain=2.0)
    assert source.identity == "Aravis Fake, serial number 1"
    source.start(100.0)
    assert film(source, 3)[-1].image.shape == (64, 128)


def test_aravis_takes_a_hundred_frames_a_second_and_numbers_none_twice(aravis):
    source = aravis(width_px=64, height_px=64)
    source.start(100.0)
    shots = film(source, 100)
    assert painted_gaps(shots) <= source.dropped
    host_s = np.array([shot.host_s for shot in shots])
    assert (np.diff(host_s) > 0.0).all()


def test_aravis_counts_what_does_not_fit_into_its_buffers(aravis):
    source = aravis(buffer_s=0.05)
    source.start(200.0)
    film(source, 1)
    until = time.monotonic() + PATIENCE_S
    while source.dropped < 20:  # nobody takes the frames out of the 14 buffers
        assert time.monotonic() < until, "no frame was counted as lost"
        time.sleep(0.02)
    source.take()
    reported = source.dropped
    assert reported >= 20
    source.stop()
    assert source.dropped >= reported


@pytest.mark.parametrize(
    ("numbers", "lost"),
    [
        ([1, 2, 3], 0),
        ([1, 2, 5, 6], 2),
        ([65534, 65535, 1, 2], 0),  # GigE Vision leaves 0 out
        ([65535, 3], 2),
        ([2**40, 2**40 + 4], 3),
    ],
)
def test_gaps_in_the_frame_numbers_are_lost_frames(aravis, numbers, lost):
    source = aravis()
    for number in numbers:
        source._count(number)
    assert source.dropped == lost


@pytest.mark.parametrize(
    ("settings", "error", "reported"),
    [
        ({"name": "Nope_1"}, DeviceError, r"Camera Nope_1 is not found: .*arv-tool"),
        (
            {"serial_number": "7"},
            InputError,
            r"serial number 1, but the rig file names 7",
        ),
        ({"exposure_s": 1e-6}, LimitError, r"Exposure = 1e-06 s is outside \[1e-05, 10\] s"),
        ({"gain": 1e6}, LimitError, r"Gain = 1e\+06 is outside \[.*\] of camera Fake_1\. Change"),
        ({"trigger": "Line99"}, DeviceError, r"Camera Fake_1: .*'Line99' not an entry"),
    ],
)
def test_aravis_refuses_in_one_line(aravis, settings, error, reported):
    with pytest.raises(error, match=reported) as caught:
        aravis(**settings)
    assert "\n" not in str(caught.value)


def test_a_triggered_camera_gets_the_input_and_accepts_any_rate(aravis):
    source = aravis(trigger="Line0")
    reported = [source._call("get_string", key) for key in (b"TriggerMode", b"TriggerSource")]
    assert reported == [b"On", b"Line0"]
    source.start(1e4)  # beyond what the camera's own clock does
    with pytest.raises(LimitError, match=r"The frame rate is nan Hz, but it must be above 0"):
        source.start(float("nan"))
    source.close()
    free = aravis()
    assert free._call("get_string", b"TriggerMode") == b"Off"


def test_a_missing_aravis_is_one_line_that_says_what_to_install(monkeypatch):
    names = {key: ("libnone.so", *rest) for key, (_, *rest) in aravis_library._NAMES.items()}
    monkeypatch.setattr(aravis_library, "_NAMES", names)
    with pytest.raises(DeviceError, match=r"needs the library Aravis 0\.8 .* not installed\. Run"):
        AravisSource(AravisConfig(kind="aravis"))


def test_frames_come_by_gige_vision_over_the_network_and_lost_packets_are_lost_frames(
    aravis, installed
):
    """Aravis' own camera in another process: discovery, control and packets as of a real one.

    It loses one packet in 200 of the 180 of a frame, and sends none again.
    """
    program = installed("arv-fake-gv-camera-0.8", "aravis-tools")
    command = [program, "-i", "127.0.0.1", "-s", "HL01", "-r", "5"]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as camera:
        try:
            source = wait_for_camera(aravis)
            assert source.identity == "Aravis Fake, serial number HL01"
            # 8 * 400 * 512 * 512 * 1438 / 1364 bit/s
            source.start(400.0)
            assert "take 88 % of a link of 1000 Mbit/s with packets of 1400" in source.remarks[0]
            with pytest.raises(LimitError, match=r"take 133 % .* Lower the frame rate to 452"):
                source.start(600.0)
            source.start(50.0)
            assert not source.remarks
            shots = film(source, 20)
            assert all(shot.image.shape == (512, 512) for shot in shots)
            assert source.dropped >= painted_gaps(shots) > 0
            assert re.match(r"\d+ packets were lost and \d+ were resent", source.why_lost())
            camera.kill()
            camera.wait(PATIENCE_S)
            time.sleep(0.2)
            source.take()
            source.stop()  # nobody answers any more
        finally:
            camera.kill()


def test_underruns_and_incomplete_frames_are_distinguished(aravis):
    source = aravis(buffer_s=0.01)
    source.start(200.0)
    until = time.monotonic() + PATIENCE_S
    while source.dropped < 20:  # nobody takes the frames out of the buffers
        assert time.monotonic() < until, "no frame was counted as lost"
        time.sleep(0.02)
    assert source.why_lost().endswith("frames found no free buffer. Raise camera.buffer_s.")


def test_a_camera_whose_stamps_are_the_arrivals_is_said_to_have_no_clock(aravis):
    source = aravis(width_px=64, height_px=64)  # Aravis' own, in this process
    source.start(100.0)
    film(source, 40)
    assert "Camera Fake_1 sends no time stamps" in source.remarks[0]


class Settings:
    """A camera that keeps its exposure, reported between the source and Aravis."""

    def __init__(self, source: AravisSource) -> None:
        self.automatic = "Continuous"
        self.log: list[tuple[Any, ...]] = []
        self._call = source._call

    def call(self, name: str, *arguments: Any) -> Any:
        if name in ("set_exposure_time", "set_string", "stop_acquisition"):
            self.log.append((name, *arguments))
        return None if name == "set_string" else self._call(name, *arguments)


def test_an_exposure_that_was_set_is_put_back_at_the_end_and_its_automatic_too(aravis):
    source = aravis(exposure_s=3e-3)
    camera = Settings(source)
    source._call = camera.call
    assert source._found == (10e3, None)  # Aravis' own has no ExposureAuto
    source._found = (10e3, "Continuous")
    source.start(50.0)
    source.close()
    source.close()
    assert camera.log == [
        ("stop_acquisition",),
        ("set_exposure_time", 10e3),
        ("set_string", b"ExposureAuto", b"Continuous"),
    ]


@pytest.mark.parametrize("exposure_s", [None, 10e-3])
def test_an_exposure_that_was_not_changed_is_not_set_at_the_end(aravis, exposure_s):
    source = aravis(exposure_s=exposure_s)
    camera = Settings(source)
    source._call = camera.call
    source.close()
    assert camera.log == []


@pytest.mark.long
def test_the_next_program_finds_the_camera_with_the_exposure_it_had(aravis, installed):
    program = installed("arv-fake-gv-camera-0.8", "aravis-tools")
    quiet = subprocess.DEVNULL
    command = [program, "-i", "127.0.0.1", "-s", "HL01"]
    with subprocess.Popen(command, stdout=quiet, stderr=quiet) as camera:
        try:
            first = wait_for_camera(aravis)
            before_us = first._call("get_exposure_time")
            first.close()
            longer = aravis(name="127.0.0.1", exposure_s=1e-6 * before_us + 8e-3)
            assert longer._call("get_exposure_time") == pytest.approx(before_us + 8e3)
            longer.close()
            assert aravis(name="127.0.0.1")._call("get_exposure_time") == before_us
        finally:
            camera.kill()


def wait_for_camera(aravis: Callable[..., AravisSource]) -> AravisSource:
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            return aravis(name="127.0.0.1", serial_number="HL01")
        except DeviceError as error:
            if time.monotonic() > until:
                pytest.skip(f"the loopback carries no GigE Vision here: {error}")
            time.sleep(0.1)


# ---- V4L2 ---------------------------------------------------------------------------------------

SCRIPT = """
import sys, time
from haselab.base import HaselabError
from haselab.rig.cameras.config import V4l2Config
from haselab.rig.cameras.opening import open_camera
start_s = time.monotonic()
clock = lambda: (time.monotonic() - start_s, time.monotonic())
settings = dict(item.split("=") for item in sys.argv[2:])
settings = {
    name: float(value) if value.replace(".", "").isdigit() else value
    for name, value in settings.items()
}
rate_hz = float(settings.pop("rate_hz", 100.0))
try:
    config = V4l2Config(kind="v4l2", device=sys.argv[1], timeout_s=1.0, **settings)
    opened = open_camera(config, clock)
    opened.camera.start(rate_hz)
    count, until = 0, time.monotonic() + 120.0
    while count < 60 and time.monotonic() < until:
        time.sleep(0.01)
        frames = opened.camera.take()
        count += 0 if frames is None else len(frames.time_s)
    print(count, opened.dropped())
except HaselabError as error:
    print(type(error).__name__, error)
"""


@pytest.mark.parametrize(
    ("fault", "settings", "reported"),
    [
        # A busy machine may lose frames before the stall.
        ("stall", ("most_dropped=1",), "DeviceError Camera V4L2 camera at {}: no frame for "),
        (
            "gone",
            ("most_dropped=1",),
            "DeviceError The camera no longer responds (No such device). Check its cable. {}",
        ),
        ("drop", ("most_dropped=0.01",), "frames are lost (limit: a fraction of 0.01"),
        ("slow", (), "The camera is slower than the requested rate. In dim light a webcam"),
        (
            "slow",
            ("most_dropped=1",),
            "at 50 Hz instead of the requested 100 Hz. In dim",
        ),
        (
            "unstamped",
            (),
            "reports 0 s as the time of a frame, which is not on this",
        ),
        (
            "none",
            ("format=nv12",),
            "The camera set the format 'yuyv422' instead of 'nv12'",
        ),
        (
            "none",
            ("rate_hz=50",),
            "The camera set a frame rate of 30 Hz instead of 50 Hz",
        ),
        (
            "none",
            ("width_px=320", "height_px=240"),
            "DeviceError The camera sends frames of 6144 bytes, but yuyv422 of 320 x 240 px",
        ),
        ("none", ("name=Other",), "InputError The camera's name is 'V4L2 camera', but the rig"),
    ],
)
def test_v4l2_reports_its_faults_in_one_line(fake_v4l2, fault, settings, reported):
    environment = fake_v4l2(fault)
    device = environment["FAKE_V4L2"]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, device, *settings],
        env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert reported.format(device) in done.stdout, done.stdout + done.stderr
    assert done.stdout.count("\n") == 1


def test_v4l2_without_a_device_says_where_to_look(tmp_path):
    with pytest.raises(DeviceError, match=r"does not exist\. Plug it in, .*/video4linux lists"):
        V4l2Source(V4l2Config(kind="v4l2", device=str(tmp_path / "video0")))


def test_v4l2_on_what_is_no_camera_says_so(tmp_path):
    device = tmp_path / "video0"
    device.touch()
    source = V4l2Source(V4l2Config(kind="v4l2", device=str(device)))
    with pytest.raises(DeviceError, match=r"The camera does not open \(Inappropriate ioctl"):
        source.start(30.0)


# ---- folder -------------------------------------------------------------------------------------


def clock_of(now_s: list[float]) -> Callable[[], tuple[float, float]]:
    return lambda: (now_s[0], 0.0)


def folder_of(path: Path, count: int) -> np.ndarray:
    frames = np.random.default_rng(1).integers(0, 256, (count, 8, 12), dtype=np.uint8)
    for k, frame in enumerate(frames):
        write_png(path / f"{k:02d}.png", frame)
    return frames


def test_a_folder_gives_its_pictures_as_they_are_at_the_times_of_the_rate(tmp_path):
    frames, now_s = folder_of(tmp_path, 6), [3.0]
    camera = FolderCamera(FolderConfig(kind="folder", path=str(tmp_path)), clock_of(now_s))
    assert camera.identity.endswith("12 x 8 px")
    camera.start(10.0)
    first = camera.take()
    now_s[0] = 3.25
    then = camera.take()
    assert camera.take() is None
    assert first is not None and then is not None
    np.testing.assert_array_equal(np.concatenate([first.images, then.images]), frames[:3])
    assert first.time_s == pytest.approx([3.0]) and then.time_s == pytest.approx([3.1, 3.2])
    camera.close()


def test_a_folder_that_is_over_says_so_after_its_last_picture(tmp_path):
    frames, now_s = folder_of(tmp_path, 6), [0.0]
    camera = FolderCamera(FolderConfig(kind="folder", path=str(tmp_path)), clock_of(now_s))
    camera.start(10.0)
    now_s[0] = 0.95
    taken = camera.take()
    assert taken is not None
    np.testing.assert_array_equal(taken.images, frames)
    with pytest.raises(
        DeviceError, match=r"ended after 6 frames\. Play less, or set camera\.repeat"
    ):
        camera.take()
    camera.start(10.0)
    again = camera.take()
    assert again is not None
    np.testing.assert_array_equal(again.images, frames[:1])
    camera.close()


def test_a_folder_may_begin_again(tmp_path):
    frames, now_s = folder_of(tmp_path, 4), [0.0]
    config = FolderConfig(kind="folder", path=str(tmp_path), repeat=True)
    camera = FolderCamera(config, clock_of(now_s))
    camera.start(10.0)
    now_s[0] = 0.95
    taken = camera.take()
    assert taken is not None
    np.testing.assert_array_equal(taken.images, frames[np.arange(10) % 4])
    camera.close()


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no such video file or folder"):
        FolderCamera(FolderConfig(kind="folder", path=str(tmp_path / "none")), clock_of([0.0]))
    with pytest.raises(InputError, match=r"The folder contains no image"):
        FolderCamera(FolderConfig(kind="folder", path=str(tmp_path)), clock_of([0.0]))
    tifffile.imwrite(
        tmp_path / "deep.tif", np.zeros((3, 4, 5), np.uint16), photometric="minisblack"
    )
    with pytest.raises(InputError, match=r"16-bit frames, but a camera needs 8-bit .*deep\.tif"):
        path = str(tmp_path / "deep.tif")
        FolderCamera(FolderConfig(kind="folder", path=path), clock_of([0.0]))
