"""Video out: exact grey levels, the time of each frame, and what a failing disk leaves."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError
from haselab.store.video.opening import open_video
from haselab.store.video.writer import VideoWriter, write_png


def pictures(count: int, shape: tuple[int, int] = (48, 64), seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, *shape), dtype=np.uint8)


def read_back(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with open_video(path) as video:
        time_s, images = zip(*video.timed(), strict=True)
    return np.array(time_s), np.stack(images)


@pytest.mark.parametrize("name", ["a.mkv", "a.avi"])
@pytest.mark.parametrize("shape", [(48, 64), (512, 512), (47, 65), (64, 4)])
def test_frames_come_back_exact_to_the_grey_level_in_their_order(tmp_path, shape, name):
    images = pictures(23, shape)
    images[3], images[4] = 0, 255
    time_s = 12.5 + np.cumsum(np.random.default_rng(1).uniform(0.002, 0.003, 23))
    writer = VideoWriter(tmp_path / "new" / name, 400.0)
    for part in np.array_split(np.arange(23), 7):
        writer.append(images[part], time_s[part])
    writer.close()
    back_s, back = read_back(tmp_path / "new" / name)
    np.testing.assert_array_equal(back, images)
    # The reader counts from the first frame; the table itself holds the acquisition's clock.
    np.testing.assert_allclose(back_s, time_s - time_s[0], atol=1e-12)
    table = np.genfromtxt(tmp_path / "new" / "a.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table["frame"], np.arange(23))
    np.testing.assert_array_equal(table["time_s"], time_s)


def test_a_gap_in_time_stays_a_gap(tmp_path):
    writer = VideoWriter(tmp_path / "a.mkv", 100.0)
    writer.append(pictures(3), np.array([0.0, 0.01, 0.02]))
    writer.append(pictures(2), np.array([9.0, 9.01]))
    writer.close()
    np.testing.assert_allclose(
        read_back(tmp_path / "a.mkv")[0], [0.0, 0.01, 0.02, 9.0, 9.01], atol=1e-12
    )


def test_batches_keep_their_order_however_many_wait(tmp_path):
    images = pictures(4)
    writer = VideoWriter(tmp_path / "a.mkv", 100.0)
    for k in range(20):
        writer.append(images + np.uint8(k), np.arange(4) * 0.01 + k)
    writer.close()
    wanted = np.concatenate([images + np.uint8(k) for k in range(20)])
    np.testing.assert_array_equal(read_back(tmp_path / "a.mkv")[1], wanted)


def test_a_video_without_a_frame_leaves_no_file(tmp_path):
    writer = VideoWriter(tmp_path / "a.mkv", 100.0)
    writer.append(pictures(0), np.empty(0))
    writer.close()
    assert list(tmp_path.iterdir()) == []


def test_the_times_of_an_older_video_do_not_outlive_it(tmp_path):
    (tmp_path / "a.csv").write_text("frame,time_s\n0,77.0\n")
    VideoWriter(tmp_path / "a.mkv", 100.0).close()
    assert not (tmp_path / "a.csv").exists()


def test_a_folder_that_cannot_be_made_is_a_device_error_with_the_path_last(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match=r"cannot be written \(.*\)\. Part of the path.*a\.mkv$"):
        VideoWriter(tmp_path / "file" / "a.mkv", 100.0)
    with pytest.raises(DeviceError, match=r"cannot be written \(.*\)\. Part of the path.*a\.png$"):
        write_png(tmp_path / "file" / "a.png", pictures(1)[0])


_FULL = """
    import resource, signal, sys
    from pathlib import Path
    import numpy as np
    from haselab.base import DeviceError
    from haselab.store.video.writer import VideoWriter
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
    rng = np.random.default_rng(0)
    writer = VideoWriter(Path(sys.argv[1]), 100.0)
    try:
        for k in range(200):
            writer.append(rng.integers(0, 256, (5, 64, 64), dtype=np.uint8), np.arange(5) + 5.0 * k)
    except DeviceError as error:
        print(error)
    try:
        writer.close()
    except DeviceError as error:
        print(error)
"""


@pytest.mark.skipif(os.name == "nt", reason="limits of a process are POSIX")
def test_a_disk_that_fills_up_is_reported_and_the_recorded_data_can_be_read(tmp_path):
    path = tmp_path / "a.mkv"
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(_FULL), str(path)],
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert done.stderr == ""
    assert 1 <= len(lines) <= 2
    for line in lines:
        assert line.startswith("The video cannot be written (File too large). Free disk space")
        assert line.endswith(str(path))
    images = read_back(path)[1]
    whole = np.random.default_rng(0).integers(0, 256, (5, 64, 64), dtype=np.uint8)
    np.testing.assert_array_equal(images[:5], whole)
    # Noise does not shrink: 4 kB a frame; the container holds back one cluster of at most 32 kB.
    assert len(images) > 10
