"""A recorded session as a rig, which replays its blocks and compares every request with them.

For work on sensing and loops without hardware. A request for an output other than the recorded one
is refused, because the next recorded block does not show its effect.
"""

from __future__ import annotations

import csv
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, DeviceError, InputError, LimitError, Limits
from haselab.rig import Frames, Rig, RigDescription
from haselab.rig.operator import check_mass, check_wait
from haselab.store.session.writer import SessionReader
from haselab.store.video.opening import open_video

__all__ = ["ReplayBench"]

_FASTEST_FRAMES_HZ = 1e6
_SAME_V = 1e-9  # outputs are recorded as requested


@dataclass(frozen=True)
class _Block:
    """Position of one block in the session."""

    start_s: float
    experiment: str
    index: int


@dataclass(frozen=True)
class _Film:
    """Kept frames of one experiment, and the middle of their exposures in s, rising."""

    path: Path
    time_s: list[float]


def _described(header: Mapping[str, Any], path: Path) -> RigDescription:
    try:
        fields = dict(header["rig"])
        fields["drive_limits"] = Limits(**fields["drive_limits"])
        return RigDescription(**fields)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"The session's header is damaged ({error}). {path}") from None


def _films(folder: Path) -> list[_Film]:
    found = []
    for path in sorted([*folder.glob("*.mkv"), *folder.glob("*.avi")]):
        table = path.with_suffix(".csv")
        if table.is_file():
            with table.open(newline="") as rows:
                found.append(_Film(path, [float(row["time_s"]) for row in csv.DictReader(rows)]))
    return found


class ReplayBench(Closing):
    """Replays a session; implements the protocols of `haselab.rig`. Use as a context.

    Args:
        path: of session.h5; kept videos are in the folder `video` beside it.
        experiments: names of the experiments; empty: all that have blocks.
    Raises:
        InputError: The session or an experiment does not exist or has no blocks.
    """

    def __init__(self, path: Path, experiments: tuple[str, ...] = ()) -> None:
        self._path = path
        self._session = SessionReader(path)
        try:
            self.description = _described(self._session.header, path)
            self._records = {
                name: self._session.experiment(name) for name in experiments or self._session.names
            }
            self._blocks = self._ordered()
        except BaseException:
            self._session.close()
            raise
        self._carrier = self._session.header.get("study", {}).get("sensing")
        self._films = _films(path.parent / "video")
        self._next = 0
        self._now_s = self._blocks[0].start_s
        self._requested_v = 0.0
        self._filming = False
        self._seen_s = self._now_s
        self.rig = Rig(self.description, self, self, self, self, self, simulated=True)

    def _ordered(self) -> list[_Block]:
        blocks = [
            _Block(float(start_s), name, k)
            for name, record in self._records.items()
            for k, start_s in enumerate(record.block_start_s)
        ]
        if not blocks:
            raise InputError(
                f"The session has no blocks to replay. Choose another session. {self._path}"
            )
        return sorted(blocks, key=lambda block: block.start_s)

    def close(self) -> None:
        """Close the session."""
        self._session.close()

    # ---- VoltageSource -------------------------------------------------------------------------

    def write(self, voltage_v: float) -> None:
        """See `haselab.rig.VoltageSource`; compared with the recording when its block is read."""
        self.description.drive_limits.check(voltage_v)
        self._requested_v = float(voltage_v)

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`."""
        self._requested_v = 0.0

    # ---- Acquisition ---------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Time on the recording's clock, in s."""
        return self._now_s

    def read(self) -> NDArray[np.int16]:
        """See `haselab.rig.Acquisition`.

        Raises:
            DeviceError: Another output was recorded with this block, or the recording has ended.
        """
        if self._next >= len(self._blocks):
            raise DeviceError(
                f"The recording ended after {len(self._blocks)} blocks. Play at most that many. "
                f"{self._path}"
            )
        block = self._blocks[self._next]
        record = self._records[block.experiment]
        recorded_v = float(record.drive_v[block.index])
        if not abs(recorded_v - self._requested_v) <= _SAME_V:
            raise DeviceError(
                f"The output in block {block.index} of {block.experiment!r} is "
                f"{self._requested_v:g} V, but {recorded_v:g} V was recorded. Request what was "
                f"recorded, or use the twin. {self._path}"
            )
        self._next += 1
        self._now_s = block.start_s + self.description.block_s
        return np.array(record.codes[block.index])

    @property
    def next_output_v(self) -> float | None:
        """Output recorded with the next block, in V; None after the last."""
        if self._next >= len(self._blocks):
            return None
        block = self._blocks[self._next]
        return float(self._records[block.experiment].drive_v[block.index])

    # ---- FunctionGenerator ---------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """See `haselab.rig.FunctionGenerator`; accepts only the recorded sine.

        Raises:
            LimitError: The sine is outside the limits.
            DeviceError: Another sine was recorded.
        """
        rate_hz = self.description.rate_hz
        if not (0.0 < frequency_hz < 0.4 * rate_hz and 0.0 <= amplitude_v <= 1.0):
            raise LimitError(
                f"Sine of {frequency_hz:g} Hz, {amplitude_v:g} V is outside (0, {0.4 * rate_hz:g}] "
                "Hz, [0, 1] V. Lower the request."
            )
        if self._carrier is None:
            return
        recorded = (self._carrier["carrier_hz"], self._carrier["carrier_v"])
        if (frequency_hz, amplitude_v) != recorded:
            raise DeviceError(
                f"The sine is {frequency_hz:g} Hz, {amplitude_v:g} V, but {recorded[0]:g} Hz, "
                f"{recorded[1]:g} V was recorded. Request that. {self._path}"
            )

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`."""

    # ---- Camera --------------------------------------------------------------------------------

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`; returns the kept frames, whatever the rate."""
        if not 0.0 < rate_hz <= _FASTEST_FRAMES_HZ:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, outside (0, {_FASTEST_FRAMES_HZ:g}] Hz. Lower "
                "the request."
            )
        self._filming, self._seen_s = True, self._now_s

    def stop(self) -> None:
        """See `haselab.rig.Camera`."""
        self._filming = False

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`; returns the kept frames of the time that has passed."""
        if not self._filming:
            return None
        since_s, self._seen_s = self._seen_s, self._now_s
        images, time_s = [], []
        for film in self._films:
            low, high = bisect_right(film.time_s, since_s), bisect_right(film.time_s, self._now_s)
            if low < high:
                images += list(_frames(film.path, low, high))
                time_s += film.time_s[low:high]
        if not images:
            return None
        order = np.argsort(time_s, kind="stable")
        return Frames(np.stack(images)[order], np.array(time_s)[order])

    # ---- LoadStand -----------------------------------------------------------------------------

    def hang(self, mass_kg: float) -> None:
        """See `haselab.rig.LoadStand`; has no effect on a recording."""
        check_mass(mass_kg)

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`."""

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""

    def wait(self, duration_s: float) -> None:
        """See `haselab.rig.LoadStand`; skips the blocks of that time."""
        check_wait(duration_s)
        self._now_s += duration_s
        half_s = 0.5 * self.description.block_s
        while self._next < len(self._blocks):
            if self._blocks[self._next].start_s >= self._now_s - half_s:
                return
            self._next += 1


def _frames(path: Path, low: int, high: int) -> Iterator[NDArray[np.uint8]]:
    with open_video(path) as video:
        for index, frame in enumerate(video):
            if index >= high:
                return
            if index >= low:
                yield np.array(frame, dtype=np.uint8)
