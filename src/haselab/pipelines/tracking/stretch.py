"""The largest common stretch of tracked points, which subsets of some models do not follow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.tracking import TrackOptions, Tracks

__all__ = ["largest_stretch", "stretch_note"]

_LEAST_POINTS = 6  # six numbers describe an affine motion in the plane; each point gives two
_ERROR = 0.07  # rms error over stretch and side of the subset, measured with the twin's dots
_COMMON = 0.9  # share of the squared displacements that the affine motion explains


def largest_stretch(place_px: NDArray[np.float64], tracks: Tracks) -> float:
    """Largest relative change of a distance between points that move in common.

    In each frame, an affine motion is fitted to the displacements; the stretch is the largest
    deviation of its singular values from 1, so that a rotation counts as none.

    Args:
        place_px: points at rest, `[x, y]`, in px. Shape `(N, 2)`.
        tracks: positions in the frames. Shape `(F, N)`.
    Returns:
        The stretch; 0 if the points are few or on one line, or do not move in common.
    Example:
        >>> place = np.array([[x, y] for x in (0.0, 10.0, 20.0) for y in (0.0, 10.0)])
        >>> x, y = place.T[:, None] * np.array([1.1, 1.0])[:, None, None]
        >>> seen = Tracks(x, y, x * 0, y * 0, x * 0 + 1, x == x)
        >>> round(largest_stretch(place, seen), 3)
        0.1
    """
    found = 0.0
    design = np.column_stack([place_px - place_px.mean(axis=0), np.ones(len(place_px))])
    for x_px, y_px, valid in zip(tracks.x_px, tracks.y_px, tracks.valid, strict=True):
        used = design[valid]
        if len(used) < _LEAST_POINTS or np.linalg.matrix_rank(used) < 3:
            continue
        moved = (np.column_stack([x_px, y_px]) - place_px)[valid]
        fit, *_ = np.linalg.lstsq(used, moved, rcond=None)
        left = moved - used @ fit
        varied = moved - moved.mean(axis=0)
        if (left**2).sum() > (1.0 - _COMMON) * (varied**2).sum():
            continue
        stretches = np.linalg.svd(np.eye(2) + fit[:2].T, compute_uv=False)
        found = max(found, float(np.abs(stretches - 1.0).max()))
    return found


def stretch_note(place_px: NDArray[np.float64], tracks: Tracks, options: TrackOptions) -> str:
    """Return a warning if the subsets do not stretch with the sheet; otherwise an empty text.

    Args:
        place_px: points at rest, `[x, y]`, in px. Shape `(N, 2)`.
        tracks: positions in the frames. Shape `(F, N)`.
        options: with which they were tracked.
    """
    if options.model != "translation" or not tracks.valid.any():
        return ""
    stretch = largest_stretch(place_px, tracks)
    wrong_px = _ERROR * stretch * options.subset_px
    if wrong_px < np.median(tracks.std_x_px[tracks.valid]):
        return ""
    return (
        f"The points move apart by up to {100 * stretch:.1f} %, but the subsets of the model "
        f"translation do not stretch. Positions may be wrong by {wrong_px:.1g} px rms, which the "
        "standard deviations do not include."
    )
