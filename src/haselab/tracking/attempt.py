"""One attempt to find the points in a frame, and the choice between several attempts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab._track import Summary
from haselab.tracking.options import Floats, Poses
from haselab.tracking.reference import Reference
from haselab.tracking.tracks import FrameTracks, LossReason, TrackState

__all__ = ["FEWER", "Attempt", "better", "distance_px", "joint_affine", "surprise_px"]

FEWER = 3  # points by which an alternative may fall short of the best


@dataclass(slots=True)
class Attempt:
    """Result of the native step for one frame; see `native/tracking/track_step.h`.

    Args:
        poses, velocity_px, reason, gain: of the next state.
        position_px, std_px: along x and y; NaN where not valid. Shape `(2, P)`.
        quality: correlations. Shape `(P,)`.
        summary: what needs further checks.
        believed: number of points that were found.
        surprise_px: median distance from the positions expected by the velocities.
        uncertain: points that were found, but are not valid because of their deviation; their
            `reason` is UNLIKE. None: there are none. Shape `(P,)`.
    """

    poses: Poses
    velocity_px: Floats
    reason: NDArray[np.uint8]
    gain: Floats
    position_px: Floats
    std_px: Floats
    quality: Floats
    summary: Summary
    believed: int
    surprise_px: float
    uncertain: NDArray[np.bool_] | None = None

    @property
    def missed(self) -> int:
        """Number of points expected in the frame but not found."""
        return int(np.count_nonzero((self.reason != 0) & (self.reason & LossReason.LEFT == 0)))

    def after(self, reference: Reference, poses: Poses, scatter: float) -> TrackState:
        """Tracker state before the next frame."""
        return TrackState(reference, poses, self.velocity_px, self.reason, self.gain, scatter)

    def tracks(self) -> FrameTracks:
        """Tracks of the points in this frame."""
        (x, y), (std_x, std_y) = self.position_px, self.std_px
        reason = self.reason.astype(np.uint16)
        if self.uncertain is not None:
            reason[self.uncertain] = LossReason.UNCERTAIN
        return FrameTracks(x, y, std_x, std_y, self.quality, reason == 0, reason)


def surprise_px(state: TrackState, made: Attempt) -> float:
    """Median distance of the points from the positions expected by their velocities."""
    away = made.poses["centre_px"] - state.poses["centre_px"] - state.velocity_px
    known = made.reason == 0
    return float(np.median(np.abs(away[known]).max(axis=1))) if known.any() else np.inf


def better(one: Attempt, other: Attempt) -> Attempt:
    """The attempt that explains more points; if both do about as well, the smaller surprise."""
    if abs(one.believed - other.believed) < FEWER:
        return min(one, other, key=lambda made: made.surprise_px)
    return max(one, other, key=lambda made: made.believed)


def joint_affine(state: TrackState, made: Attempt) -> Poses:
    """Poses of all points moved by the affine motion of the found points."""
    known = made.reason == 0
    design = np.hstack([state.poses["centre_px"], np.ones((len(known), 1))])
    motion = np.linalg.lstsq(design[known], made.poses["centre_px"][known], rcond=None)[0]
    moved = np.empty_like(state.poses)
    moved["centre_px"] = design @ motion
    moved["deformation"] = motion[:2].T @ state.poses["deformation"]
    return moved


def distance_px(one: Attempt, other: Attempt) -> float:
    """Median distance between two attempts, over the points found by both."""
    both = (one.reason == 0) & (other.reason == 0)
    away = one.poses["centre_px"][both] - other.poses["centre_px"][both]
    return float(np.median(np.abs(away).max(axis=1))) if both.any() else np.inf
