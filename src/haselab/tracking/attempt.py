"""One attempt to find the points in a frame, and the choice between several attempts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab._track import Summary
from haselab.tracking.options import Floats
from haselab.tracking.reference import Reference
from haselab.tracking.tracks import FrameTracks, Reason, TrackState

__all__ = ["FEWER", "Attempt", "better", "distance_px", "joint_affine", "surprise_px"]

FEWER = 3  # points by which an alternative may fall short of the best


@dataclass(slots=True)
class Attempt:
    """Result of the native step for one frame; see `native/tracking/track_step.h`.

    Args:
        poses, velocity_px, reason, gain: of the next state.
        found: x, y, std x, std y, in px. Shape `(4, P)`.
        quality: correlations. Shape `(P,)`.
        summary: what needs further checks.
        believed: number of points that were found.
        surprise_px: median distance from the positions expected by the velocities.
    """

    poses: Floats
    velocity_px: Floats
    reason: NDArray[np.uint8]
    gain: Floats
    found: Floats
    quality: Floats
    summary: Summary
    believed: int
    surprise_px: float

    @property
    def missed(self) -> int:
        """Number of points expected in the frame but not found."""
        return int(np.count_nonzero((self.reason != 0) & (self.reason & Reason.LEFT == 0)))

    def after(self, reference: Reference, poses: Floats, scatter: float) -> TrackState:
        """Tracker state before the next frame."""
        return TrackState(reference, poses, self.velocity_px, self.reason, self.gain, scatter)

    def tracks(self) -> FrameTracks:
        """Tracks of the points in this frame."""
        x, y, std_x, std_y = self.found
        return FrameTracks(x, y, std_x, std_y, self.quality, self.reason == 0, self.reason)


def surprise_px(state: TrackState, made: Attempt) -> float:
    """Median distance of the points from the positions expected by their velocities."""
    away = made.poses[:, :2] - state.poses[:, :2] - state.velocity_px
    known = made.reason == 0
    return float(np.median(np.abs(away[known]).max(axis=1))) if known.any() else np.inf


def better(one: Attempt, other: Attempt) -> Attempt:
    """The attempt that explains more points; if both do about as well, the smaller surprise."""
    if abs(one.believed - other.believed) < FEWER:
        return min(one, other, key=lambda made: made.surprise_px)
    return max(one, other, key=lambda made: made.believed)


def joint_affine(state: TrackState, made: Attempt) -> Floats:
    """Poses of all points moved by the affine motion of the found points."""
    known = made.reason == 0
    design = np.hstack([state.poses[:, :2], np.ones((len(known), 1))])
    motion = np.linalg.lstsq(design[known], made.poses[known, :2], rcond=None)[0]
    matrix = motion[:2].T
    turned = (matrix @ state.poses[:, 2:].reshape(-1, 2, 2)).reshape(-1, 4)
    return np.hstack([design @ motion, turned])


def distance_px(one: Attempt, other: Attempt) -> float:
    """Median distance between two attempts, over the points found by both."""
    both = (one.reason == 0) & (other.reason == 0)
    away = one.poses[both, :2] - other.poses[both, :2]
    return float(np.median(np.abs(away).max(axis=1))) if both.any() else np.inf
