"""Tracking of a few points in a scene of many dots, identified by the dots around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from haselab.base import InputError
from haselab.tracking.camera.noise import NoiseLaw
from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.particles.detect import find_profile, locate_particles, spread_out
from haselab.tracking.points import PointTracker
from haselab.tracking.tracks import FrameTracks, TrackState

__all__ = ["GuidedState", "GuidedTracker", "find_guides"]

_MOST_GUIDES = 60
_FEWEST_TOGETHER = 12
_SAME_PX = 1.0  # distance within which two positions are the same


@dataclass(frozen=True)
class GuidedState:
    """States of the points together with their guides, and of the points alone."""

    together: TrackState
    alone: TrackState

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, if the rest frames determined it."""
        return self.alone.noise


def find_guides(frame: Frame, points_px: Floats, options: TrackOptions) -> Floats:
    """Select dots around the points, strong and well separated.

    Args:
        frame: rest frame. Shape `(H, W)`.
        points_px: the points, in px. Shape `(P, 2)`.
        options: tracker options.

    Returns:
        Up to 60 dots; none if there are too few. Shape `(G, 2)`.
    """
    half = options.subset_px // 2
    found = locate_particles(frame, find_profile(frame), margin_px=half + 2)
    away = np.linalg.norm(found.points_px[:, None] - points_px[None], axis=2).min(axis=1)
    apart = away > half
    dots, strength = found.points_px[apart], found.strength[apart]
    if len(dots) + len(points_px) < _FEWEST_TOGETHER:
        return np.zeros((0, 2))
    return np.asarray(dots[spread_out(dots, strength, _MOST_GUIDES)])


class GuidedTracker:
    """Follows a few points individually, and together with the dots around them as one body.

    If a point moves with the body, that position is used: the dots around it distinguish it from
    similar ones. If it does not, because the point moves and the dots around it do
    not, the individual position is used, as long as it cannot have jumped to another dot.

    Args:
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        guides_px: dots around them, from `find_guides`. Shape `(G, 2)`.
        options: tracker options; the model is that of the individual points.

    Raises:
        InputError: all points are on one line, or as for `PointTracker`.
    """

    def __init__(self, points_px: Floats, guides_px: Floats, options: TrackOptions) -> None:
        self._count = len(points_px)
        if self._count + len(guides_px) < _FEWEST_TOGETHER:
            raise InputError(
                f"{self._count} points and {len(guides_px)} guides; at least {_FEWEST_TOGETHER} "
                "are required together. Use PointTracker."
            )
        both = np.concatenate([points_px, guides_px])
        self._together = PointTracker(both, replace(options, model="neighbours"))
        self._alone = PointTracker(points_px, options)

    def init(self, rest_frames: Sequence[Frame]) -> GuidedState:
        """Create the state at rest; see `PointTracker.init`."""
        return GuidedState(self._together.init(rest_frames), self._alone.init(rest_frames))

    def step(self, state: GuidedState, frame: Frame) -> tuple[GuidedState, FrameTracks]:
        """Find the points in the next frame; see `PointTracker.step`."""
        n = self._count
        body, held = self._together.step(state.together, frame)
        alone, single = self._alone.step(state.alone, frame)
        by_body = held.valid[:n]
        apart = np.hypot(held.x_px[:n] - single.x_px, held.y_px[:n] - single.y_px)
        moved = by_body & ~(apart < _SAME_PX)
        if moved.any():
            poses, velocity = alone.poses.copy(), alone.velocity_px.copy()
            reason = alone.reason.copy()
            shift = body.poses["centre_px"][:n] - body.reference.centres_px[:n]
            poses["centre_px"][moved] = (alone.reference.centres_px + shift)[moved]
            velocity[moved], reason[moved] = body.velocity_px[:n][moved], 0
            alone = replace(alone, poses=poses, velocity_px=velocity, reason=reason)
        names = ("x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid", "reason")
        parts = {
            name: np.where(by_body, getattr(held, name)[:n], getattr(single, name))
            for name in names
        }
        return GuidedState(body, alone), FrameTracks(**parts)
