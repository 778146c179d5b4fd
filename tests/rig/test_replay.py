"""A recorded session as a rig: the same blocks and frames, and no answer to what was not asked."""

from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.replay import ReplayBench
from haselab.rig.rig_file import load_rig, opened_rig
from haselab.safety.gate import Gate
from haselab.store.session.writer import SessionReader

CARRIER = (2000.0, 0.02)  # of the recording, tests/rig/conftest.py


def drives(path: Path) -> np.ndarray:
    with SessionReader(path) as session:
        return np.concatenate([session.experiment(name).drive_v for name in ("rest", "steps")])


def test_the_recorded_blocks_come_again_in_their_order(recording: Path) -> None:
    with SessionReader(recording) as session:
        wanted = np.concatenate([session.experiment(name).codes for name in ("rest", "steps")])
        starts_s = np.concatenate(
            [session.experiment(name).block_start_s for name in ("rest", "steps")]
        )
    with ReplayBench(recording) as replay:
        rig = replay.rig
        rig.generator.sine(*CARRIER)
        for value, codes, start_s in zip(drives(recording), wanted, starts_s, strict=True):
            assert replay.next_output_v == value
            rig.source.write(value)
            np.testing.assert_array_equal(rig.acquisition.read(), codes)
            assert rig.acquisition.time_s == start_s + rig.description.block_s
        assert replay.next_output_v is None
        with pytest.raises(DeviceError, match=r"The recording ended after 48 blocks\. Play at"):
            rig.acquisition.read()


def test_another_output_than_the_recorded_one_is_reported(recording: Path) -> None:
    with ReplayBench(recording, ("steps",)) as replay:
        replay.rig.source.write(0.6)
        with pytest.raises(DeviceError, match=r"output in block 0 of 'steps' is 0.6 V, but 0.5"):
            replay.rig.acquisition.read()
        replay.rig.source.write(0.5)
        assert replay.rig.acquisition.read().shape == (2000, 2)


def test_another_carrier_than_the_recorded_one_is_reported(recording: Path) -> None:
    with ReplayBench(recording) as replay:
        with pytest.raises(DeviceError, match=r"sine is 1000 Hz, 0.02 V, but 2000"):
            replay.rig.generator.sine(1000.0, 0.02)
        with pytest.raises(LimitError, match=r"Sine of .* is outside"):
            replay.rig.generator.sine(-1.0, 0.02)


def test_the_kept_frames_come_with_the_time_that_passes(recording: Path) -> None:
    kept = np.load(recording.parent / "frames.npz")
    with ReplayBench(recording, ("steps",)) as replay:
        rig, images, times = replay.rig, [], []
        rig.camera.start(100.0)
        for value in drives(recording)[30:]:
            rig.source.write(value)
            rig.acquisition.read()
            frames = rig.camera.take()
            if frames is not None:
                assert frames.time_s[-1] <= rig.acquisition.time_s
                images.append(frames.images)
                times.append(frames.time_s)
        rig.camera.stop()
        assert rig.camera.take() is None
    np.testing.assert_array_equal(np.concatenate(times), kept["time_s"])
    np.testing.assert_array_equal(np.concatenate(images), kept["images"])


def test_waiting_passes_blocks_over(recording: Path) -> None:
    with ReplayBench(recording) as replay:
        start_s = replay.rig.acquisition.time_s
        replay.rig.stand.wait(0.05)
        assert replay.rig.acquisition.time_s == start_s + 0.05
        replay.rig.acquisition.read()
        assert replay.rig.acquisition.time_s == pytest.approx(start_s + 0.06, abs=1e-9)
        replay.rig.stand.wait(0.4)
        assert replay.next_output_v == 0.5


def test_no_session_and_no_experiment_are_one_line(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No session here"):
        ReplayBench(tmp_path / "none.h5")
    with pytest.raises(InputError, match=r"No experiment 'jump'; there are \['rest', 'steps'\]"):
        ReplayBench(recording, ("jump",))


def test_a_replay_opens_from_a_rig_file(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "replay.toml"
    path.write_text(f'kind = "replay"\nsession = "{recording}"\nexperiments = ["steps"]\n')
    with opened_rig(load_rig(path), path, Gate()) as rig:
        rig.source.write(0.5)
        assert rig.acquisition.read().shape == (2000, 2)
