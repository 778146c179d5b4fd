"""The session file: round trip, reading while it is written, and what a sudden end leaves."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from collections import namedtuple
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from haselab.base import DeviceError, InputError
from haselab.store.session import writer as module
from haselab.store.session.growing import GrowingDataset
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionReader, SessionWriter

SAMPLES = 400
PLANS = [
    ExperimentPlan("a", "triangle", 6, {"gain": 0.25, "what": "Größe"}),
    ExperimentPlan("b", "PI step", 6, {}),
    ExperimentPlan("never", "chirp", 6, {}),
]
HEADER = {"study": {"name": "test"}, "seed": 3, "versions": {"numpy": "x"}}


def blocks_of(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(-32768, 32768, (count, SAMPLES, 2), dtype=np.int16)


def tracks_of(frames: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = np.zeros((frames, 6), dtype=SessionWriter.track_dtype())
    for field in ("x_px", "y_px", "std_x_px", "std_y_px"):
        rows[field] = rng.standard_normal((frames, 6))
    rows["valid"] = rng.random((frames, 6)) > 0.2
    rows["x_px"][~rows["valid"]] = np.nan
    return rows


def write(path: Path, counts: dict[str, int]) -> None:
    """Blocks with a frame for each tenth of them, in the order of a run."""
    with SessionWriter(path, PLANS, SAMPLES, HEADER) as session:
        for name, count in counts.items():
            session.event(1.5, f"start {name}")
            for k, block in enumerate(blocks_of(count)):
                session.append_block(name, block, 2.0 + 0.01 * k, 0.1 * k, -0.01 * k)
            session.flush(name)
            session.append_frames(name, 2.0 + np.arange(7) / 40, tracks_of(7), 0.25)
            session.append_frames(name, 3.0 + np.arange(4) / 40, tracks_of(4, 1), 0.5)
            session.event(9.5, f"end {name}")


@pytest.mark.parametrize("count", [1, 9, 10, 11, 37])
def test_all_that_was_written_comes_back_bit_for_bit(tmp_path, count):
    path = tmp_path / "deep" / "session.h5"
    write(path, {"a": count, "b": 3})
    with SessionReader(path) as session:
        assert session.header == HEADER
        assert session.names == ["a", "b"]
        record = session.experiment("a")
        assert (record.name, record.kind, record.settings) == ("a", "triangle", PLANS[0].settings)
        np.testing.assert_array_equal(record.codes, blocks_of(count))
        np.testing.assert_array_equal(record.drive_v, 0.1 * np.arange(count))
        np.testing.assert_array_equal(record.reference, -0.01 * np.arange(count))
        np.testing.assert_array_equal(record.block_start_s, 2.0 + 0.01 * np.arange(count))
        assert record.tracks.tobytes() == tracks_of(7).tobytes() + tracks_of(4, 1).tobytes()
        np.testing.assert_array_equal(record.mass_kg, [0.25] * 7 + [0.5] * 4)
        assert record.frame_time_s[7] == 3.0
        assert session.events() == [
            (1.5, "start a"), (9.5, "end a"), (1.5, "start b"), (9.5, "end b"),
        ]  # fmt: skip


def test_the_writer_reads_what_is_recorded_so_far_as_a_later_reader_will(tmp_path):
    with SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER) as session:
        for k, block in enumerate(blocks_of(25)):
            session.append_block("a", block, 0.01 * k, 0.0, float("nan"))
        np.testing.assert_array_equal(session.experiment("a").codes, blocks_of(25))
        session.flush("a")
        session.event(1.0, "half way")
        np.testing.assert_array_equal(session.experiment("a").codes, blocks_of(25))
        assert session.events() == [(1.0, "half way")]


def test_settings_are_completed_or_refused_but_never_cut(tmp_path):
    path = tmp_path / "s.h5"
    with SessionWriter(path, PLANS, SAMPLES, HEADER) as session:
        session.append_frames("a", np.zeros(1), tracks_of(1), 0.0)
        session.complete_settings("a", {"kp": 0.5, "note": "ü" * 100})
        with pytest.raises(InputError, match=r"Settings of 'a' have \d+ bytes, but at most 65000"):
            session.complete_settings("a", {"note": "x" * 66_000})
    with SessionReader(path) as session:
        assert session.experiment("a").settings == {"kp": 0.5, "note": "ü" * 100}
    long = [ExperimentPlan("a", "k", 6, {"note": "x" * 66_000})]
    with pytest.raises(InputError, match="Settings of 'a' have"):
        SessionWriter(tmp_path / "t.h5", long, SAMPLES, HEADER)


def test_a_long_event_is_cut_between_characters(tmp_path):
    with SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER) as session:
        session.event(0.0, "x" * 95 + "ü")
        assert session.events() == [(0.0, "x" * 95)]


def test_closing_twice_and_closing_after_a_fault_are_fine(tmp_path):
    path = tmp_path / "s.h5"
    with (
        pytest.raises(ZeroDivisionError, match="by zero"),
        SessionWriter(path, PLANS, SAMPLES, HEADER) as session,
    ):
        session.append_block("a", blocks_of(1)[0], 0.0, 0.0, 0.0)
        raise ZeroDivisionError("by zero")
    session.close()
    with SessionReader(tmp_path / "s.h5") as reader:
        assert len(reader.experiment("a").codes) == 1


# ---- reading what cannot be read ------------------------------------------------------------


def test_no_file_no_experiment_and_no_session_have_different_errors(tmp_path):
    with pytest.raises(InputError, match=r"No session here; run a study first\. .*s\.h5$"):
        SessionReader(tmp_path / "s.h5")
    with pytest.raises(InputError, match="No session here"):
        SessionReader(tmp_path)
    write(tmp_path / "s.h5", {"a": 3})
    with SessionReader(tmp_path / "s.h5") as session, pytest.raises(
        InputError, match=r"No experiment 'never'; there are \['a'\]\. .*s\.h5$"
    ):  # fmt: skip
        session.experiment("never")
    with h5py.File(tmp_path / "other.h5", "w", libver=("v110", "v110")) as other:
        other["numbers"] = np.arange(5)
    (tmp_path / "text.h5").write_text("time_s,v_monitor_v\n0,1\n" * 50)
    for name in ("other.h5", "text.h5"):
        with pytest.raises(InputError, match=rf"not a complete haselab session \(.*{name}$"):
            SessionReader(tmp_path / name)


def test_a_session_cut_at_any_byte_is_refused_with_one_line(tmp_path):
    write(tmp_path / "s.h5", {"a": 25, "b": 5})
    data = (tmp_path / "s.h5").read_bytes()
    rng = np.random.default_rng(4)
    cuts = {0, 1, 7, 8, 35, 36, len(data) - 1, *rng.integers(0, len(data), 60).tolist()}
    path = tmp_path / "cut.h5"
    for cut in sorted(cuts):
        path.write_bytes(data[:cut])
        with pytest.raises(
            InputError, match=r"^The file is not a complete haselab session \(.*cut\.h5$"
        ) as caught:
            SessionReader(path)
        assert "\n" not in str(caught.value)


# ---- sudden ends ----------------------------------------------------------------------------

_ENDLESS = """
    import sys
    from pathlib import Path
    sys.path.insert(0, {tests!r})
    from test_session import HEADER, PLANS, SAMPLES, SessionWriter, blocks_of, np, tracks_of
    block = blocks_of(1)[0]
    session = SessionWriter(Path(sys.argv[1]), PLANS, SAMPLES, HEADER)
    session.event(0.0, "start a")
    for k in range(10_000_000):
        session.append_block("a", block, 0.01 * k, 0.5, 0.0)
        if k % 20 == 19:
            session.append_frames("a", 0.01 * k + np.arange(8) / 40, tracks_of(8), 0.25)
        print(k + 1, flush=True)
"""


@pytest.fixture
def writer(tmp_path: Path) -> Any:
    """A process that writes blocks for ever and says after each how many."""
    code = textwrap.dedent(_ENDLESS).format(tests=str(Path(__file__).parent))
    command = [sys.executable, "-c", code, str(tmp_path / "s.h5")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if int(line) >= 100:
                break
        yield process
        process.kill()


def test_a_session_can_be_read_while_it_is_written(tmp_path, writer):
    block, seen = blocks_of(1)[0], [0]
    while len(seen) < 25:
        with SessionReader(tmp_path / "s.h5") as session:
            record, events = session.experiment("a"), session.events()
        count = len(record.codes)
        assert count >= seen[-1]
        seen.append(count)
        np.testing.assert_array_equal(record.block_start_s, 0.01 * np.arange(count))
        np.testing.assert_array_equal(record.codes[-1], block)
        frames = len(record.frame_time_s)
        last = 0.01 * (20 * np.arange(frames // 8) + 19)
        np.testing.assert_array_equal(
            record.frame_time_s, (last[:, None] + np.arange(8) / 40).ravel()
        )
        assert len(record.tracks) == frames
        for _ in range(20):
            writer.stdout.readline()
    assert writer.poll() is None
    assert events == [(0.0, "start a")]
    assert seen[-1] > seen[1] and frames > 0  # it did grow under the reader's eyes


def test_rows_that_move_to_their_table_between_two_looks_are_found(tmp_path, writer, monkeypatch):
    began, missed = SessionReader._began, [True]
    monkeypatch.setattr(
        SessionReader,
        "_began",
        lambda self, group: not (missed and missed.pop()) and began(self, group),
    )
    with SessionReader(tmp_path / "s.h5") as session:
        assert "a" in session.names


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX's")
def test_a_killed_writer_loses_no_block_that_it_took(tmp_path, writer):
    os.kill(writer.pid, signal.SIGKILL)
    written = int((writer.stdout.read().split() or ["100"])[-1])
    with SessionReader(tmp_path / "s.h5") as session:
        record = session.experiment("a")
        assert session.events() == [(0.0, "start a")]
    # One more than was reported if the end came between writing and reporting.
    assert written <= len(record.codes) <= written + 1
    np.testing.assert_array_equal(record.block_start_s, 0.01 * np.arange(len(record.codes)))
    np.testing.assert_array_equal(record.codes, np.stack([blocks_of(1)[0]] * len(record.codes)))
    waiting = QueueRule().chunks + 1  # jobs that the thread had not come to
    assert len(record.frame_time_s) >= 8 * (written // 20 - waiting)


_READ_ALL = """
    import sys
    from haselab.base import InputError
    from haselab.store.session.writer import SessionReader
    from pathlib import Path
    for path in sorted(Path(sys.argv[1]).glob("cut-*.h5")):
        try:
            with SessionReader(path) as session:
                count = len(session.experiment("a").codes)
            print(path.name, count)
        except InputError as error:
            assert str(error).endswith(str(path)) and "\\n" not in str(error), error
            print(path.name, "refused")
"""


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX's")
def test_a_truncated_copy_of_a_killed_session_is_read_or_refused_in_time(tmp_path, writer):
    os.kill(writer.pid, signal.SIGKILL)
    writer.wait()
    data = (tmp_path / "s.h5").read_bytes()
    cuts = np.random.default_rng(6).integers(0, len(data), 25)
    for k, cut in enumerate(cuts):
        (tmp_path / f"cut-{k:02d}.h5").write_bytes(data[:cut])
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(_READ_ALL), str(tmp_path)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(cuts)


Usage = namedtuple("Usage", "total used free")


def test_a_full_disk_stops_the_recording_while_the_file_can_still_be_finished(
    tmp_path, monkeypatch
):
    path = tmp_path / "s.h5"
    free = 20_000_000
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**9, 10**9 - free, free))
    full = pytest.raises(DeviceError, match=r"The disk is full: 5 MB are left, 8 MB .*s\.h5$")
    with full, SessionWriter(path, PLANS, SAMPLES, HEADER) as session:
        for k, block in enumerate(blocks_of(45)):
            session.append_block("a", block, 0.01 * k, 0.0, 0.0)
            free = 20_000_000 if k < 25 else 5_000_000
    with SessionReader(path) as reader:
        np.testing.assert_array_equal(reader.experiment("a").codes, blocks_of(45)[:30])


def test_the_reserve_takes_the_note_of_how_it_ended(tmp_path, monkeypatch):
    with SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER) as session:
        session.append_frames("a", np.zeros(1), tracks_of(1), 0.0)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1, 1, 0))
        with pytest.raises(DeviceError, match="The disk is full"):
            session.append_frames("a", np.ones(1), tracks_of(1), 0.0)
        session.event(1.0, "ended by DeviceError; output at 0 V")
    with SessionReader(tmp_path / "s.h5") as reader:
        assert reader.events() == [(1.0, "ended by DeviceError; output at 0 V")]
        assert len(reader.experiment("a").frame_time_s) == 1


def test_a_full_disk_is_reported_before_the_first_block(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1, 1, 0))
    with pytest.raises(DeviceError, match="The disk is full: 0 MB are left"):
        SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER)


def test_a_drive_that_has_gone_is_one_line(tmp_path, monkeypatch):
    def gone(_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(shutil, "disk_usage", gone)
    with pytest.raises(DeviceError, match=r"cannot be written .*Input/output error"):
        SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER)


@pytest.mark.parametrize("method", ["event", "append_frames", "flush"])
def test_a_write_that_hdf5_refuses_is_a_device_error(tmp_path, monkeypatch, method):
    session = SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER)
    session.append_block("a", blocks_of(1)[0], 0.0, 0.0, 0.0)

    def refused(*_: object, **__: object) -> None:
        raise RuntimeError("Unable to flush dataset (file write failed: ...)\nmore\nlines")

    calls = {
        "event": lambda: session.event(0.0, "x"),
        "append_frames": lambda: session.append_frames("a", np.zeros(1), tracks_of(1), 0.0),
        "flush": lambda: None,
    }
    with monkeypatch.context() as patch:
        patch.setattr(GrowingDataset, "_grow", refused)
        with pytest.raises(DeviceError, match=r"cannot be written \(Unable .*s\.h5$") as caught:
            calls[method]()
            session.flush("a")
    assert "\n" not in str(caught.value)
    with contextlib.suppress(DeviceError):
        session.close()
    with SessionReader(tmp_path / "s.h5") as reader:
        np.testing.assert_array_equal(reader.experiment("a").codes, blocks_of(1))


def test_a_file_that_is_deleted_while_it_is_recorded_is_named(tmp_path):
    session = SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER)
    (tmp_path / "s.h5").unlink()
    with pytest.raises(DeviceError, match=r"is no longer there: it was deleted.*s\.h5$"):
        for _ in range(2000):
            session.append_block("a", blocks_of(1)[0], 0.0, 0.0, 0.0)
            session.flush("a")
    with contextlib.suppress(DeviceError):
        session.close()
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_hold_a_session_is_a_device_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match=r"cannot be written \(.*session\.h5$"):
        SessionWriter(tmp_path / "file" / "session.h5", PLANS, SAMPLES, HEADER)
    (tmp_path / "session.h5").mkdir()
    with pytest.raises(InputError, match=r"The folder has a session already.*session\.h5$"):
        SessionWriter(tmp_path / "session.h5", PLANS, SAMPLES, HEADER)


def test_the_limit_of_a_process_on_file_sizes_counts_as_a_full_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_size_limit", lambda: 9_000_000)
    session = SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, HEADER)
    with pytest.raises(DeviceError, match=r"The disk is full: 7\.\d MB are left, 8 MB are"):
        for k in range(2000):
            session.append_block("a", blocks_of(1, k)[0], 0.01 * k, 0.0, 0.0)
    session.close()
    assert (tmp_path / "s.h5").stat().st_size < 9_000_000


def test_a_block_is_kept_as_it_was_when_it_came(tmp_path):
    """An acquisition that uses one array for all its blocks."""
    path, codes = tmp_path / "s.h5", np.zeros((20, 2), np.int16)
    with SessionWriter(path, [ExperimentPlan("a", "play", 1, {})], 20, {}) as session:
        for k in range(30):
            codes[:] = k
            session.append_block("a", codes, 0.01 * k, 0.0, 0.0)
    with SessionReader(path) as session:
        assert session.experiment("a").codes[:, 0, 0].tolist() == list(range(30))


@pytest.mark.parametrize(
    "codes", [np.zeros((20, 2)), np.zeros((20, 2), np.int8), np.zeros((1, 2), np.int16), None]
)
def test_a_block_of_another_form_is_refused(tmp_path, codes):
    plans = [ExperimentPlan("a", "play", 1, {})]
    with (
        SessionWriter(tmp_path / "s.h5", plans, 20, {}) as session,
        pytest.raises(DeviceError, match=r"the session takes \(20, 2\), int16"),
    ):
        session.append_block("a", codes, 0.0, 0.0, 0.0)
