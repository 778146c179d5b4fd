"""What a kill leaves becomes an ordinary file again, with every block that was taken."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pytest

from haselab.base import DeviceError, InputError
from haselab.store.manifest import Manifest, changed_files, read_manifest, sha256_of
from haselab.store.session.recover import recover
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter
from haselab.store.video.raw import RawVideoWriter

SAMPLES = 400
PLANS = [ExperimentPlan(name, "test", 6, {}) for name in ("a", "b")]
THEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)

_KILLED = """
    import os, signal, sys
    from pathlib import Path
    sys.path.insert(0, {tests!r})
    from test_session_recover import *
    folder, blocks = Path(sys.argv[1]), blocks_of(int(sys.argv[2]))
    manifest = Manifest(folder, {{"seed": 3}})
    session = SessionWriter(folder / "session.h5", PLANS, SAMPLES, {{}})
    session.event(0.0, "start a")
    for k, block in enumerate(blocks):
        session.append_block("a", block, 0.01 * k, 0.5, 0.0)
    os.kill(os.getpid(), signal.SIGKILL)
"""
posix = pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX's")


def blocks_of(count: int) -> np.ndarray:
    rng = np.random.default_rng(2)
    return rng.integers(-32768, 32768, (count, SAMPLES, 2), dtype=np.int16)


def killed(folder: Path, count: int) -> None:
    code = textwrap.dedent(_KILLED).format(tests=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, "-c", code, str(folder), str(count)], check=False)
    assert done.returncode == -signal.SIGKILL


@posix
@pytest.mark.parametrize("count", [1, 10, 137])
def test_every_block_of_a_killed_recording_is_in_an_ordinary_file_again(tmp_path, count):
    killed(tmp_path, count)
    assert read_manifest(tmp_path)["state"] == "OPEN"
    with SessionReader(tmp_path / "session.h5") as session:  # before it is mended, too
        np.testing.assert_array_equal(session.experiment("a").codes, blocks_of(count))
    found = recover(tmp_path)
    assert (found.state, found.blocks, found.writer_mark_cleared) == (
        "RECOVERED",
        {"a": count},
        True,
    )
    with h5py.File(tmp_path / "session.h5", "r") as file:  # no SWMR, no tail
        np.testing.assert_array_equal(file["experiments/a/codes"], blocks_of(count))
        np.testing.assert_array_equal(file["experiments/a/start_s"], 0.01 * np.arange(count))
        np.testing.assert_array_equal(file["experiments/a/blocks"]["drive_v"], 0.5)
        assert file["events"][-1]["what"].startswith(b"recovered; ")
    manifest = read_manifest(tmp_path)
    assert (manifest["state"], manifest["seed"]) == ("RECOVERED", 3)
    again = recover(tmp_path)
    assert (again.state, again.blocks_from_ring_buffer, again.changed_files) == ("RECOVERED", 0, [])


@posix
def test_stock_hdf5_opens_what_was_mended(tmp_path, installed):
    killed(tmp_path, 37)
    command = [installed("h5dump", "hdf5-tools"), "-H", str(tmp_path / "session.h5")]
    recover(tmp_path)
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0 and "( 37, 400, 2 )" in done.stdout


@posix
def test_a_session_that_is_still_written_is_left_alone(tmp_path):
    path = tmp_path / "session.h5"
    with SessionWriter(path, PLANS, SAMPLES, {}) as session:
        session.append_block("a", blocks_of(1)[0], 0.0, 0.0, 0.0)
        before = path.read_bytes()
        code = "import sys, pathlib; from haselab.store.session.recover import recover; " \
               "recover(pathlib.Path(sys.argv[1]))"  # fmt: skip
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True,
                              text=True, check=False)  # fmt: skip
        assert "DeviceError: The session is still being written" in done.stderr
        with pytest.raises(DeviceError, match="still being written"):
            recover(tmp_path)
        assert path.read_bytes() == before
    assert recover(tmp_path).state == "SEALED"  # its writer closed it; only the manifest is missing
    ended = json.loads((tmp_path / "manifest.json").read_text())["ended"]
    assert ended == "unknown: the manifest was missing"


def test_a_second_writer_is_refused_and_the_first_one_keeps_every_block(tmp_path):
    path = tmp_path / "session.h5"
    with SessionWriter(path, PLANS, SAMPLES, {}) as session:
        for k, block in enumerate(blocks_of(25)):
            session.append_block("a", block, 0.01 * k, 0.5, 0.0)
            if k == 12:
                session.flush("a")  # its own thread writes nothing more
                before = path.read_bytes()
                with pytest.raises(InputError, match=r"The folder has a session already; it was"):
                    SessionWriter(path, PLANS, SAMPLES, {})
                assert path.read_bytes() == before
    with SessionReader(path) as reader:
        np.testing.assert_array_equal(reader.experiment("a").codes, blocks_of(25))


def test_a_manifest_states_provenance_and_hashes(tmp_path):
    with Manifest(tmp_path, {"seed": 7, "versions": {"numpy": "2"}}, clock=lambda: THEN):
        assert read_manifest(tmp_path)["state"] == "OPEN"
        with SessionWriter(tmp_path / "session.h5", PLANS, SAMPLES, {}):
            pass
        (tmp_path / "video").mkdir()
        (tmp_path / "video" / "a.mkv").write_bytes(b"frames")
        (tmp_path / "results.json").write_text("{}")  # made anew by every analysis
    manifest = read_manifest(tmp_path)
    assert (manifest["state"], manifest["ended"], manifest["seed"]) == ("SEALED", "complete", 7)
    assert manifest["opened"] == manifest["closed"] == "2026-01-02T03:04:05+00:00"
    assert set(manifest["files"]) == {"session.h5", "video/a.mkv"}
    # SHA-256 of "frames" by coreutils' sha256sum
    assert sha256_of(tmp_path / "video" / "a.mkv") == manifest["files"]["video/a.mkv"]["sha256"]
    assert changed_files(tmp_path, manifest) == []
    (tmp_path / "video" / "a.mkv").write_bytes(b"Frames")
    (tmp_path / "video" / "b.mkv").write_bytes(b"")
    assert changed_files(tmp_path, manifest) == ["video/a.mkv", "video/b.mkv"]
    assert recover(tmp_path).changed_files == ["video/a.mkv", "video/b.mkv"]


@posix
def test_raw_frames_of_a_killed_recording_become_videos(tmp_path):
    killed(tmp_path, 3)
    frames = np.arange(4 * 32 * 48, dtype=np.uint8).reshape(4, 32, 48)
    writer = RawVideoWriter(tmp_path / "video" / "a.mkv", 100.0)
    writer.append(frames, np.arange(4) / 100)
    writer.close()
    assert recover(tmp_path).videos_encoded == 1
    assert set(read_manifest(tmp_path)["files"]) == {"session.h5", "video/a.csv", "video/a.mkv"}


def test_a_run_that_fails_is_sealed_with_its_reason(tmp_path):
    with pytest.raises(ZeroDivisionError, match="by"), Manifest(tmp_path, {}, clock=lambda: THEN):
        raise ZeroDivisionError("by\nzero")
    assert read_manifest(tmp_path)["ended"] == "ZeroDivisionError: by zero"


def test_what_is_no_recording_is_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match=r"No session here.*session\.h5$"):
        recover(tmp_path)
    (tmp_path / "manifest.json").write_text(json.dumps({"format": "x"}))
    SessionWriter(tmp_path / "session.h5", PLANS, SAMPLES, {}).close()
    with pytest.raises(InputError, match=r"not a haselab manifest.*manifest\.json$"):
        recover(tmp_path)
