"""Given points followed through a video: positions, standard deviations, quality."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntFlag
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from haselab import _track
from haselab.base import InputError
from haselab.tracking.neighbours import Neighbourhood, build_neighbourhood
from haselab.tracking.noise import NoiseLaw
from haselab.tracking.options import Floats, Frame, Model, TrackOptions
from haselab.tracking.reference import Reference, first_reference, renewed_reference

__all__ = [
    "FrameTracks",
    "PointTracker",
    "Reason",
    "TrackState",
    "Tracks",
    "track_frames",
]

_FIELD_POINTS = 12  # from so many on, affine subsets start from their neighbours' deformation
_DUE = 0.1  # share of the points due for a new template at which the reference is renewed


class Reason(IntFlag):
    """Why a point is not valid in a frame; several may hold.

    UNLIKE: the correlation is below the least quality, the contrast is not above what noise alone
    shows, or the place is known to a pixel at best. LEFT: the subset reaches over the edge of the
    frame. BENT: it is deformed beyond a factor 1.8. UNSETTLED: the solve did not converge.
    STRAYED: it is not where the neighbours put it. COVERED: its residual or its contrast are not
    like the other points', so something else is in the subset. UNTIED: it was found, but no point
    that should stand still was, so the motion of the stand is not known.
    """

    UNLIKE = 1
    LEFT = 2
    BENT = 4
    UNSETTLED = 8
    STRAYED = 16
    COVERED = 32
    UNTIED = 64


@dataclass(frozen=True)
class FrameTracks:
    """All points in one frame.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(P,)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1; 0 where the
            subset shows an even grey.
        valid: whether the point was found.
        reason: bits of `Reason` for points that are not valid, else 0; `None` where the positions
            come from elsewhere.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]
    reason: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Tracks:
    """All points in all frames.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(F, P)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1; 0 where the
            subset shows an even grey.
        valid: whether the point was found.
        reason: bits of `Reason` for points that are not valid, else 0; `None` where the positions
            come from elsewhere.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]
    reason: NDArray[np.uint8] | None = None

    @classmethod
    def stack(cls, frames: Sequence[FrameTracks]) -> Tracks:
        """The frames one below the other."""
        reasons = [f.reason for f in frames if f.reason is not None]
        return cls(
            x_px=np.stack([f.x_px for f in frames]),
            y_px=np.stack([f.y_px for f in frames]),
            std_x_px=np.stack([f.std_x_px for f in frames]),
            std_y_px=np.stack([f.std_y_px for f in frames]),
            quality=np.stack([f.quality for f in frames]),
            valid=np.stack([f.valid for f in frames]),
            reason=np.stack(reasons) if len(reasons) == len(frames) else None,
        )


@dataclass(frozen=True)
class TrackState:
    """What a tracker carries from frame to frame.

    Args:
        reference: what the frames are compared with.
        poses: centre of each subset `x, y` in px and its deformation gradient. Shape `(P, 6)`.
        velocity_px: last motion from frame to frame, in px. Shape `(P, 2)`.
        reason: `Reason` of each point in the last frame, 0 where it was found. Shape `(P,)`.
        gain: median over the points of the contrast over the reference's; 0 before the first
            frame. Shape `(1,)`.
    """

    reference: Reference
    poses: Floats
    velocity_px: Floats
    reason: NDArray[np.uint8]
    gain: Floats

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, where the rest frames told it."""
        return self.reference.noise

    @property
    def frame_shape(self) -> tuple[int, int]:
        """`(H, W)` of all frames."""
        return self.reference.shape


class PointTracker:
    """Follows given points by subset matching against one reference, the frames at rest.

    With neighbours, the reference is renewed when more than a tenth of the points are stretched by
    more than 1.4 or to less than two thirds: the templates of all points that are valid in that
    frame are taken from it. Their displacements still count from the first reference.

    Args:
        points_px: points `[x, y]` in the first frame, in px (pixel centres at integers).
            Shape `(P, 2)`.
        options: how to track.

    Raises:
        InputError: the points are not finite numbers of shape `(P, 2)`.

    Source: Pan, Li and Tong 2013 (inverse-compositional Gauss-Newton on subsets).

    Example:
        >>> frame = np.random.default_rng(2).integers(0, 255, (80, 80), dtype=np.uint8)
        >>> tracker = PointTracker(np.array([[40.0, 40.0]]))
        >>> state = tracker.init([frame])
        >>> state, found = tracker.step(state, np.roll(frame, 2, axis=1))
        >>> found.x_px.round(3), found.y_px.round(3)
        (array([42.]), array([40.]))
    """

    def __init__(self, points_px: Floats, options: TrackOptions | None = None) -> None:
        points = np.array(points_px, float)
        if points.ndim != 2 or points.shape[1] != 2 or not len(points):
            raise InputError(
                f"points_px has shape {points.shape}, expected (P, 2) with P >= 1: [x, y] a row."
            )
        if not np.isfinite(points).all():
            raise InputError("points_px holds numbers that are not finite. Remove those points.")
        self._points = points
        self._options = options or TrackOptions()
        self._neighbourhood = _neighbourhood(np.rint(points), self._options.model)

    def init(self, rest_frames: Sequence[Frame]) -> TrackState:
        """The state at rest, from the frames whose mean is the reference.

        Args:
            rest_frames: one or more frames `(H, W)`, uint8 or uint16, nothing moving.

        Returns:
            The state before the first frame. With two frames or more it holds the noise law.

        Raises:
            InputError: no frame, frames that differ in shape, or a point that cannot be tracked.
        """
        if not rest_frames:
            raise InputError("no rest frame given. At least one is needed, ten are better.")
        shape = rest_frames[0].shape
        for frame in rest_frames:
            _check_frame(frame, shape)
        reference = first_reference(rest_frames, self._points, self._options, self._neighbourhood)
        return self._at_rest(reference, reference.centres_px)

    def _at_rest(self, reference: Reference, centres_px: Floats) -> TrackState:
        count = len(centres_px)
        return TrackState(
            reference,
            poses=np.hstack([centres_px, reference.base.reshape(-1, 4)]),
            velocity_px=np.zeros((count, 2)),
            reason=np.zeros(count, np.uint8),
            gain=np.zeros(1),
        )

    def placed(self, state: TrackState, points_px: Floats) -> TrackState:
        """The same reference in a new clip: the points stand still, about where they are told.

        Args:
            state: from `init` or `step`.
            points_px: positions `[x, y]` to a pixel or two, in px. Shape `(P, 2)`.

        Returns:
            The state before the first frame of the clip.

        Raises:
            InputError: another number of points.
        """
        if np.shape(points_px) != self._points.shape:
            raise InputError(
                f"points_px has shape {np.shape(points_px)}, expected {self._points.shape}: one "
                "position for each tracked point."
            )
        shift = np.asarray(points_px, float) - self._points
        return self._at_rest(state.reference, state.reference.centres_px + shift)

    def step(self, state: TrackState, frame: Frame) -> tuple[TrackState, FrameTracks]:
        """Finds all points in the next frame.

        Args:
            state: from `init` or the previous `step`.
            frame: the frame, uint8 or uint16, of the reference's shape.

        Returns:
            The next state, and the points in this frame.

        Raises:
            InputError: the frame does not fit the reference.
        """
        reference, count = state.reference, len(self._points)
        _check_frame(frame, reference.shape)
        poses, velocity = np.empty((count, 6)), np.empty((count, 2))
        reason, gain = np.empty(count, np.uint8), np.empty(1)
        found, quality = np.empty((4, count)), np.empty(count)
        due = _track.step(
            reference.native,
            reference.rules,
            frame,
            reference.bits,
            state.poses,
            state.velocity_px,
            state.reason,
            state.gain,
            poses,
            velocity,
            reason,
            gain,
            found,
            quality,
        )
        if due > _DUE * count and self._neighbourhood.index.size:
            reference, poses = renewed_reference(
                reference, frame, poses, reason == 0, found[:2].T, self._options
            )
        after = TrackState(reference, poses, velocity, reason, gain)
        x, y, std_x, std_y = found
        return after, FrameTracks(x, y, std_x, std_y, quality, reason == 0, reason)


def _neighbourhood(points_px: Floats, model: Model) -> Neighbourhood:
    """Neighbours where the model needs them, or where an affine field has them to offer."""
    if model == "neighbours":
        return build_neighbourhood(points_px)
    if model == "affine" and len(points_px) >= _FIELD_POINTS:
        try:
            return build_neighbourhood(points_px)
        except InputError:  # a row of points: each for itself
            pass
    return Neighbourhood.none(len(points_px))


def _check_frame(frame: Frame, shape: tuple[int, ...]) -> None:
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"a frame is {frame.dtype} of shape {frame.shape}; expected uint8 or uint16 of "
            "shape (H, W). Convert colour frames to grey first."
        )
    if frame.shape != tuple(shape):
        raise InputError(
            f"a frame has shape {frame.shape}, the reference {tuple(shape)}. All frames of a "
            "clip must be alike."
        )


def track_frames(
    frames: Iterable[Frame],
    points_px: Floats,
    options: TrackOptions | None = None,
    rest_frames: int = 1,
) -> Tracks:
    """Points through a whole clip.

    Args:
        frames: frames `(H, W)` in order, uint8 or uint16; taken one by one.
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        options: how to track.
        rest_frames: how many of the first frames, at rest, are averaged as the reference.

    Returns:
        The tracks of all frames, the rest frames among them.

    Raises:
        InputError: fewer frames than `rest_frames`, or as `PointTracker`.

    Example:
        >>> frame = np.random.default_rng(2).integers(0, 255, (60, 60), dtype=np.uint8)
        >>> track_frames([frame, frame], np.array([[30.0, 30.0]])).x_px.round(3).tolist()
        [[30.0], [30.0]]
    """
    if rest_frames < 1:
        raise InputError(f"rest_frames = {rest_frames} is below 1. Take the frames before motion.")
    stream = iter(frames)
    rest = list(islice(stream, rest_frames))
    if len(rest) < rest_frames:
        raise InputError(
            f"the clip has {len(rest)} frames, {rest_frames} rest frames were asked for. "
            "Lower rest_frames."
        )
    tracker = PointTracker(points_px, options)
    state = tracker.init(rest)
    rows = []
    for frame in chain(rest, stream):
        state, found = tracker.step(state, frame)
        rows.append(found)
    return Tracks.stack(rows)
