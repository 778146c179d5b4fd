"""Exposures latched by the board's counter, over the real driver, against the twin's own times."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from haselab.base import DeviceError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.source import Shot
from haselab.rig.cameras.timed import TimedCamera, Timing
from haselab.rig.instruments.nidaq.board import NidaqBoard
from haselab.rig.instruments.nidaq.exposures import unrolled
from haselab.rig.instruments.sections import ExposureConfig
from haselab.rig.twin.client import TwinClient
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

CONFIG = twin_of_reading("hz")
TICK_S = 50e-9  # of the 20 MHz timebase
LINE = ExposureConfig(input="PFI0", duration_s=CONFIG.camera.exposure_s)


class Unsure:
    """The twin's camera as a driver whose times are late by 3 ms, and scatter by as much."""

    identity, dropped, jitter_s = "unsure", 0, 3e-3

    def __init__(self, client: TwinClient, skip: int) -> None:
        self._client, self._skip = client, skip
        self._rng = np.random.default_rng(4)
        self.true_s: list[float] = []
        self._seen = 0

    def start(self, rate_hz: float) -> None:
        self._client.start(rate_hz)

    def take(self) -> list[Shot]:
        frames = self._client.take()
        shots = []
        for image, time_s in zip(
            *((frames.images, frames.time_s) if frames else ((), ())), strict=True
        ):
            self._seen += 1
            if self._skip and self._seen % self._skip == 0:
                continue  # lost on the way, and nobody says so
            self.true_s.append(float(time_s))
            shots.append(Shot(image, float(time_s) + 3e-3 + self._rng.uniform(0.0, 3e-3)))
        return shots

    def stop(self) -> None:
        self._client.stop()

    def close(self) -> None: ...


@pytest.fixture
def served() -> Iterator[tuple[ServedTwin, BenchConfig]]:
    with ServedTwin(CONFIG, 1, pace=0.0) as twin:
        yield twin, BenchConfig.model_validate(tomllib.loads(twin.rig_file(ahead_blocks=1)))


def filmed(
    file: BenchConfig, skip: int = 0, blocks: int = 60, waited_s: float = 0.0
) -> tuple[Any, Any, np.ndarray]:
    """Camera, source, and the times of all frames that came; `waited_s` before the first."""
    limits = file.describe().drive_limits
    assert file.stand.address is not None
    client = TwinClient(file.stand.address)
    board = NidaqBoard(file.daq, limits, 1.0, LINE)
    try:
        source = Unsure(client, skip)
        # The computer's clock is the board's here: in lock-step there is no other one.
        camera = TimedCamera(
            source, lambda: (board.time_s, board.time_s), Timing(most_dropped=0.5),
            now=lambda: board.time_s, exposures=board.exposures,
        )  # fmt: skip
        for _ in range(3):
            board.read()
        if waited_s:
            board.pass_time(waited_s)
        board.pause()  # as the bench's camera does
        board.catch_up()
        camera.start(50.0)
        board.keep(True)
        times_s = []
        for _ in range(blocks):
            board.read()
            frames = camera.take()
            times_s += [] if frames is None else frames.time_s.tolist()
        board.keep(False)
        return camera, source, np.array(times_s)
    finally:
        board.close()
        client.close()


def test_frames_get_the_times_of_their_exposures_to_a_tick_of_the_timebase(served):
    _, file = served
    camera, source, times_s = filmed(file)
    assert len(times_s) >= 26  # 50 Hz over 0.6 s, less what waits for its block
    assert camera.uncertainty_s == TICK_S
    np.testing.assert_allclose(times_s, source.true_s[: len(times_s)], rtol=0.0, atol=TICK_S)
    assert camera.dropped == 0


def test_the_first_frames_after_a_long_wait_find_their_exposures(served):
    """40 s without a look drop what was latched, which must not be what a camera has just begun."""
    _, file = served
    camera, source, times_s = filmed(file, waited_s=45.0)
    assert times_s[0] > 45.0
    np.testing.assert_allclose(times_s, source.true_s[: len(times_s)], rtol=0.0, atol=TICK_S)
    assert camera.dropped == 0


def test_an_exposure_without_a_frame_is_a_lost_frame(served):
    _, file = served
    camera, source, times_s = filmed(file, skip=5)
    np.testing.assert_allclose(times_s, source.true_s[: len(times_s)], rtol=0.0, atol=TICK_S)
    assert camera.dropped == (len(times_s) - 1) // 4  # seen by the frame after it


def test_a_terminal_that_the_device_lacks_is_one_line(served):
    _, file = served
    line = LINE.model_copy(update={"input": "PFI16"})
    with pytest.raises(DeviceError, match=r"has no such terminal.*-89120.*exposure\.input"):
        NidaqBoard(file.daq, file.describe().drive_limits, 1.0, line)


@pytest.mark.parametrize(
    ("camera", "exposure", "reported"),
    [
        (None, {}, "a section exposure, but no camera"),
        ({"kind": "folder", "path": "x"}, {}, "of kind 'folder' cannot have a section exposure"),
        ({"kind": "aravis"}, {"counter": "ctr0"}, "exposure.counter: ctr0 clocks the output"),
        ({"kind": "aravis"}, {"duration_s": 0.0}, "greater than 0"),
    ],
)
def test_an_invalid_section_is_refused(served, camera, exposure, reported):
    data = tomllib.loads(served[0].rig_file(ahead_blocks=1))
    data.pop("camera")
    data |= {"camera": camera} if camera else {}
    data["exposure"] = {"input": "PFI0", "duration_s": 1e-3, **exposure}
    with pytest.raises(ValidationError, match=reported):
        BenchConfig.model_validate(data)


@given(st.integers(0, 2**40), st.lists(st.integers(-(2**31), 2**31 - 1), max_size=5))
def test_a_counter_overflow_is_resolved_by_the_samples_read(position, offsets):
    true = np.array([position + offset for offset in offsets], dtype=np.int64)
    latched = (true % 2**32).astype(np.uint32)
    np.testing.assert_array_equal(unrolled(latched, position), true)
