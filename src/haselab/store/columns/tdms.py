"""Columns of LabVIEW's TDMS files."""

from __future__ import annotations

import contextlib
import importlib
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.archive import Member, MemberArchive, Read, one_rate, positive
from haselab.store.columns.units import find_unit

__all__ = ["TdmsArchive"]

_MOST_PACKED = 8  # bytes of a scaled value for one in the file


class _Bounded(io.FileIO):
    """A file that never reads beyond its end: lengths in a damaged file are arbitrary."""

    def __init__(self, file: Path) -> None:
        super().__init__(file, "rb")
        self._bytes = file.stat().st_size

    def read(self, size: int | None = -1) -> bytes:
        """As `io.FileIO.read`."""
        whole = size is None or size < 0
        return super().read(self._bytes if whole or size is None else min(size, self._bytes))


class TdmsArchive(MemberArchive):
    """Channels of all groups, as `group/channel`, in their scaled units.

    Args:
        file: where it is.
        opened: closes what the archive opens.
    Raises:
        InputError: the reader of such files is not installed.
    """

    def __init__(self, file: Path, opened: contextlib.ExitStack) -> None:
        super().__init__(file, opened)
        try:
            tdms: Any = importlib.import_module("nptdms")
        except ImportError as error:
            raise InputError(
                "LabVIEW files need nptdms, which is not installed. "
                f"Run: pip install 'haselab[formats]', or export the file as CSV. {file}"
            ) from error
        stream = self._open.enter_context(_Bounded(file))
        groups = self._open.enter_context(tdms.TdmsFile.open(stream)).groups()
        self._channels = {
            f"{group.name}/{channel.name}": channel
            for group in groups
            for channel in group.channels()
        }
        self.members = {name: _member(channel) for name, channel in self._channels.items()}

        held = sum(math.prod(m.shape) * m.dtype.itemsize for m in self.members.values())
        if held > _MOST_PACKED * file.stat().st_size:
            raise InputError(
                f"The file states {held} bytes of values, but has {file.stat().st_size}. Export it "
                f"again: {file}"
            )

    def rate_hz(self, names: Sequence[str]) -> float | None:
        """A channel of one number, or the increment that the waveforms of all columns share."""
        stated = super().rate_hz(names)
        waveforms = [self._channels[name].properties for name in names]
        self._check_starts(names)
        if stated is not None or len({each.get("wf_start_offset", 0.0) for each in waveforms}) > 1:
            return stated
        return one_rate(
            1.0 / (step * unit_s)
            for each in waveforms
            if (step := positive(each.get("wf_increment"))) and (unit_s := _seconds(each))
        )

    def _check_starts(self, names: Sequence[str]) -> None:
        """Refuse channels with different start times: equal rows have different times."""
        found = {name: self._channels[name].properties for name in names}
        starts = {n: each["wf_start_time"] for n, each in found.items() if "wf_start_time" in each}
        if len(starts) < 2 or any(positive(e.get("wf_increment")) is None for e in found.values()):
            return
        began = {name: np.datetime64(start, "us") for name, start in starts.items()}
        first, last = min(began, key=began.__getitem__), max(began, key=began.__getitem__)
        late_s = float((began[last] - began[first]) / np.timedelta64(1, "s"))
        step_s = min(
            float(each["wf_increment"]) * (_seconds(each) or 1.0) for each in found.values()
        )
        if late_s > 0.5 * step_s:
            raise InputError(
                f"Channel {last} begins {late_s:.6g} s after channel {first} (wf_start_time), so "
                f"equal rows have different times. Export them with one time axis: {self.file}"
            )

    def unit_text(self, full: str) -> str:
        """The channel's property `unit_string`, else what its name states."""
        unit = str(self._channels[full].properties.get("unit_string") or "")
        return unit.strip() or super().unit_text(full)


def _seconds(waveform: Mapping[str, Any]) -> float:
    """Seconds of the unit of a waveform's X axis; 0 where that is no time."""
    unit = find_unit(str(waveform.get("wf_xunit_string") or "s"))
    return unit.factor if unit is not None and unit.si == "s" else 0.0


def _member(channel: Any) -> Member:
    def start() -> Read:
        position = 0

        def read(count: int) -> NDArray[Any]:
            nonlocal position
            values = channel.read_data(position, count)
            if len(values) < count:
                raise EOFError(f"channel {channel.name} ends early")
            position += count
            return np.asarray(values)

        return read

    return Member((len(channel),), np.dtype(channel.dtype), start)
