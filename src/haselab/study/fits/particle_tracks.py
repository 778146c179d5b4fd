"""Row S11: homogeneity and narrowing of the sheet, from particles tracked all over it."""

from __future__ import annotations

import numpy as np

from haselab.base import InputError, JsonObject
from haselab.rig import RigDescription
from haselab.store.session.writer import ExperimentRecord
from haselab.tracking import homogeneity

__all__ = ["sheet_figure"]

_DRAWN_FRAMES = 100
_BANDS = 8


def sheet_figure(
    particles: ExperimentRecord, fiducials: ExperimentRecord, rig: RigDescription, picture: str
) -> JsonObject:
    """Data of figure 2: tracks, strain along the length, lateral motion from the mid-line.

    The profiles compare the frame with the largest elongation or contraction with the first one.

    Args:
        particles: tracks of the sheet's particles.
        fiducials: tracks of the clamps' fiducials in the same experiment.
        rig: scale of the camera.
        picture: path of the first frame, relative to the folder of the run.
    Returns:
        Section `tracks` of analysis.json; empty if too few particles were tracked.
    Source: reference study, fig. 2.
    """
    tracks = particles.tracks
    if len(tracks) < 2:
        return {}
    followed = tracks["valid"][0]
    x_px = np.where(tracks["valid"], tracks["x_px"], np.nan)[:, followed]
    y_px = np.where(tracks["valid"], tracks["y_px"], np.nan)[:, followed]
    lower = fiducials.tracks[["x_px", "y_px"]][0, 3:]
    middle_px = np.nanmedian(y_px, axis=1)
    farthest = int(np.argmax(np.abs(middle_px - middle_px[0])))
    rest = np.stack([x_px[0], y_px[0]], axis=1)
    moved = np.stack([x_px[farthest], y_px[farthest]], axis=1) - rest
    std = np.stack(
        [tracks[axis][farthest][followed].astype(float) for axis in ("std_x_px", "std_y_px")],
        axis=1,
    )
    try:
        profile = homogeneity(rest, moved, std, bands=_BANDS)
    except InputError:
        return {}
    top_px, bottom_px = rest[:, 1].min(), rest[:, 1].max()
    mm = 1e3 * rig.scale_m_per_px
    thin = slice(None, None, max(1, len(x_px) // _DRAWN_FRAMES))
    return {
        "frame_png": picture,
        "scale_mm_per_px": mm,
        "x_px": x_px[thin],
        "y_px": y_px[thin],
        "picked_x_px": lower["x_px"],
        "picked_y_px": lower["y_px"],
        "midline_px": float(np.mean(lower["x_px"])),
        "lateral": {
            "distance_mm": (rest[:, 0] - np.mean(lower["x_px"])) * mm,
            "motion_mm": moved[:, 0] * mm,
        },
        "along": {
            "position": (profile.height_px - top_px) / (bottom_px - top_px),
            "strain": profile.strain,
            "strain_std": profile.strain_std,
        },
    }
