"""Raw frames become a lossless video in which every frame has the hash it was recorded with."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from haselab.base import DeviceError, InputError
from haselab.store.video.raw import RawVideoWriter, transcode, waiting_videos
from haselab.store.video.writer import VideoWriter, frame_hash

FRAMES = np.random.default_rng(5).integers(0, 256, (37, 48, 64), dtype=np.uint8)
TIMES_S = 2.0 + np.arange(37) / 100


def record(folder: Path, *, close: bool = True) -> RawVideoWriter:
    writer = RawVideoWriter(folder / "a.mkv", 100.0)
    for first in range(0, 37, 5):
        writer.append(FRAMES[first : first + 5], TIMES_S[first : first + 5])
    if close:
        writer.close()
    return writer


def decoded(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="gray") for frame in container.decode(video=0)])


def test_every_frame_comes_back_with_its_time_and_hash(tmp_path):
    record(tmp_path)
    (raw,) = waiting_videos(tmp_path)
    assert raw.read_bytes() == FRAMES.tobytes()
    video = transcode(raw)
    np.testing.assert_array_equal(decoded(video), FRAMES)
    rows = [line.split(",") for line in video.with_suffix(".csv").read_text().splitlines()]
    assert rows[0] == ["frame", "time_s", "hash"]
    assert [(int(k), float(t)) for k, t, _ in rows[1:]] == list(enumerate(TIMES_S))
    assert [h for _, _, h in rows[1:]] == [frame_hash(image) for image in FRAMES]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "a.mkv"]


def test_frames_of_a_killed_run_are_whole_up_to_its_end(tmp_path):
    writer = record(tmp_path, close=False)
    (raw,) = waiting_videos(tmp_path)
    raw.write_bytes(FRAMES.tobytes()[:-1000])  # the last frame was cut, and its row
    table = raw.with_suffix(".raw.csv")
    table.write_text(table.read_text()[:-7])
    np.testing.assert_array_equal(decoded(transcode(raw)), FRAMES[:36])
    writer._frames.close()
    writer._table.close()


def test_a_damaged_frame_is_reported_and_nothing_is_deleted(tmp_path):
    record(tmp_path)
    (raw,) = waiting_videos(tmp_path)
    data = bytearray(raw.read_bytes())
    data[48 * 64 * 3] ^= 1
    raw.write_bytes(data)
    with pytest.raises(InputError, match=r"Raw frame 3 is damaged.*a\.raw$"):
        transcode(raw)
    assert raw.exists()


def test_no_frames_leave_no_files_and_a_bad_path_is_reported(tmp_path):
    RawVideoWriter(tmp_path / "a.mkv", 100.0).close()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match=r"The video cannot be written .*a\.raw$"):
        RawVideoWriter(tmp_path / "file" / "a.mkv", 100.0)


def test_a_video_that_is_written_at_once_has_the_same_table(tmp_path):
    record(tmp_path / "raw")
    (raw,) = waiting_videos(tmp_path / "raw")
    writer = VideoWriter(tmp_path / "a.mkv", 100.0, hashed=True)
    for first in range(0, 37, 5):
        writer.append(FRAMES[first : first + 5], TIMES_S[first : first + 5])
    writer.close()
    made = transcode(raw)
    assert (tmp_path / "a.csv").read_text() == made.with_suffix(".csv").read_text()
    np.testing.assert_array_equal(decoded(tmp_path / "a.mkv"), FRAMES)
