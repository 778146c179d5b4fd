"""Tracking of given points through a video: positions, standard deviations, quality."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain, islice
from math import ceil, floor, sqrt

import numpy as np

from haselab import _track
from haselab.base import InputError
from haselab.tracking.attempt import FEWER, Attempt, better, distance_px, joint_affine, surprise_px
from haselab.tracking.audit import may_be_uncertain, uncertain_points
from haselab.tracking.camera.fixed_pattern import FixedPattern, find_pattern, stays_with_pixels
from haselab.tracking.neighbours import Neighbourhood, build_neighbourhood
from haselab.tracking.options import (
    Floats,
    Frame,
    FramePart,
    Model,
    PartialFrame,
    Poses,
    Span,
    TrackOptions,
)
from haselab.tracking.reference import (
    JUMP_PX,
    Reference,
    first_reference,
    poses_at,
    renewed_reference,
)
from haselab.tracking.tracks import FrameTracks, LossReason, Tracks, TrackState

__all__ = ["PointTracker", "track_frames"]

_FIELD_POINTS = 12  # from this number on, affine subsets start with their neighbours' deformation
_DOUBT = 0.02  # share of the points lost in one frame above which all are searched for jointly
_EXPLAINED = 0.98  # share of the points above which a joint motion needs no further check
_MOSTLY = 0.8  # share above which rotations need not be tried
_FEWEST_TOGETHER = 6  # fewest points for a joint affine motion
_SURPRISE_PX = 1.0  # from the expected positions; above, the pattern's repeats are checked
_EVEN_LIGHT = 0.004  # relative; such a slope over 30 px shifts a dot by 0.004 px
_MANY_STRAYED = 0.2  # share of the points
_FEWEST_AUDITED = 20  # fewest values for an audit
_SIGNIFICANT = 3.0  # standard deviations by which the audit's ratio must exceed 1
_LEAST_LEFT = 0.05  # of a template's power; below, the pattern may be the texture
_DOTS_IN_SUBSET = 6.0  # distance, in sides of a subset, at which a dot's gradients differ
_MOVED_PX = 1.5  # along x or y, after which an offset is outside its pixel
_NEAR_PX = 22.0  # around expected points, of the parts drawn first; subsets of 21 px reach 18.5
_DUE = 0.1  # share of strongly deformed points at which the reference is renewed


def _around(positions_px: Sequence[float], size: int) -> list[Span]:
    """Rows or columns of a frame around positions in it, merged where they overlap."""
    spans: list[Span] = []
    for at_px in sorted(positions_px):
        first, stop = max(floor(at_px - _NEAR_PX), 0), min(ceil(at_px + _NEAR_PX) + 1, size)
        if spans and first <= spans[-1][1]:
            first = spans.pop()[0]
        spans.append((first, stop))
    return spans


class PointTracker:
    """Tracks given points by subset matching against a reference, the mean of the rest frames.

    With neighbours, the reference is renewed when more than a tenth of the points are stretched by
    more than 1.4 or to less than two thirds: the templates of all points that are valid in that
    frame are replaced. Displacements remain relative to the first reference.

    Args:
        points_px: points `[x, y]` in the first frame, in px (pixel centres at integers).
            Shape `(P, 2)`.
        options: tracker options.

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
                f"points_px has shape {points.shape}, expected (P, 2) with P >= 1: one row [x, y] "
                "per point."
            )
        if not np.isfinite(points).all():
            raise InputError("points_px contains values that are not finite. Remove those points.")
        self._points = points
        self._options = options or TrackOptions()
        self._neighbourhood = _neighbourhood(points, self._options.model)
        self._together = self._neighbourhood.index.size > 0

    def init(self, rest_frames: Sequence[Frame]) -> TrackState:
        """Create the state at rest from the frames whose mean is the reference.

        Args:
            rest_frames: one or more frames `(H, W)`, uint8 or uint16, without motion.

        Returns:
            The state before the first frame. With two frames or more it contains the noise law.

        Raises:
            InputError: no frame, frames that differ in shape, or a point that cannot be tracked.
        """
        if not rest_frames:
            raise InputError("No rest frame was given. At least one is required; ten are better.")
        shape = rest_frames[0].shape
        for frame in rest_frames:
            _check_frame(frame, shape)
        plain = first_reference(rest_frames, self._points, self._options, self._neighbourhood)
        pattern = find_pattern(rest_frames)
        if pattern is not None:
            reference = self._without(pattern, rest_frames, plain)
            if reference is not None:
                return self._at_rest(reference, reference.centres_px, pattern, plain)
        return self._at_rest(plain, plain.centres_px)

    def _without(
        self, pattern: FixedPattern, rest_frames: Sequence[Frame], plain: Reference
    ) -> Reference | None:
        """The reference without a pattern; `None` where the points have little other texture."""
        clean = [pattern.removed(frame) for frame in rest_frames]
        try:
            reference = first_reference(clean, self._points, self._options, self._neighbourhood)
        except InputError:  # no texture is left
            return None
        left = reference.subsets.norm / pattern.scale
        return reference if np.median(left / plain.subsets.norm) ** 2 > _LEAST_LEFT else None

    def _at_rest(
        self,
        reference: Reference,
        centres_px: Floats,
        pattern: FixedPattern | None = None,
        textured: Reference | None = None,
    ) -> TrackState:
        count = len(centres_px)
        return TrackState(
            reference,
            poses=poses_at(centres_px, reference.base),
            velocity_px=np.zeros((count, 2)),
            reason=np.zeros(count, np.uint8),
            gain=np.zeros(1),
            pattern=pattern,
            textured=textured,
        )

    def placed(self, state: TrackState, points_px: Floats) -> TrackState:
        """Use the same reference for a new clip, with stationary points at given positions.

        Args:
            state: from `init` or `step`.
            points_px: positions `[x, y]` to a pixel or two, in px. Shape `(P, 2)`.

        Returns:
            The state before the first frame of the clip.

        Raises:
            InputError: a different number of points.
        """
        if np.shape(points_px) != self._points.shape:
            raise InputError(
                f"points_px has shape {np.shape(points_px)}, expected {self._points.shape}: one "
                "position for each tracked point."
            )
        shift = np.asarray(points_px, float) - self._points
        centres = state.reference.centres_px + shift
        return self._at_rest(state.reference, centres, state.pattern, state.textured)

    def step(
        self, state: TrackState, frame: Frame | PartialFrame
    ) -> tuple[TrackState, FrameTracks]:
        """Find all points in the next frame.

        Args:
            state: from `init` or the previous `step`.
            frame: the frame, uint8 or uint16, of the reference's shape. A frame that is made on
                demand gives the same result.

        Returns:
            The next state, and the points in this frame.

        Raises:
            InputError: the frame does not fit the reference.
        """
        if not isinstance(frame, np.ndarray):
            parts = self._parts(state)
            if parts:
                part = frame.with_parts(parts)
                _check_frame(part, state.reference.shape)
                attempt = self._attempt(state, part)
                if attempt.summary.reach_px <= _NEAR_PX:  # it has only read these parts
                    return self._judged(state, part, attempt)
            frame = frame.whole()
        _check_frame(frame, state.reference.shape)
        clean = state.cleaned(frame)
        after, found = self._judged(state, clean, self._attempt(state, clean))
        return (after if after.textured is None else self._decided(after, frame)), found

    def _parts(self, state: TrackState) -> list[FramePart]:
        """Parts around the expected points; none if the tracker may read other pixels, too."""
        if self._together or state.pattern is not None or state.textured is not None:
            return []
        height, width = state.reference.shape
        expected_px = (state.poses["centre_px"] + state.velocity_px).tolist()
        if not all(0.0 <= x_px < width and 0.0 <= y_px < height for x_px, y_px in expected_px):
            return []
        return [
            (rows, _around([x for x, y in expected_px if rows[0] <= y < rows[1]], width))
            for rows in _around([y for _, y in expected_px], height)
        ]

    def _judged(
        self, state: TrackState, frame: Frame, attempt: Attempt
    ) -> tuple[TrackState, FrameTracks]:
        if not self._together:
            self._stay_certain(state, attempt)
        elif self._options.search_px:
            attempt = self._identified(state, frame, attempt)
        summary = attempt.summary
        audit = summary.audit
        # for independently moving points, others nearby would look like uneven light
        if self._together and summary.unevenness > _EVEN_LIGHT and attempt.believed:
            self._take_light_out(state.reference, frame, attempt)
            audit = _track.audit(state.reference.native, attempt.position_px, attempt.std_px)
        if state.pattern is not None and not self._together:
            attempt.std_px = np.sqrt(attempt.std_px**2 + _left_variance(state, attempt))
        scatter = self._audited(state, attempt, audit)
        reference, poses = state.reference, attempt.poses
        if summary.due > _DUE * len(self._points) and self._together:
            reference, poses = renewed_reference(
                reference, frame, poses, attempt.reason == 0, attempt.position_px.T, self._options
            )
        after = replace(attempt.after(reference, poses, scatter), pattern=state.pattern)
        return replace(after, textured=state.textured), attempt.tracks()

    def _decided(self, state: TrackState, frame: Frame) -> TrackState:
        """Decide whether the pattern belongs to sensor or scene, once enough points have moved."""
        rest, now = state.reference.centres_px, state.poses["centre_px"]
        moved = (state.reason == 0) & (np.abs(now - rest).max(axis=1) > _MOVED_PX)
        if state.pattern is None or state.textured is None or 4 * moved.sum() < len(moved):
            return state
        side = self._options.subset_px
        if stays_with_pixels(state.pattern, frame, rest[moved], now[moved], side):
            return replace(state, textured=None)
        return replace(state, reference=state.textured, pattern=None, textured=None)

    def _audited(self, state: TrackState, attempt: Attempt, audit: tuple[float, int]) -> float:
        """Widen standard deviations that are smaller than the scatter about a smooth field.

        The least certain points become invalid if too many would be wrong. Returns the scatter
        of this frame, or the last known one if too many neighbours are lost.
        """
        scatter = state.scatter
        ratio, numbers = audit
        if numbers >= _FEWEST_AUDITED:
            scatter = ratio if ratio > 1.0 + _SIGNIFICANT * sqrt(2.0 / numbers) else 1.0
            scatter = max(scatter, 0.5 * state.scatter)  # errors of a codec come in bursts
        strayed = attempt.summary.strayed / len(self._points)
        if strayed > _MANY_STRAYED and attempt.believed and (attempt.reason == 0).any():
            # this many are not outliers but the tails of errors common to all points
            spread = JUMP_PX / float(np.nanmedian(attempt.std_px))
            scatter = max(scatter, strayed * spread**2)
        if scatter > 1.0 and np.isfinite(attempt.std_px).any():
            # all points of a frame share common disturbances, whatever their own noise
            common = (scatter - 1.0) * np.nanmean(attempt.std_px**2)
            attempt.std_px = np.sqrt(attempt.std_px**2 + common)
        if state.pattern is not None or may_be_uncertain(attempt, scatter, self._options):
            self._drop(attempt)
        return scatter

    def _drop(self, attempt: Attempt) -> None:
        """Mark the least certain points as invalid; all of them if only few would remain."""
        coarse = uncertain_points(attempt, self._options)
        if coarse.any():
            if 3 * np.count_nonzero((attempt.reason == 0) & ~coarse) < len(coarse):
                coarse = attempt.reason == 0
            attempt.reason[coarse], attempt.uncertain = LossReason.UNLIKE, coarse
            attempt.position_px[:, coarse] = attempt.std_px[:, coarse] = np.nan

    def _take_light_out(self, reference: Reference, frame: Frame, attempt: Attempt) -> None:
        """Correct the positions for brightness slopes, and their standard deviations for that."""
        samples = np.empty(reference.subsets.shape.shape, np.float32)
        _track.samples(reference.native, frame, reference.bits, attempt.poses, samples)
        used = attempt.reason == 0
        samples[~used] = 0.0
        law = reference.noise
        matrices = attempt.poses["deformation"]
        level = samples[:, : reference.subsets.side**2].mean(axis=1) + 2.0 ** (reference.bits - 1)
        noise = None if law is None else law.variance(level)
        found = reference.slopes.unevenness(samples, matrices, noise, used)
        if found is not None:
            attempt.position_px += found.shift_px.T
            attempt.std_px = np.sqrt(attempt.std_px**2 + found.variance_px2.T)

    def _attempt(self, state: TrackState, frame: Frame, poses: Poses | None = None) -> Attempt:
        """Try to find the points of a frame from the expected, or given, poses."""
        reference, count = state.reference, len(self._points)
        after_poses, gain = np.empty_like(state.poses), np.empty(1)
        velocity_px, reason = np.empty((count, 2)), np.empty(count, np.uint8)
        position_px, std_px, quality = np.empty((2, count)), np.empty((2, count)), np.empty(count)
        summary = _track.step(
            reference.native,
            reference.rules,
            frame,
            reference.bits,
            state.poses if poses is None else poses,
            state.velocity_px if poses is None else np.zeros((count, 2)),
            state.reason,
            state.gain,
            after_poses,
            velocity_px,
            reason,
            gain,
            position_px,
            std_px,
            quality,
        )
        made = Attempt(
            poses=after_poses,
            velocity_px=velocity_px,
            reason=reason,
            gain=gain,
            position_px=position_px,
            std_px=std_px,
            quality=quality,
            summary=summary,
            believed=summary.believed,
            surprise_px=summary.surprise_px,
        )
        if poses is not None:
            made.velocity_px[:] += poses["centre_px"] - state.poses["centre_px"]
        return made

    def _stay_certain(self, state: TrackState, attempt: Attempt) -> None:
        """Mark points without neighbours as ambiguous if they may have jumped to another dot.

        A point keeps its identity while it is within a quarter of the distance to its nearest
        similar dot from the position expected by its velocity.
        """
        if not attempt.summary.ambiguous and attempt.summary.most_surprise_px <= _SURPRISE_PX:
            return
        step = attempt.poses["centre_px"] - state.poses["centre_px"]
        away = np.abs(step - state.velocity_px).max(axis=1)
        lost = (state.reason & LossReason.AMBIGUOUS) != 0
        jumped = (attempt.reason == 0) & (away > _SURPRISE_PX)
        if jumped.any():
            reach = 4 * max(self._options.search_px, self._options.subset_px)
            least = self._options.minimum_quality
            jumped &= away > 0.25 * state.reference.lookalikes_px(reach, least)
        lost |= jumped
        if lost.any():
            attempt.reason[lost] |= np.uint8(LossReason.AMBIGUOUS)
            attempt.position_px[:, lost] = attempt.std_px[:, lost] = np.nan

    def _identified(self, state: TrackState, frame: Frame, plain: Attempt) -> Attempt:
        """The attempt that explains most points, marked if another does so equally well."""
        summary, count = plain.summary, len(self._points)
        best = plain
        if summary.newly_lost >= max(2, _DOUBT * count) or 2 * plain.believed < count:
            best = self._best(state, frame, plain)
        moves_on = not summary.ambiguous and summary.believed_before > 0
        if not best.believed or (moves_on and best.surprise_px <= _SURPRISE_PX):
            return best
        around = state.reference.repeats_px
        return self._unambiguous(state, frame, best, around, moves_on) if len(around) else best

    def _best(self, state: TrackState, frame: Frame, plain: Attempt) -> Attempt:
        """The joint motion that explains most points; among equals the smallest surprise."""
        search, count = state.reference.search, len(self._points)
        spectrum = search.spectrum(frame)
        middle = state.poses["centre_px"].mean(axis=0)
        best = plain
        for proposals in (search.shifts, search.turns):
            for guess in proposals(spectrum, state.poses):
                made = self._tried(state, frame, guess.moved(state.poses, middle))
                best = better(best, made)
            if _FEWEST_TOGETHER <= best.believed < _EXPLAINED * count:
                best = better(best, self._tried(state, frame, joint_affine(state, best)))
            if best.believed >= _MOSTLY * count:
                break
        return best

    def _tried(self, state: TrackState, frame: Frame, poses: Poses) -> Attempt:
        made = self._attempt(state, frame, poses)
        made.surprise_px = surprise_px(state, made)
        return made

    def _unambiguous(
        self, state: TrackState, frame: Frame, best: Attempt, around: Floats, moves_on: bool
    ) -> Attempt:
        """The best attempt; its points are ambiguous if a repeat explains the frame equally well.

        An alternative that misses three more visible points is excluded: each is missed with a
        probability of a few per cent. Among the others the motion decides, if the state
        has one and the best is within a quarter of the distance to the nearest repeat.
        """
        nearest = float(np.hypot(*around[0]))
        if moves_on and best.surprise_px <= 0.25 * nearest:
            return best
        every = [best]
        for shift in around:
            poses = best.poses.copy()
            poses["centre_px"] += shift
            made = self._tried(state, frame, poses)
            if 3 * made.believed > len(self._points) and all(
                distance_px(made, other) > 0.5 * nearest for other in every
            ):
                every.append(made)
        fewest = min(made.missed for made in every)
        near = [made for made in every if made.missed < fewest + FEWER]
        first = min(near, key=lambda made: made.surprise_px)
        if len(near) == 1 or (moves_on and first.surprise_px <= 0.25 * nearest):
            return first
        found = first.reason == 0
        return replace(
            first,
            reason=np.where(found, np.uint8(LossReason.AMBIGUOUS), first.reason),
            position_px=np.where(found, np.nan, first.position_px),
            std_px=np.where(found, np.nan, first.std_px),
            velocity_px=0.0 * first.velocity_px,
        )


def _left_variance(state: TrackState, attempt: Attempt) -> Floats:
    """Variance along x and y due to the fixed pattern left in the templates. Shape `(2, P)`.

    The pattern counts as noise of one frame, for points that have moved away from it.
    """
    if state.pattern is None:
        return np.zeros((2, len(attempt.reason)))
    subsets = state.reference.subsets
    level = state.pattern.variance / (subsets.norm / state.pattern.scale) ** 2
    moved = np.abs(attempt.poses["centre_px"] - state.reference.centres_px).max(axis=1)
    away = np.minimum(moved * _DOTS_IN_SUBSET / subsets.side, 1.0) ** 2
    return np.asarray((away * level) * np.diagonal(subsets.even, axis1=1, axis2=2).T)


def _neighbourhood(points_px: Floats, model: Model) -> Neighbourhood:
    """Neighbours if the model needs them, or for an affine field with enough points."""
    if model == "neighbours":
        return build_neighbourhood(np.rint(points_px), points_px)
    if model == "affine" and len(points_px) >= _FIELD_POINTS:
        try:
            return build_neighbourhood(np.rint(points_px), points_px)
        except InputError:  # collinear points are tracked individually
            pass
    return Neighbourhood.none(len(points_px))


def _check_frame(frame: Frame, shape: tuple[int, ...]) -> None:
    if frame.ndim != 2 or frame.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"A frame is {frame.dtype} of shape {frame.shape}; expected uint8 or uint16 of "
            "shape (H, W). Convert colour frames to grey first."
        )
    if frame.shape != tuple(shape):
        raise InputError(
            f"A frame has shape {frame.shape}, but the reference {tuple(shape)}. All frames of a "
            "clip must have the same shape."
        )


def track_frames(
    frames: Iterable[Frame],
    points_px: Floats,
    options: TrackOptions | None = None,
    rest_frames: int = 1,
) -> Tracks:
    """Track points through a whole clip.

    Args:
        frames: frames `(H, W)` in order, uint8 or uint16; read one by one.
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        options: tracker options.
        rest_frames: number of initial frames, at rest, that are averaged as the reference.

    Returns:
        The tracks of all frames, including the rest frames.

    Raises:
        InputError: fewer frames than `rest_frames`, or as for `PointTracker`.

    Example:
        >>> frame = np.random.default_rng(2).integers(0, 255, (60, 60), dtype=np.uint8)
        >>> track_frames([frame, frame], np.array([[30.0, 30.0]])).x_px.round(3).tolist()
        [[30.0], [30.0]]
    """
    if rest_frames < 1:
        raise InputError(f"rest_frames = {rest_frames} is below 1. Use frames without motion.")
    stream = iter(frames)
    rest = list(islice(stream, rest_frames))
    if len(rest) < rest_frames:
        raise InputError(
            f"The clip has {len(rest)} frames, but {rest_frames} rest frames were requested. "
            "Lower rest_frames."
        )
    tracker = PointTracker(points_px, options)
    state = tracker.init(rest)
    rows = []
    for frame in chain(rest, stream):
        state, found = tracker.step(state, frame)
        rows.append(found)
    return Tracks.stack(rows)
