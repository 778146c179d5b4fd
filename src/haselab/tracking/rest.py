"""Number of initial frames in which the points are at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.points import PointTracker

__all__ = ["frames_at_rest"]

_LEAST_PX = 0.05  # a smaller joint motion is ignored
_CERTAIN = 5.0  # standard deviations of a significant motion
_FEWEST_FOR_AFFINE = 6
_SECOND_DIFFERENCE = 0.6745 * 6.0**0.5  # its median size over the standard deviation
_FEWEST_BEFORE = 3  # frames needed to estimate camera shake at rest


def _joint_motion(frames: Sequence[Frame], points_px: Floats, options: TrackOptions) -> Floats:
    """Joint motion of the points relative to the first frame, and its std. `(F, 2 K)` each.

    For six points or more an affine motion, evaluated at the ends of the points' spread along x
    and y (K = 3 places), else the mean (K = 1). NaN in frames where fewer than half are found.
    """
    tracker = PointTracker(points_px, replace(options, model="translation"))
    state = tracker.init(frames[:1])
    centred = points_px - points_px.mean(axis=0)
    design = np.ones((len(points_px), 1))
    places = np.ones((1, 1))
    if len(points_px) >= _FEWEST_FOR_AFFINE and np.linalg.matrix_rank(centred, 1.0) == 2:
        design = np.hstack([design, centred])
        places = np.hstack([np.ones((3, 1)), np.vstack([np.zeros(2), np.diag(2 * centred.std(0))])])
    rows = np.full((len(frames), 2, 2 * len(places)), np.nan)
    rows[0] = 0.0
    for row, frame in zip(rows[1:], frames[1:], strict=True):
        state, found = tracker.step(state, frame)
        moved = np.stack([found.x_px, found.y_px], axis=1) - points_px
        used = found.valid.copy()
        if 2 * used.sum() < len(used) or used.sum() < design.shape[1]:
            continue
        # points with wrong positions are excluded
        away = np.abs(moved - np.median(moved[used], axis=0)).max(axis=1)
        used &= away <= 5.0 * max(float(np.median(away[used])), 0.05)
        inverse = np.linalg.pinv(design[used])
        fit = inverse @ moved[used]
        left = moved[used] - design[used] @ fit
        free = max(int(used.sum()) - design.shape[1], 1)
        stated = np.stack([found.std_x_px, found.std_y_px], axis=1)[used]
        variance = np.maximum((left**2).sum(axis=0) / free, (stated**2).mean(axis=0))
        lever = ((places @ inverse) ** 2).sum(axis=1)
        row[:] = (places @ fit).ravel(), np.sqrt(lever[:, None] * variance).ravel()
    return rows


def _shaking(motion: Floats) -> Floats:
    """Standard deviation between frames, without a steady motion or a step. `(2 K,)`.

    From the median second difference, of at least four frames; otherwise 0.
    """
    known = motion[np.isfinite(motion).all(axis=1)]
    if len(known) < 4:
        return np.zeros(motion.shape[1])
    return np.asarray(np.median(np.abs(np.diff(known, 2, axis=0)), axis=0) / _SECOND_DIFFERENCE)


def frames_at_rest(rest_frames: Sequence[Frame], points_px: Floats, options: TrackOptions) -> int:
    """Count the initial frames without joint motion of the points.

    The points are tracked from the first frame. Motion begins at the frame from which all further
    ones differ from the mean of the earlier ones by 5 standard deviations, by 5 times the camera
    shake, and by 0.05 px. An image that only shakes about one position is at rest.

    Args:
        rest_frames: the frames that should be at rest.
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        options: tracker options.

    Returns:
        Number of frames before the motion, 1 or more.

    Example:
        >>> frame = np.random.default_rng(2).integers(0, 255, (60, 60), dtype=np.uint8)
        >>> moved = np.roll(frame, 1, axis=1)
        >>> frames_at_rest([frame] * 8 + [moved] * 2, np.array([[30.0, 30.0]]), TrackOptions())
        8
    """
    count = len(rest_frames)
    if count < 2:
        return count
    motion, std = _joint_motion(rest_frames, points_px, options).transpose(1, 0, 2)
    shaking = _shaking(motion)
    for first in range(1, count):
        before = motion[:first][np.isfinite(motion[:first]).all(axis=1)]
        least = np.maximum(_LEAST_PX, _CERTAIN * shaking)
        if len(before) >= _FEWEST_BEFORE:
            least = np.maximum(least, _CERTAIN * before.std(axis=0, ddof=1))
        away = np.abs(motion[first:] - before.mean(axis=0))
        beyond = away > np.maximum(least, _CERTAIN * np.sqrt(2.0) * std[first:])
        lost = np.isnan(motion[first:]).any(axis=1)
        if (beyond.any(axis=1) | lost).all():
            return first
    return count
