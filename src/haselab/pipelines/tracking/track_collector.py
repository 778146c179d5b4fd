"""Keep tracks of any length in bounded memory: some points always, all points sometimes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.pipelines.tracking.table import Block
from haselab.tracking import Tracks
from haselab.tracking.audit import expected_wrong, wrong_share
from haselab.tracking.options import Floats

__all__ = ["WRONG_PX", "ThinnedTracks", "TrackCollector"]

WRONG_PX = 0.5  # error of a position that counts as wrong

_MOST_SAMPLES = 600_000  # points times frames, about 30 MB
_FEWEST_FRAMES = 16


@dataclass(frozen=True)
class ThinnedTracks:
    """All points in every n-th frame.

    Args:
        frame: numbers of the frames. Shape `(K,)`.
        time_s: their times. Shape `(K,)`.
        tracks: of all points. Shape `(K, P)`.
    """

    frame: NDArray[np.intp]
    time_s: Floats
    tracks: Tracks


class TrackCollector:
    """Collects blocks in bounded memory, except for a few points that are always kept.

    Args:
        points: number of points.
        always: indices of points that are kept in every frame.
    """

    def __init__(self, points: int, always: NDArray[np.intp]) -> None:
        self._most = max(_MOST_SAMPLES // max(points, 1), _FEWEST_FRAMES)
        self._always = always
        self._stride = 1
        self._thin: list[tuple[int, float, Tracks]] = []
        self._full: list[Tracks] = []
        self._times_s: list[Floats] = []
        self._numbers: list[NDArray[np.intp]] = []
        self._wrong = 0.0
        self.frames = 0
        self.valid = np.zeros(points, np.int64)

    def add(self, block: Block) -> None:
        """Add some frames."""
        tracks = block.tracks
        self.frames += len(block.time_s)
        self.valid += tracks.valid.sum(axis=0)
        if tracks.valid.any():
            std = np.stack([tracks.std_x_px, tracks.std_y_px])[:, tracks.valid]
            self._wrong += float(expected_wrong(std, WRONG_PX).sum())
        self._times_s.append(block.time_s)
        self._numbers.append(block.number)
        self._full.append(_part(tracks, (slice(None), self._always)))
        for k in range(-block.first % self._stride, len(block.time_s), self._stride):
            kept = _part(tracks, (slice(k, k + 1), slice(None)))
            self._thin.append((int(block.number[k]), float(block.time_s[k]), kept))
        while len(self._thin) > self._most:
            self._thin, self._stride = self._thin[::2], 2 * self._stride

    @property
    def expected_wrong(self) -> float:
        """Expected share of the valid positions that are wrong; see `audit.wrong_share`."""
        return wrong_share(self._wrong, int(self.valid.sum()), self.frames * len(self.valid))

    @property
    def time_s(self) -> Floats:
        """Times of all frames, in s."""
        return np.concatenate(self._times_s)

    @property
    def number(self) -> NDArray[np.intp]:
        """Numbers of all frames in the recording, including missing ones."""
        return np.concatenate(self._numbers)

    def always(self) -> Tracks:
        """The points that are always kept, in all frames."""
        return _joined(self._full)

    def thinned(self) -> ThinnedTracks:
        """All points in every n-th frame."""
        frames, times_s, tracks = zip(*self._thin, strict=True)
        return ThinnedTracks(np.array(frames, np.intp), np.array(times_s), _joined(list(tracks)))


_FIELDS = ("x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid")


def _part(tracks: Tracks, where: tuple[slice, slice | NDArray[np.intp]]) -> Tracks:
    parts = {name: getattr(tracks, name)[where].copy() for name in _FIELDS}
    reason = tracks.reason
    return Tracks(**parts, reason=None if reason is None else reason[where].copy())


def _joined(parts: list[Tracks]) -> Tracks:
    fields = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _FIELDS}
    reasons = [p.reason for p in parts if p.reason is not None]
    return Tracks(**fields, reason=np.concatenate(reasons) if len(reasons) == len(parts) else None)
