"""What a tracker carries and gives: states, tracks, and why a point is not valid."""

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
    """Why a point is not valid in a frame; several may hold.

    UNLIKE: the correlation is below the least quality, the contrast is not above what noise alone
    shows, or the place is known to a pixel at best. LEFT: the subset reaches over the edge of the
    frame. BENT: it is deformed beyond a factor 1.8. UNSETTLED: the solve did not converge.
    STRAYED: it is not where the neighbours put it. COVERED: its residual or its contrast are not
    like the other points', so something else is in the subset. UNTIED: it was found, but no point
    that should stand still was, so the motion of the stand is not known. AMBIGUOUS: the pattern of
    the points repeats itself, and another place explains the frame as well.
    """

    UNLIKE = 1
    LEFT = 2
    BENT = 4
    UNSETTLED = 8
    STRAYED = 16
    COVERED = 32
    UNTIED = 64
    AMBIGUOUS = 128


@dataclass(frozen=True)
class FrameTracks:
    """All points in one frame.

    Args:
        x_px, y_px: positions, in px; NaN where not valid. Shape `(P,)`.
        std_x_px, std_y_px: standard deviations of the displacement from the reference, in px.
        quality: zero-mean normalised cross-correlation with the reference, -1 to 1; 0 where the
            subset shows an even grey.
        valid: whether the point was found.
        reason: bits of `LossReason` for points that are not valid, else 0; `None` where the
            positions come from elsewhere.
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
        reason: bits of `LossReason` for points that are not valid, else 0; `None` where the
            positions come from elsewhere.
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
        poses: `centre_px` of each subset and its `deformation` gradient. Shape `(P,)`.
        velocity_px: last motion from frame to frame, in px. Shape `(P, 2)`.
        reason: `LossReason` of each point in the last frame, 0 where it was found. Shape `(P,)`.
        gain: median over the points of the contrast over the reference's; 0 before the first
            frame. Shape `(1,)`.
        scatter: mean square of the points' scatter about a smooth field over what their deviations
            explain, at least 1, of the last frame that told it.
        pattern: fixed pattern of the sensor that is taken from each frame, if there is one.
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
        """The frame as it is compared with the reference."""
        return frame if self.pattern is None else self.pattern.removed(frame)

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, where the rest frames told it."""
        return self.reference.noise

    @property
    def frame_shape(self) -> tuple[int, int]:
        """`(H, W)` of all frames."""
        return self.reference.shape
