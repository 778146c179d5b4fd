"""Given points followed through a video: positions, standard deviations, quality."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray

from haselab import _track
from haselab.base import InputError
from haselab.tracking.neighbours import Neighbourhood, build_neighbourhood
from haselab.tracking.noise import NoiseLaw, measure_noise
from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.subsets import Subsets, build_subsets

__all__ = ["FrameTracks", "PointTracker", "TrackState", "Tracks", "track_frames"]

_QUALITY, _AMPLITUDE, _LEVEL, _RESIDUAL, _STATUS = 0, 1, 2, 3, 5
_JUMP_PX = 1.0  # farther than this from where the neighbours put it, a point has jumped
_IDENTITY = (1.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class FrameTracks:
    """All points in one frame.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(P,)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1.
        valid: whether the point was found.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class Tracks:
    """All points in all frames.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(F, P)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1.
        valid: whether the point was found.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]

    @classmethod
    def stack(cls, frames: Sequence[FrameTracks]) -> Tracks:
        """The frames one below the other."""
        return cls(
            x_px=np.stack([f.x_px for f in frames]),
            y_px=np.stack([f.y_px for f in frames]),
            std_x_px=np.stack([f.std_x_px for f in frames]),
            std_y_px=np.stack([f.std_y_px for f in frames]),
            quality=np.stack([f.quality for f in frames]),
            valid=np.stack([f.valid for f in frames]),
        )


@dataclass(frozen=True)
class TrackState:
    """What a tracker carries from frame to frame.

    Args:
        subsets: templates of the reference.
        noise: the camera's noise law, `None` when one rest frame could not tell it.
        rest_frames: frames averaged into the reference.
        frame_shape: `(H, W)` of all frames.
        poses: centre of each subset `x, y` in px and its deformation gradient. Shape `(P, 6)`.
        velocity_px: last motion from frame to frame, in px. Shape `(P, 2)`.
        valid: points found in the last frame. Shape `(P,)`.
    """

    subsets: Subsets
    noise: NoiseLaw | None
    rest_frames: int
    frame_shape: tuple[int, int]
    poses: Floats
    velocity_px: Floats
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class _Solution:
    """One frame's solve in the making; arrays are filled in place by the kernel."""

    frame: Frame
    poses: Floats
    results: NDArray[np.float32]


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
        self._everyone = np.arange(len(points), dtype=np.int32)
        neighbours = self._options.model == "neighbours"
        self._neighbourhood: Neighbourhood | None = (
            build_neighbourhood(np.rint(points)) if neighbours else None
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
        count = len(self._points)
        return TrackState(
            subsets=subsets,
            noise=measure_noise(rest_frames) if len(rest_frames) > 1 else None,
            rest_frames=len(rest_frames),
            frame_shape=(shape[0], shape[1]),
            poses=np.hstack([subsets.centres_px, np.tile(_IDENTITY, (count, 1))]),
            velocity_px=np.zeros((count, 2)),
            valid=np.ones(count, bool),
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
        count = len(self._points)
        centres = np.asarray(points_px, float) - state.subsets.offsets_px
        return replace(
            state,
            poses=np.hstack([centres, np.tile(_IDENTITY, (count, 1))]),
            velocity_px=np.zeros((count, 2)),
            valid=np.ones(count, bool),
        )

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
        _check_frame(frame, state.frame_shape)
        solution = self._predict(state, frame)
        self._refine(solution, state, self._everyone)
        good = self._believable(solution, state)
        if not good.all():
            good = self._rescue(solution, state, good)
        poses = self._settle(solution, state, good)
        after = TrackState(
            subsets=state.subsets,
            noise=state.noise,
            rest_frames=state.rest_frames,
            frame_shape=state.frame_shape,
            poses=poses,
            velocity_px=np.where(good[:, None], poses[:, :2] - state.poses[:, :2], 0.0),
            valid=good,
        )
        return after, _report(solution, state, good)

    def _predict(self, state: TrackState, frame: Frame) -> _Solution:
        """Constant velocity; the deformation from the neighbours, or the last one."""
        poses = state.poses.copy()
        poses[:, :2] += state.velocity_px
        if self._neighbourhood is not None:
            last = (poses[:, 2:] - _IDENTITY).reshape(-1, 2, 2)
            moved = poses[:, :2] - state.subsets.centres_px
            gradient = self._neighbourhood.gradient(moved, state.valid, last)
            poses[:, 2:] = gradient.reshape(-1, 4) + _IDENTITY
        return _Solution(frame, poses, np.zeros((len(poses), 6), np.float32))

    def _refine(self, solution: _Solution, state: TrackState, which: NDArray[np.int32]) -> None:
        _track.refine(
            state.subsets.native,
            solution.frame,
            solution.poses,
            solution.results,
            which,
            self._options.max_iterations,
            self._options.tolerance_px,
        )

    def _neighbours_guess(
        self, solution: _Solution, state: TrackState, good: NDArray[np.bool_], *, fresh: bool
    ) -> Floats:
        """Position of each subset as its good neighbours put it, NaN where they cannot.

        They extrapolate with the deformation predicted for this frame or, when `fresh`, with
        that of the positions found in it: a point that just came back from a long wait has
        spoilt the one, a point that jumped spoils the other.
        """
        assert self._neighbourhood is not None
        centres = state.subsets.centres_px
        gradient = (solution.poses[:, 2:] - _IDENTITY).reshape(-1, 2, 2)
        moved = solution.poses[:, :2] - centres
        if fresh:
            gradient = self._neighbourhood.gradient(moved, good, gradient)
        return np.asarray(centres + self._neighbourhood.predict(moved, gradient, good))

    def _believable(self, solution: _Solution, state: TrackState) -> NDArray[np.bool_]:
        """Converged, correlated, and where the neighbours expect it."""
        results = solution.results
        good = np.asarray(
            (results[:, _STATUS] == 0) & (results[:, _QUALITY] >= self._options.minimum_quality)
        )
        if self._neighbourhood is None or not good.any():
            return good
        jumped = np.ones_like(good)
        for fresh in (False, True):
            guess = self._neighbours_guess(solution, state, good, fresh=fresh)
            jumped &= np.abs(solution.poses[:, :2] - guess).max(axis=1) > _JUMP_PX
            if not jumped.any():
                break
        return np.asarray(good & ~jumped)

    def _rescue(
        self, solution: _Solution, state: TrackState, good: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """A second try from the neighbours' word, a third by whole-pixel search."""
        start = state.poses[:, :2] + state.velocity_px
        if self._neighbourhood is not None:
            guess = self._neighbours_guess(solution, state, good, fresh=True)
            start = np.where(np.isfinite(guess), guess, start)
            self._retry(solution, state, start, good)
            good = self._believable(solution, state)
        if self._options.search_px and not good.all():
            lost = np.flatnonzero(~good).astype(np.int32)
            solution.poses[lost, :2] = start[lost]
            _track.search(
                state.subsets.native,
                solution.frame,
                solution.poses,
                solution.results,
                lost,
                self._options.search_px,
            )
            self._refine(solution, state, lost)
            good = self._believable(solution, state)
        return good

    def _retry(
        self, solution: _Solution, state: TrackState, start: Floats, good: NDArray[np.bool_]
    ) -> None:
        lost = np.flatnonzero(~good).astype(np.int32)
        solution.poses[lost, :2] = start[lost]
        self._refine(solution, state, lost)

    def _settle(self, solution: _Solution, state: TrackState, good: NDArray[np.bool_]) -> Floats:
        """Lost points wait: where the neighbours put them, or where they were last seen."""
        lost = ~good
        if not lost.any():
            return solution.poses
        settled = solution.poses.copy()
        settled[lost] = state.poses[lost]
        if self._neighbourhood is not None:
            guess = self._neighbours_guess(solution, state, good, fresh=True)
            known = lost & np.isfinite(guess).all(axis=1)
            settled[known, :2] = guess[known]
        return settled


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


def _white_after_sampling(poses: Floats) -> Floats:
    """Share of a frame's white noise left after spline sampling between pixels. Shape `(P,)`.

    The squared cardinal-spline weights sum to 1 at whole pixels and to about 0.61 half way
    between; here their product over both axes.
    """
    share = np.ones(len(poses))
    for fraction in (poses[:, :2] - np.floor(poses[:, :2])).T:
        share *= np.interp(fraction, _FRACTIONS, _SQUARED_WEIGHTS)
    return share


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


_FRACTIONS = np.linspace(0.0, 1.0, 33)
_SQUARED_WEIGHTS = _squared_cardinal_weights(_FRACTIONS)


def _variances(solution: _Solution, state: TrackState) -> Floats:
    """Variance of the displacement along x and y, in px². Shape `(P, 2)`.

    By the noise law of the rest frames, widened where the match leaves more than the law allows
    (compression, a wrong deformation): the Birge ratio. Without a law, by the residual alone.
    """
    subsets, results = state.subsets, solution.results.astype(float)
    amplitude = np.maximum(results[:, _AMPLITUDE], 1e-6)
    gain, level = amplitude / subsets.norm, results[:, _LEVEL]
    law = state.noise or NoiseLaw(1.0, 0.0)
    now = subsets.covariance(amplitude, level, law)
    rest = subsets.covariance(subsets.norm, subsets.level, law) / state.rest_frames
    left_now = law.variance(level) * _white_after_sampling(solution.poses)
    left_rest = gain**2 * law.variance(subsets.level) / state.rest_frames
    ratio = results[:, _RESIDUAL] / subsets.residual_share / (left_now + left_rest)
    if state.noise is not None:
        ratio = np.maximum(ratio, 1.0)
    deformation = solution.poses[:, 2:].reshape(-1, 2, 2)
    total = deformation @ (now + rest) @ deformation.transpose(0, 2, 1)
    return np.asarray(np.diagonal(total, axis1=1, axis2=2) * ratio[:, None])


def _report(solution: _Solution, state: TrackState, good: NDArray[np.bool_]) -> FrameTracks:
    """The points (not the subsets' centres), with NaN for those that were lost."""
    deformation = solution.poses[:, 2:].reshape(-1, 2, 2)
    offset = (deformation @ state.subsets.offsets_px[:, :, None])[:, :, 0]
    found = np.where(good[:, None], solution.poses[:, :2] + offset, np.nan)
    std = np.where(good[:, None], np.sqrt(_variances(solution, state)), np.nan)
    quality = solution.results[:, _QUALITY].astype(float)
    return FrameTracks(found[:, 0], found[:, 1], std[:, 0], std[:, 1], quality, good)


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
