"""Decode frames in the background and track points: a video as blocks of tracks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from haselab.base import HaselabError, InputError
from haselab.pipelines.prefetch import prefetch
from haselab.pipelines.tracking.points import State, Tracker
from haselab.pipelines.tracking.table import Block
from haselab.store.session.writer import SessionReader
from haselab.store.video.container import read_times
from haselab.store.video.opening import VideoReader
from haselab.tracking import FrameTracks, Tracks
from haselab.tracking.options import Frame

__all__ = ["Clock", "Opening", "UntilBroken", "blocks", "read_ahead", "read_clock"]

Timed = tuple[float, Frame]
Look = Callable[[int, Frame, FrameTracks], None]

_BATCH_BYTES = 8_000_000
_MOST_BATCH = 64
_BATCHES_AHEAD = 2


class Clock:
    """Times of frames, from a table, from a rate, or from the file.

    Args:
        rate_hz: overrides that of the file.
        times_s: override both.
        path: of the table.
        doubt: why the times are not verified; empty if they are.
    """

    def __init__(
        self,
        rate_hz: float | None = None,
        times_s: list[float] | None = None,
        path: Path | None = None,
        doubt: str = "",
    ) -> None:
        self._rate_hz, self._times_s, self._path = rate_hz, times_s, path
        self.doubt = doubt

    @property
    def rate_hz(self) -> float | None:
        """Mean rate of this clock; `None`: that of the file."""
        if self._times_s is None or len(self._times_s) < 2:
            return self._rate_hz
        span_s = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / span_s if span_s > 0.0 else None

    def of(self, video: VideoReader) -> Clock:
        """Adapt the clock to a video: remove the times of missing frames from the table.

        Raises:
        """
        if self._times_s is None or not video.missing:
            return self
        count = video.frame_count
        if len(self._times_s) == count + len(video.missing):
            kept = [self._times_s[video.number(index)] for index in range(count)]
            return Clock(self._rate_hz, kept, self._path, self.doubt)
        return self

    def time_s(self, index: int, file_s: float, number: int | None = None) -> float:
        """Time of a frame in s; `number` is its position in the recording if frames are missing.

        Raises:
            InputError: the table has too few times.
        """
        if self._times_s is not None:
            if index >= len(self._times_s):
                raise InputError(
                    f"The table of times has {len(self._times_s)} frames, but the video has more. "
                    f"Use the table of this video. {self._path}"
                )
            return self._times_s[index]
        place = index if number is None else number
        return file_s if self._rate_hz is None else place / self._rate_hz


def read_clock(
    rate_hz: float | None, times: Path | None, experiment: str | None, *, unverified: bool = False
) -> Clock:
    """Read the requested clock.

    Args:
        rate_hz: frames per second.
        times: CSV with the columns `frame,time_s`, or a session file.
        experiment: of the session.
        unverified: read a session whose checksums do not match.

    Raises:
        InputError: the table cannot be read, or has no times.
    """
    if times is None:
        return Clock(rate_hz)
    doubt = ""
    if times.suffix.lower() in (".h5", ".hdf5"):
        if experiment is None:
            raise InputError(f"--times names a session. Add --experiment NAME. {times}")
        with SessionReader(times, unverified=unverified) as session:
            doubt = session.doubt
            found = session.experiment(experiment).frame_time_s.tolist()
    else:
        found = read_times(times)
    if not found or not np.isfinite(found).all():
        raise InputError(
            f"The file has no times of frames. Use a CSV file with the columns frame,time_s, or a "
            f"session with --experiment. {times}"
        )
    return Clock(times_s=found, path=times, doubt=doubt)


def _batches(video: VideoReader, clock: Clock) -> Iterator[list[Timed] | HaselabError]:
    """Yield frames in batches; if the video breaks off, yield the error after the last one."""
    batch: list[Timed] = []
    size, clock = 1, clock.of(video)
    try:
        for index, (file_s, frame) in enumerate(video.timed()):
            if not batch:
                size = min(max(_BATCH_BYTES // max(frame.nbytes, 1), 1), _MOST_BATCH)
            batch.append((clock.time_s(index, file_s, video.number(index)), frame))
            if len(batch) == size:
                yield batch
                batch = []
    except HaselabError as error:
        if batch:
            yield batch
        yield error
        return
    if batch:
        yield batch


def read_ahead(video: VideoReader, clock: Clock) -> Iterator[list[Timed]]:
    """Yield frames with their times in batches, read and decoded in a background thread.

    At most three batches of 8 MB are in memory.

    Raises:
        HaselabError: the video breaks off; raised after its last whole frame.
    """
    for batch in prefetch(_batches(video, clock), _BATCHES_AHEAD):
        if isinstance(batch, HaselabError):
            raise batch
        yield batch


def blocks(
    batches: Iterator[list[Timed]],
    tracker: Tracker,
    state: State,
    look: Look,
    number: Callable[[int], int],
) -> Iterator[Block]:
    """Track the points in all frames; call `look` with each frame and its points.

    `number` converts the count of frames read before to the frame's number in the recording.
    """
    first = 0
    for batch in batches:
        rows = []
        for k, (_, frame) in enumerate(batch):
            state, found = tracker.step(state, frame)  # type: ignore[arg-type]
            look(first + k, frame, found)
            rows.append(found)
        numbers = np.array([number(first + k) for k in range(len(batch))], np.intp)
        yield Block(first, np.array([time for time, _ in batch]), Tracks.stack(rows), numbers)
        first += len(batch)


class Opening:
    """Gives access to the first frames of a video before tracking, without decoding them twice.

    Args:
        batches: from `read_ahead`.
        count: number of first frames.
    """

    def __init__(self, batches: Iterator[list[Timed]], count: int) -> None:
        self._batches = batches
        self._first: deque[list[Timed]] = deque()
        self._error: HaselabError | None = None
        found = 0
        try:
            while found < count and (batch := next(batches, None)) is not None:
                self._first.append(batch)
                found += len(batch)
        except HaselabError as error:
            if not self._first:
                raise
            self._error = error
        self.frames = [frame for batch in self._first for _, frame in batch]

    def all(self) -> Iterator[list[Timed]]:
        """Yield all batches from the first one; release the first frames on the way.

        Raises:
            HaselabError: the video breaks off, see `read_ahead`.
        """
        self.frames = []
        while self._first:
            yield self._first.popleft()
        if self._error is not None:
            raise self._error
        yield from self._batches


class UntilBroken:
    """Iterates over blocks up to an error, which is stored instead of raised.

    Args:
        items: of blocks.
    """

    def __init__(self, items: Iterator[Block]) -> None:
        self._items = items
        self.error: HaselabError | None = None

    def __iter__(self) -> Iterator[Block]:
        try:
            yield from self._items
        except HaselabError as error:
            self.error = error
