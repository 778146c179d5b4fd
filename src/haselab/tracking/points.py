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
from haselab.tracking.noise import NoiseLaw, measure_noise
from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.subsets import Subsets, build_subsets

__all__ = [
    "FrameTracks",
    "PointTracker",
    "Reason",
    "Reference",
    "TrackState",
    "Tracks",
    "track_frames",
]

_JUMP_PX = 1.0  # farther than this from where the neighbours put it, a point has strayed
_MOST_RESIDUAL = 8.0  # mean square residual over the noise's, against the median point
_IDENTITY = (1.0, 0.0, 0.0, 1.0)
_HEADROOM = 1.5  # of a 16-bit frame's grey levels over the reference's largest


class Reason(IntFlag):
    """Why a point is not valid in a frame; several may hold.

    UNLIKE: the correlation is below the least quality. LEFT: the subset reaches over the edge of
    the frame. BENT: it is deformed beyond a factor 1.5. UNSETTLED: the solve did not converge.
    STRAYED: it is not where the neighbours put it. COVERED: the match leaves far more than the
    noise, so something else is in the subset.
    """

    UNLIKE = 1
    LEFT = 2
    BENT = 4
    UNSETTLED = 8
    STRAYED = 16
    COVERED = 32


@dataclass(frozen=True)
class FrameTracks:
    """All points in one frame.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(P,)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1.
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
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1.
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
class Reference:
    """What a clip is compared with.

    Args:
        subsets: templates of the points.
        noise: the camera's noise law, `None` when one rest frame could not tell it.
        rest_frames: frames averaged into it.
        shape: `(H, W)` of all frames.
        bits: of a pixel that are in use.
        native: templates, noise and neighbours, for the kernel.
        rules: the tracker's choices, for the kernel.
    """

    subsets: Subsets
    noise: NoiseLaw | None
    rest_frames: int
    shape: tuple[int, int]
    bits: int
    native: _track.Points
    rules: _track.Rules


@dataclass(frozen=True)
class TrackState:
    """What a tracker carries from frame to frame.

    Args:
        reference: what the frames are compared with.
        poses: centre of each subset `x, y` in px and its deformation gradient. Shape `(P, 6)`.
        velocity_px: last motion from frame to frame, in px. Shape `(P, 2)`.
        reason: `Reason` of each point in the last frame, 0 where it was found. Shape `(P,)`.
    """

    reference: Reference
    poses: Floats
    velocity_px: Floats
    reason: NDArray[np.uint8]

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, where the rest frames told it."""
        return self.reference.noise

    @property
    def frame_shape(self) -> tuple[int, int]:
        """`(H, W)` of all frames."""
        return self.reference.shape


class PointTracker:
    """Follows given points by subset matching against one fixed reference.

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
        self._neighbourhood = (
            build_neighbourhood(np.rint(points))
            if self._options.model == "neighbours"
            else Neighbourhood.none(len(points))
        )

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
        reference = np.mean(rest_frames, axis=0, dtype=float)
        subsets = build_subsets(reference, self._points, self._options)
        noise = measure_noise(rest_frames) if len(rest_frames) > 1 else None
        kept = Reference(
            subsets=subsets,
            noise=noise,
            rest_frames=len(rest_frames),
            shape=(shape[0], shape[1]),
            bits=_bits_in_use(rest_frames),
            native=_native_points(subsets, self._neighbourhood, noise, len(rest_frames)),
            rules=_native_rules(self._options, noise, len(rest_frames)),
        )
        return self._at_rest(kept, subsets.centres_px)

    def _at_rest(self, reference: Reference, centres_px: Floats) -> TrackState:
        count = len(centres_px)
        return TrackState(
            reference,
            poses=np.hstack([centres_px, np.tile(_IDENTITY, (count, 1))]),
            velocity_px=np.zeros((count, 2)),
            reason=np.zeros(count, np.uint8),
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
        offsets = state.reference.subsets.offsets_px
        return self._at_rest(state.reference, np.asarray(points_px, float) - offsets)

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
        reason, found, quality = np.empty(count, np.uint8), np.empty((4, count)), np.empty(count)
        _track.step(
            reference.native,
            reference.rules,
            frame,
            reference.bits,
            state.poses,
            state.velocity_px,
            state.reason,
            poses,
            velocity,
            reason,
            found,
            quality,
        )
        after = TrackState(reference, poses, velocity, reason)
        x, y, std_x, std_y = found
        return after, FrameTracks(x, y, std_x, std_y, quality, reason == 0, reason)


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


def _squared_cardinal_weights(fractions: Floats) -> Floats:
    """Sum of squared weights with which cubic-spline interpolation draws on the pixels."""
    pixels = np.arange(-12, 14)
    pole = np.sqrt(3.0) - 2.0
    lag = np.abs(pixels[:, None] - pixels[None, :])
    inverse = -6.0 * pole / (1.0 - pole**2) * pole**lag
    distance = np.abs(fractions[:, None] - pixels[None, :])
    spline = np.where(
        distance < 1.0,
        2.0 / 3.0 - distance**2 + 0.5 * distance**3,
        np.maximum(2.0 - distance, 0.0) ** 3 / 6.0,
    )
    return np.asarray(((spline @ inverse) ** 2).sum(axis=1))


_WHITE = _squared_cardinal_weights(np.linspace(0.0, 1.0, 33)).astype(np.float32)


def _bits_in_use(frames: Sequence[Frame]) -> int:
    """8 for bytes; else what the largest grey level and half as much again need, 8 to 16."""
    if frames[0].dtype == np.uint8:
        return 8
    largest = max(int(frame.max()) for frame in frames)
    return min(max(int(np.ceil(np.log2(_HEADROOM * largest + 1.0))), 8), 16)


def _native_points(
    subsets: Subsets, around: Neighbourhood, noise: NoiseLaw | None, rest_frames: int
) -> _track.Points:
    """The reference in the kernel's layout."""
    law = noise or NoiseLaw(1.0, 0.0)
    rest = subsets.covariance(subsets.norm, subsets.level, law) / rest_frames
    parts = [m[:, [0, 0, 1], [0, 1, 1]] for m in (subsets.even, subsets.shaped, rest)]
    parts.append(np.stack([subsets.norm, subsets.level, subsets.residual_share], axis=1))
    return _track.Points(
        shape=subsets.shape,
        gradient=subsets.gradient,
        inverse=subsets.inverse,
        place=subsets.place,
        centre=subsets.centres_px,
        offset=subsets.offsets_px,
        base=np.tile(_IDENTITY, (len(subsets.norm), 1)),
        noise=np.hstack(parts).astype(np.float32),
        white=_WHITE,
        near=around.index,
        lever=around.lever_px,
        weights=around.weights,
        smooth=around.smooth,
        side=subsets.side,
    )


def _native_rules(options: TrackOptions, noise: NoiseLaw | None, rest_frames: int) -> _track.Rules:
    law = noise or NoiseLaw(1.0, 0.0)
    return _track.Rules(
        max_iterations=options.max_iterations,
        tolerance_px=options.tolerance_px,
        minimum_quality=options.minimum_quality,
        jump_px=_JUMP_PX,
        most_residual=_MOST_RESIDUAL,
        search_px=options.search_px,
        noise_known=noise is not None,
        noise_floor=law.floor,
        noise_slope=law.slope,
        rest_share=1.0 / rest_frames,
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
