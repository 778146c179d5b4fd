"""The writer's thread: order, room, faults; and a reader that sees each block as it is taken."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from haselab.base import DeviceError
from haselab.store.session.growing import GrowingDataset
from haselab.store.session.queue import JobQueue
from haselab.store.session.tail import TailReader
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionReader, SessionWriter

SAMPLES = 40
PLANS = [ExperimentPlan(name, "test", 1, {}) for name in ("a", "b")]


def full() -> DeviceError:
    return DeviceError("full")


def blocks_of(count: int) -> np.ndarray:
    rng = np.random.default_rng(6)
    return rng.integers(-32768, 32768, (count, SAMPLES, 2), dtype=np.int16)


def test_jobs_are_done_in_order_and_their_thread_ends() -> None:
    done: list[int] = []
    queue = JobQueue(QueueRule(chunks=3), full)
    for k in range(50):
        queue.put(lambda k=k: done.append(k))
    queue.drain()
    assert done == list(range(50)) and queue.most_waiting <= 3
    queue.close()
    queue.close()
    assert not queue._thread.is_alive()


def test_a_full_queue_is_a_fault_once_patience_has_ended() -> None:
    go = threading.Event()
    queue = JobQueue(QueueRule(chunks=2, patience_s=0.0), full)
    queue.put(go.wait)
    while queue._jobs:  # until the thread has taken it
        time.sleep(0.001)
    queue.put(lambda: None)
    queue.put(lambda: None)
    with pytest.raises(DeviceError, match="full"):
        queue.put(lambda: None)
    go.set()
    queue.close()


def test_after_a_failure_only_permanent_jobs_run_and_the_failure_is_raised_once() -> None:
    def fails() -> None:
        raise DeviceError("broken")

    done: list[str] = []
    go = threading.Event()
    queue = JobQueue(QueueRule(), full)
    queue.put(go.wait)
    queue.put(fails)
    queue.put(lambda: done.append("block"))
    queue.put(lambda: done.append("event"), always=True)
    go.set()
    with pytest.raises(DeviceError, match="broken"):
        queue.drain()
    assert done == ["event"]
    queue.put(lambda: done.append("later"))
    queue.close()
    assert done == ["event", "later"]


def test_in_real_time_a_disk_that_is_behind_is_a_device_fault_and_no_block_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, go = tmp_path / "session.h5", threading.Event()
    write = SessionWriter._write_blocks

    def stuck(self: SessionWriter, *args: object) -> None:
        go.wait()
        write(self, *args)

    monkeypatch.setattr(SessionWriter, "_write_blocks", stuck)
    session = SessionWriter(path, PLANS, SAMPLES, {}, QueueRule(chunks=2, patience_s=0.0))
    blocks, taken = blocks_of(100), 0
    behind = pytest.raises(
        DeviceError, match=r"The disk is too slow: 0\.2 s of data wait.*session\.h5$"
    )
    with behind:
        for k, block in enumerate(blocks):
            session.append_block("a", block, 0.01 * k, 0.0, 0.0)
            taken = k + 1
    # Two chunks wait, one is in work; the fourth, whose last block raised the error, is in tail.
    assert taken in (29, 39)
    with SessionReader(path) as reader:
        np.testing.assert_array_equal(reader.experiment("a").codes, blocks[: taken + 1])
    go.set()
    session.close()
    with SessionReader(path) as reader:
        np.testing.assert_array_equal(reader.experiment("a").codes, blocks[: taken + 1])


def test_a_reader_sees_each_block_as_soon_as_it_is_taken(tmp_path: Path) -> None:
    path, blocks = tmp_path / "session.h5", blocks_of(57)
    with (
        SessionWriter(path, PLANS, SAMPLES, {}) as session,
        SessionReader(path) as reader,
    ):
        for k, block in enumerate(blocks):
            session.append_block("b", block, 0.01 * k, 0.1 * k, float("nan"))
            rows = reader.follow("b", k)
            np.testing.assert_array_equal(rows.codes, blocks[k : k + 1])
            assert (rows.start_s, rows.drive_v) == (0.01 * k, 0.1 * k)
        np.testing.assert_array_equal(reader.follow("b", 0).codes, blocks)
        assert reader.follow("a", 0).codes.shape == (0, SAMPLES, 2)


def test_two_readers_of_one_process_see_new_chunks_of_every_table(tmp_path: Path) -> None:
    """More than a chunk of 1,000 rows, which HDF5 would mistake for the first one."""
    path, block = tmp_path / "session.h5", blocks_of(1)[0]
    with (
        SessionWriter(path, PLANS, SAMPLES, {}) as session,
        SessionReader(path) as one,
        SessionReader(path) as other,
    ):
        seen = 0
        for k in range(1200):
            session.append_block("a", block, 0.01 * k, float(k), 0.0)
            if k % 7 == 0:
                rows = [reader.follow("a", seen).drive_v for reader in (one, other)]
                seen = k + 1
                for each in rows:
                    np.testing.assert_array_equal(each, np.arange(seen - len(each), seen))


def test_a_reader_that_is_overtaken_amid_its_reading_sees_what_it_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ring of last blocks turns twice while the reader goes from the datasets to the ring."""
    path, block = tmp_path / "session.h5", blocks_of(1)[0]
    look, left = TailReader.rows, [900, 15]

    def write_then_look(tail: TailReader, experiment: int, first: int) -> object:
        for _ in range(left.pop(0) if left else 0):
            session.append_block("a", block, 0.0, float(next(rows)), 0.0)
        return look(tail, experiment, first)

    rows = itertools.count()
    with SessionWriter(path, PLANS, SAMPLES, {}) as session, SessionReader(path) as reader:
        for _ in range(5):
            session.append_block("a", block, 0.0, float(next(rows)), 0.0)
        monkeypatch.setattr(TailReader, "rows", write_then_look)
        seen = reader.follow("a", 0).drive_v
    assert not left
    np.testing.assert_array_equal(seen, np.arange(920.0))


def test_no_reader_sees_rows_that_a_dataset_has_room_for_but_does_not_hold_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reads after every growth of a dataset, before its new rows are written."""
    path, blocks = tmp_path / "session.h5", blocks_of(43)
    grow, seen = GrowingDataset._grow, []

    def grow_and_read(dataset: GrowingDataset, rows: int) -> None:
        grow(dataset, rows)
        found = reader.follow("a", 0)
        np.testing.assert_array_equal(found.drive_v, np.arange(1.0, 1.0 + len(found.drive_v)))
        np.testing.assert_array_equal(found.codes, blocks[: len(found.codes)])
        record = reader.experiment("a")
        assert np.all(record.frame_time_s > 0.0)
        assert np.all(record.tracks["x_px"] == 7.0)
        assert {what for _, what in reader.events()} <= {"one", "two"}
        seen.append(h5py.h5i.get_name(dataset._id).decode())

    tracks = np.zeros((1, 1), SessionWriter.track_dtype())
    tracks["x_px"] = 7.0
    with SessionWriter(path, PLANS, SAMPLES, {}) as session:
        session.append_block("a", blocks[0], 0.0, 1.0, 0.0)
        session.flush("a")
        with SessionReader(path) as reader:
            monkeypatch.setattr(GrowingDataset, "_grow", grow_and_read)
            for k, block in enumerate(blocks[1:], 1):
                session.append_block("a", block, 0.01 * k, 1.0 + k, 0.0)
            session.append_frames("a", np.array([1.0]), tracks, 0.0)
            session.event(1.0, "one")
            session.event(2.0, "two")
            session.flush("a")
            monkeypatch.undo()
    names = ("codes", "blocks", "start_s", "tracks", "frames", "frame_s")
    assert set(seen) == {"/events", *(f"/experiments/a/{name}" for name in names)}


def test_experiments_that_take_turns_keep_their_own_rows(tmp_path: Path) -> None:
    path, blocks = tmp_path / "session.h5", blocks_of(60)
    with SessionWriter(path, PLANS, SAMPLES, {}) as session:
        for k, block in enumerate(blocks):
            session.append_block("ab"[k // 7 % 2], block, 0.01 * k, 0.0, 0.0)
    with SessionReader(path) as reader:
        for number, name in enumerate("ab"):
            mine = [k for k in range(60) if k // 7 % 2 == number]
            np.testing.assert_array_equal(reader.experiment(name).codes, blocks[mine])


def test_data_are_synchronised_to_the_disk_once_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import os

    asked = []
    monkeypatch.setattr(os, "fdatasync", asked.append, raising=False)
    now_s = 0.0
    rule = QueueRule(clock_s=lambda: now_s)
    with SessionWriter(tmp_path / "s.h5", PLANS, SAMPLES, {}, rule) as session:
        for k, block in enumerate(blocks_of(300)):
            session.append_block("a", block, 0.01 * k, 0.0, 0.0)
            session._jobs.drain()
            now_s = 0.01 * (k + 1)
    assert len(asked) == 2


def test_a_growing_dataset_takes_rows_of_its_own_kind_only(tmp_path: Path) -> None:
    kind = np.dtype([("time_s", "<f8"), ("count", "<u4")])
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        growing = GrowingDataset(file.create_dataset("rows", (0, 2), kind, maxshape=(None, 2)))
        rows = np.zeros((5, 2), kind)
        rows["time_s"], rows["count"] = 0.5, np.arange(10).reshape(5, 2)
        growing.extend(rows[:3])
        growing.extend(rows[::-1][:2])  # not contiguous
        with pytest.raises(ValueError, match="shape"):
            growing.extend(np.zeros((1, 3), kind))
        assert len(growing) == 5
        np.testing.assert_array_equal(file["rows"][:], np.concatenate([rows[:3], rows[::-1][:2]]))


def test_a_job_for_a_closed_queue_is_refused_at_once() -> None:
    """It waited forever: STOP after a study hung, because its trip was to be recorded."""
    done: list[int] = []
    queue = JobQueue(QueueRule(), lambda: DeviceError("full"))
    queue.put(lambda: done.append(1))
    queue.close()
    assert done == [1]
    for always in (False, True):
        with pytest.raises(DeviceError, match="The recording is closed"):
            queue.put(lambda: done.append(2), always=always)
    queue.settle()
    assert done == [1]
