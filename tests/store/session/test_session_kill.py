"""A kill at any moment: every state of the file that it can leave is read, with every block.

A process writes a session, and a preloaded library records its writes in order. A kill leaves those
before it; of the last write of each thread, which may still run, only whole pages of the system's
cache. These states are made and read here, so that no kill has to come at the right moment.
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from haselab.store.session.layout import read_events, read_experiment
from haselab.store.session.opening import open_unsealed
from haselab.store.session.probe import verify
from haselab.store.session.tail import TailReader

BLOCKS, SAMPLES, PAGE = 56, 400, 4096
WRITTEN, TRUNCATED, ALLOCATED, SAID = range(4)
METADATA = (b"OHDR", b"OCHK", b"EAHD", b"EAIB", b"EASB", b"EADB", b"BTHD", b"BTIN", b"BTLF")
# The ring has 4 chunks of 10 blocks, so that blocks replace others in it. A short sleep lets the
# thread that packs chunks write between two blocks.
_WRITER = """
    import os, sys, time
    from pathlib import Path
    import numpy as np
    from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionWriter

    path, blocks, samples = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    header = {"rig": {"rate_hz": float(sys.argv[4])}} if sys.argv[4:] else {}
    rng = np.random.default_rng(1)
    plans = [ExperimentPlan("a", "chirp", 6, {})]
    session = SessionWriter(path, plans, samples, header, QueueRule(chunks=1))
    session.event(0.0, "start a")
    for k in range(blocks):
        codes = rng.integers(-9000, 9000, (samples, 2), dtype=np.int16)
        session.append_block("a", codes, 0.01 * k, 0.5, 0.0)
        os.write(1, b"%d" % (k + 1))
        if k % 20 == 19:
            tracks = np.zeros((8, 6), SessionWriter.track_dtype())
            session.append_frames("a", 0.01 * k + np.arange(8) / 40, tracks, 0.25)
        time.sleep(0.002)
    os._exit(0)
"""


class Call(NamedTuple):
    """One recorded call."""

    thread: int
    kind: int
    offset: int
    length: int
    data: bytes

    def cuts(self) -> list[int]:
        """How many of its bytes a kill may leave, if not all."""
        ends = range((self.offset // PAGE + 1) * PAGE, self.offset + self.length, PAGE)
        return [0, *(end - self.offset for end in ends)] if self.kind == WRITTEN else [0]

    def apply(self, image: bytearray, length: int | None = None) -> None:
        """Change the file as the call did, or as its first bytes would have."""
        if length == 0 or self.kind == SAID:
            return
        data = self.data[:length]
        end = self.length if self.kind == TRUNCATED else self.offset + (len(data) or self.length)
        if self.kind == TRUNCATED:
            del image[end:]
        image.extend(bytes(max(0, end - len(image))))
        image[self.offset : self.offset + len(data)] = data


def parsed(log: bytes) -> Iterator[Call]:
    place = 0
    while place < len(log):
        thread, kind, offset, length = struct.unpack_from("<4Q", log, place)
        place += 32
        stored = length if kind in (WRITTEN, SAID) else 0
        yield Call(thread, kind, offset, length, log[place : place + stored])
        place += stored


# Blocks of 0.1 s are chunks of their own: the index of 51 chunks is one node of HDF5's tree, and
# that of more is split.
@pytest.fixture(scope="module", params=[(), (10.0 * SAMPLES,)], ids=["10 blocks", "1 block"])
def calls(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Call]:
    """All calls of a writer that is killed after its last block."""
    return recorded_calls(tmp_path_factory, BLOCKS, SAMPLES, *request.param)


def recorded_calls(factory: pytest.TempPathFactory, *arguments: float) -> list[Call]:
    """All calls of a writer: blocks, samples of each and, if it is not unknown, the rate."""
    compiler = shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        pytest.skip("recording the writes needs Linux and a C compiler")
    folder = factory.mktemp("recorded")
    library, path = folder / "record.so", folder / "s.h5"
    source = Path(__file__).with_name("record_writes.c")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-pthread", str(source), "-o", str(library)],
        check=True,
    )
    recorded = {"LD_PRELOAD": str(library), "RECORDED_FILE": str(path.resolve()),
                "RECORDED_LOG": str(folder / "log")}  # fmt: skip
    for _ in range(3):  # the kill may come between a write of another thread and its entry
        subprocess.run(
            [sys.executable, "-c", textwrap.dedent(_WRITER), path, *map(str, arguments)],
            check=True, env=os.environ | recorded, stdout=subprocess.DEVNULL, timeout=300,
        )  # fmt: skip
        found = list(parsed((folder / "log").read_bytes()))
        image = bytearray()
        for call in found:
            call.apply(image)
        if bytes(image) == path.read_bytes():
            return found
        path.unlink()
        (folder / "log").unlink()
    raise AssertionError("something was written in another way")


def states(calls: list[Call]) -> Iterator[tuple[int, bytearray]]:
    """Acknowledged blocks and file of each state that a kill may leave.

    From the first block on; from where the index is about to be split, if each block is a chunk.
    """
    said = [k for k, call in enumerate(calls) if call.kind == SAID]
    nodes = sum(call.data[:4] == b"BTLF" for call in calls)
    start = said[48 if nodes >= BLOCKS else 0]
    for end in range(start, len(calls)):
        done = calls[: end + 1]
        said = sum(call.kind == SAID for call in done)
        last = {call.thread: k for k, call in enumerate(done)}
        running = [k for k in last.values() if k > start and done[k].kind != SAID]
        if calls[end].kind != SAID:
            yield said, state(done, {})
        for k in running:
            for cut in done[k].cuts():
                if k < end or cut:  # else: the state before it
                    yield said, state(done, {k: cut})
        if len(running) > 1 and end not in running[:-1]:
            yield said, state(done, dict.fromkeys(running[:-1], 0))


def state(calls: list[Call], cut: dict[int, int]) -> bytearray:
    image = bytearray()
    for k, call in enumerate(calls):
        call.apply(image, cut.get(k))
    return image


@pytest.mark.long
def test_a_kill_at_any_moment_loses_no_block_and_leaves_a_readable_session(
    calls: list[Call], tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    drawn = [rng.integers(-9000, 9000, (SAMPLES, 2), dtype=np.int16) for _ in range(BLOCKS)]
    codes = np.stack(drawn)
    path, count = tmp_path / "s.h5", 0
    for said, image in states(calls):
        path.write_bytes(image)
        assert verify(path) == ("", [])
        with open_unsealed(path) as file:
            tail = TailReader(file, path)
            record = read_experiment(file, "a", tail, verify=True)
            assert read_events(file) == [(0.0, "start a")]
            tail.close()
        assert said <= len(record.codes) <= said + 1
        np.testing.assert_array_equal(record.codes, codes[: len(record.codes)])
        count += 1
    assert count > BLOCKS


@pytest.mark.long
def test_no_record_of_hdf5_and_no_number_of_a_slot_lies_across_two_pages(calls: list[Call]) -> None:
    """Else a kill between the two pages would leave a checksum that does not match."""
    written = after_the_first_block(calls)
    slot = 56 + 4 * SAMPLES
    places = {call.offset % 8 for call in written if call.length == slot}
    assert places == {0}


def after_the_first_block(calls: list[Call]) -> list[Call]:
    """What was written; no record of HDF5 in it lies across two pages."""
    start = next(k for k, call in enumerate(calls) if call.kind == SAID)
    written = [call for call in calls[start:] if call.kind == WRITTEN]
    records = [call for call in written if call.data[:4] in METADATA]
    assert len(records) > 10
    assert all(call.cuts() == [0] for call in records)
    return written


@pytest.mark.long
def test_the_index_of_a_long_recording_lies_in_single_pages(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """205 s: the index was an array whose parts then exceeded a page."""
    after_the_first_block(recorded_calls(tmp_path_factory, 2100, 20_000, 2e5))
