"""States and results of a tracker, and reasons why a point is not valid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from haselab.tracking.camera.fixed_pattern import FixedPattern
from haselab.tracking.camera.noise import NoiseLaw
from haselab.tracking.options import Floats, Frame, Poses
from haselab.tracking.reference import Reference

__all__ = ["FrameTracks", "LossReason", "TrackState", "Tracks"]


class LossReason(IntFlag):
    """Why a point is not valid in a frame; several bits may be set.

    UNLIKE: the correlation is below the minimum quality, the contrast is not above that of noise
    alone, or the position is known to a pixel at best. UNCERTAIN: it was found, but its standard
    deviation is so large that too many positions would be wrong (`TrackOptions.most_wrong`). LEFT:
    the subset extends beyond the edge of the frame. BENT: it is deformed beyond a factor 1.8.
    UNSETTLED: the solve did not converge. STRAYED: it is not where its neighbours predict it.
    COVERED: its residual or contrast differs from those of other points, so something else is in
    the subset. UNTIED: it was found, but no fixed point was, so the motion of the stand is not
    known. AMBIGUOUS: the pattern of the points repeats itself, and another position explains the
    frame equally well.
    """

    UNLIKE = 1
    LEFT = 2
    BENT = 4
    UNSETTLED = 8
    STRAYED = 16
    COVERED = 32
    UNTIED = 64
    AMBIGUOUS = 128
    UNCERTAIN = 256


@dataclass(frozen=True)
class FrameTracks:
    """Results of all points in one frame.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(P,)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1; 0 where the
            subset is uniformly grey.
        valid: whether the point was found.
        reason: bits of `LossReason` for points that are not valid, else 0; `None` where the
            positions come from another source.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]
    reason: NDArray[np.uint16] | None = None


@dataclass(frozen=True)
class Tracks:
    """Results of all points in all frames.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(F, P)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1; 0 where the
            subset is uniformly grey.
        valid: whether the point was found.
        reason: bits of `LossReason` for points that are not valid, else 0; `None` where the
            positions come from another source.
    """

    x_px: Floats
    y_px: Floats
    std_x_px: Floats
    std_y_px: Floats
    quality: Floats
    valid: NDArray[np.bool_]
    reason: NDArray[np.uint16] | None = None

    @classmethod
    def stack(cls, frames: Sequence[FrameTracks]) -> Tracks:
        """Stack the results of several frames."""
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
    """State of a tracker between frames.

    Args:
        reference: the reference for matching.
        poses: `centre_px` of each subset and its `deformation` gradient. Shape `(P,)`.
        velocity_px: last motion from frame to frame, in px. Shape `(P, 2)`.
        reason: `LossReason` of each point in the last frame, 0 where it was found. Shape `(P,)`.
        gain: median contrast of the points relative to the reference; 0 before the first
            frame. Shape `(1,)`.
        scatter: mean square of the points' scatter about a smooth field, relative to their standard
            deviations, at least 1, of the last frame that allowed it.
        pattern: fixed pattern of the sensor that is subtracted from each frame, if any.
        textured: the reference in which the pattern is texture of the scene, until the motion of
            the points has decided.
    """

    reference: Reference
    poses: Poses
    velocity_px: Floats
    reason: NDArray[np.uint8]
    gain: Floats
    scatter: float = 1.0
    pattern: FixedPattern | None = None
    textured: Reference | None = None

    def cleaned(self, frame: Frame) -> Frame:
        """The frame prepared for comparison with the reference."""
        return frame if self.pattern is None else self.pattern.removed(frame)

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, if the rest frames determined it."""
        return self.reference.noise

    @property
    def frame_shape(self) -> tuple[int, int]:
        """`(H, W)` of all frames."""
        return self.reference.shape
